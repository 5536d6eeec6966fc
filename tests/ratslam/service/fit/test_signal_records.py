"""Signals of raw whisks, of the arm in clutter, and of a whisker on a stage, as `fit` reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.runs.settings.run_config import load_config
from ratslam.service.record_fit import fit_record
from ratslam.service.rig_fit import Rig
from robot.recordings.mcap_writer import record_source
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from tactile.whisker_geometry import HeadConfig

NOISE, DEAD = 3e-3, 7


def value(rig: Rig, name: str) -> float:
    return next(quantity.value for quantity in rig.quantities if quantity.name == name)


def reach_config(folder: Path, file: Path) -> Path:
    config = folder / "reach.yaml"
    config.write_text(f"source: {{plugin: whisker_reach, settings: {{file: {str(file)!r}}}}}\n")
    return config


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """A simulated head of rest angle 60 degrees with a dead whisker, fitted as one of 75 degrees."""
    file = tmp_path_factory.mktemp("raw") / "raw.mcap"
    settings = {"raw": True, "path": {"explore": 60}, "mechanics": {"noise": NOISE}, "seed": 1}
    head = HeadConfig(rest_deg=60, dead=(DEAD,))
    record_source(HeadSimulation(SimulationConfig.model_validate(settings), head), file)
    config = file.with_suffix(".yaml")
    config.write_text("recording: {file: raw.mcap}\ntouch: {head: {rest_deg: 75, dead: []}}\n")
    return fit_record(load_config(config))


def test_noise_of_raw_whisks_is_found(raw: Rig) -> None:
    assert value(raw, "noise, median channel") == pytest.approx(NOISE, rel=0.05)
    assert abs(value(raw, "correlation of neighbours")) < 0.1
    # Sensor noise alone, at rest: its means over 50 ms move by chance only.
    assert value(raw, "drift, median channel") < 0.2 * NOISE


def test_a_dead_whisker_becomes_a_setting(raw: Rig) -> None:
    assert raw.included()["touch"]["head"]["dead"] == [DEAD]
    assert any(line.strip() == f"whisker {DEAD}: dead: no signal" for line in raw.notes)


def test_the_rest_angle_of_raw_whisks_is_found(raw: Rig) -> None:
    """From detected contacts, whose delay is part of it."""
    assert 60 < raw.included()["touch"]["head"]["rest_deg"] < 62.5


def test_whiskers_of_the_arm_in_clutter(reference_data: Path, tmp_path: Path) -> None:
    file = next((reference_data / "real_touch").rglob("reaching_take20_in_clutter.csv"))
    rig = fit_record(load_config(reach_config(tmp_path, file)))
    assert 1.2 < value(rig, "noise, median channel") < 3.0
    assert 0.2 < value(rig, "correlation of neighbours") < 0.7
    dirty = [k for k, line in enumerate(rig.notes) if "dirty" in line]
    assert [rig.notes[k - 1].split(":")[0].strip() for k in dirty] == ["right5"]
    unknown = " ".join(rig.unknown)
    assert all(f"drift of left{k}" not in unknown for k in (4, 5, 6, 7))  # they never touch
    assert "drift of right4" in unknown
    assert "stage-to-signal map: no known touch" in unknown
    assert not any("nan" in line for line in rig.notes)
    assert rig.included() == {}


def stage_file(path: Path, scrambled: bool) -> Path:
    """A calibration along rays from a whisker's base, in mm and counts; or of signals in random order."""
    random = np.random.default_rng(0)
    ray, reach = np.meshgrid(np.linspace(-0.8, 0.8, 12), np.linspace(0, 40, 13), indexing="ij")
    across, along = np.sin(ray) * reach, np.cos(ray) * reach
    signal = np.stack([10 * across, along**2 / 4, across * along / 10], axis=-1).reshape(-1, 3)
    signal += random.standard_normal(signal.shape)
    if scrambled:
        signal = random.permutation(signal)
    place = np.stack([50 + along, 60 + across, np.full(ray.shape, 20.0)], axis=-1).reshape(-1, 3)
    rows = np.column_stack([np.arange(len(place)), place, signal])
    np.savetxt(path, rows, delimiter=",", header=",px,py,pz,sx,sy,sz", comments="", fmt="%.9g")
    return path


@pytest.mark.parametrize("scrambled", [False, True])
def test_the_map_of_a_stage_is_scored_on_rows_held_out(scrambled: bool, tmp_path: Path) -> None:
    stage_file(tmp_path / "stage.csv", scrambled)
    config = tmp_path / "stage.yaml"
    config.write_text("source: {plugin: whisker_stage, settings: {file: stage.csv}}\n")
    rig = fit_record(load_config(config))
    error, control = value(rig, "error of the map, held out"), value(rig, "error without a map (the mean)")
    assert (error < 0.1 * control) == (not scrambled)


@pytest.mark.parametrize(
    ("plugin", "text"),
    [("whisker_reach", "row,x\n0,1\n"), ("whisker_stage", ",px,py\n0,1,2\n"), ("whisker_stage", "")],
)
def test_bad_files_are_refused(plugin: str, text: str, tmp_path: Path, capsys) -> None:
    (tmp_path / "bad.csv").write_text(text)
    config = tmp_path / "bad.yaml"
    config.write_text(f"source: {{plugin: {plugin}, settings: {{file: {str(tmp_path / 'bad.csv')!r}}}}}\n")
    assert main(["fit", str(config)]) == 2
    out = capsys.readouterr()
    assert out.out == ""
    assert len(out.err.splitlines()) == 1
    assert "bad.csv" in out.err
