"""`fit` measures a rig, and what it writes is a configuration's to include."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.runs.settings.run_config import RunConfig, load_config
from ratslam.runs.settings.strict_yaml import dump_data
from ratslam.service.rig_fit import Quantity, Rig
from robot.recordings.mcap_writer import record_source
from robot.simulation.head.simulated_session import HeadSimulation, SimulationConfig
from robot.sources.odometry import from_motions
from robot.world.maze import parse_maze, wall_boxes
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate
from tactile.whisker_geometry import HeadConfig

ROWS = 900


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive whose turns are 10 % short by the odometry, with truth and without, and a session of a head."""
    folder = tmp_path_factory.mktemp("fit")
    random = np.random.default_rng(0)
    time, way, turn = 0.5 * np.arange(ROWS), random.uniform(0, 0.2, ROWS), random.normal(0, 0.2, ROWS)
    way[0] = turn[0] = 0
    wander = 0.01 * random.standard_normal(ROWS)  # rad
    truth = integrate(from_motions(time, way, 0.0, 1.1 * turn + wander)[:, :3])
    table = np.column_stack([time, way, turn])
    for name in ("drive_odometry.csv", "alone.csv"):
        np.savetxt(folder / name, table, delimiter=",", header="t,distance,turn", comments="")
    table = np.column_stack([table[:, 0], truth])
    np.savetxt(folder / "drive_truth.csv", table, delimiter=",", header="t,x,y,heading", comments="")
    head = HeadConfig(rest_deg=62, dead=(4,))
    settings = {"path": {"explore": 120}, "motion": {"speed": 0.03}}
    record_source(HeadSimulation(SimulationConfig.model_validate(settings), head), folder / "w.mcap")
    return folder


def test_wheels_are_measured_and_the_file_is_included(folder: Path, capsys) -> None:
    rig = folder / "rig.yaml"
    assert main(["fit", str(folder / "drive_odometry.csv"), "-o", str(rig)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["quantity", "assumed", "now", "+-", "unit", "setting"]
    turn = next(line.split() for line in lines if line.startswith("turn scale"))
    assert turn[2] == "1"
    assert float(turn[3]) == pytest.approx(1.1, abs=0.02)
    assert turn[-1] == "recording.odometry.turn_scale"
    length = next(line for line in lines if line.startswith("length scale"))
    assert length.endswith("unchanged, within 2 sd")
    (folder / "mine.yaml").write_text("include: [rig.yaml]\nrecording: {file: drive_odometry.csv}\n")
    config = load_config(folder / "mine.yaml")
    assert config.recording is not None
    assert config.recording.odometry.turn_scale == pytest.approx(1.1, abs=0.02)
    assert config.recording.odometry.length_scale == 1
    assert f"# {lines[0]}" in rig.read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["drive_odometry.csv", "-o", "absent/rig.yaml"], "absent: no such folder"),
        (["drive_odometry.csv", "--seed", "-1"], "--seed: -1; expected a non-negative integer"),
        (["drive_truth.csv"], "ratslam doctor drive_truth.csv` says what is missing"),
        (["drive_truth.mcap"], "drive_truth.mcap: is empty"),
        (["none.csv"], "none.csv: no such file"),
        (["walls.csv"], "error: "),
        (["bracket.yaml"], "bracket.yaml:1:4: a bracket"),
    ],
)
def test_each_mistake_gets_one_error(
    folder: Path, options: list[str], message: str, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(folder)
    Path("drive_truth.mcap").touch()
    Path("walls.csv").write_text("x1,y1\n1,2\n")
    Path("bracket.yaml").write_text("a: [")
    assert main(["fit", *options]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("error")) == ("", 1)
    assert message in said.err


def test_the_head_and_its_dead_whiskers_are_measured(folder: Path, capsys) -> None:
    rig = folder / "head.yaml"
    wrong = ["--set", "touch.head.rest_deg=75", "--set", "touch.head.dead=[]"]
    assert main(["fit", str(folder / "w.mcap"), "-o", str(rig), *wrong]) == 0
    text = capsys.readouterr().out
    assert "not determined: noise, drift, baseline" in text  # of whisks without raw samples
    assert "not determined: radius of ring 0" in text
    (folder / "head_run.yaml").write_text("include: [head.yaml]\nrecording: {file: w.mcap}\n")
    head = load_config(folder / "head_run.yaml").touch.head
    assert head.rest_deg == pytest.approx(62 + np.degrees(0.015), abs=0.5)
    assert head.rings[2].radius == pytest.approx(0.08, rel=0.02)
    assert head.dead == (4,)


def test_without_truth_and_views_the_wheels_are_unknown(folder: Path, capsys) -> None:
    rig = folder / "nothing.yaml"
    record = folder / "bare"
    record.mkdir()
    (record / "alone.csv").write_bytes((folder / "alone.csv").read_bytes())
    assert main(["fit", str(record / "alone.csv"), "-o", str(rig)]) == 2
    out = capsys.readouterr()
    assert "not determined: length scale: no true poses" in out.out
    assert "nothing that tells of the rig" in out.err
    assert not rig.exists()


def test_settings_are_those_that_differ() -> None:
    rig = Rig(
        (
            Quantity("a", 1.0, 1.1, 0.01, "", "recording.odometry.turn_scale"),
            Quantity("b", 1.0, 1.1, 0.1, "", "recording.odometry.length_scale"),
            Quantity("c", None, 3.0, 0.1, ""),
        ),
        {"touch": {"head": {"dead": [2]}}},
    )
    assert rig.included() == {
        "recording": {"odometry": {"turn_scale": 1.1}},
        "touch": {"head": {"dead": [2]}},
    }
    assert "turn_scale: 1.1" in dump_data(rig.included())
    assert "nothing to include" in Rig().file_text("a.csv")
    assert set(rig.included()) <= set(RunConfig.model_fields)


def test_the_walls_are_those_of_the_simulation() -> None:
    settings = {"path": {"explore": 5}, "maze": {"heights": [0.03, 0.05]}}
    source = HeadSimulation(SimulationConfig.model_validate(settings))
    maze, walls = source.info.maze, source.scene.surroundings.walls
    heights = stream(maze.seed, "maze.heights")
    again = wall_boxes(parse_maze(maze.text, Path("maze of the recording")), heights, maze.heights)
    np.testing.assert_array_equal(again.box, walls.box)
    np.testing.assert_array_equal(again.height, walls.height)
