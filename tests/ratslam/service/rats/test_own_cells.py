"""Recorded cells from NWB files: scored, and compared with those of a run; what our files say."""

import csv
import importlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.cells.analysis import analyse_cells, control_scores
from evaluation.cells.recording import CellRecording, write_recording
from evaluation.papers.cells import own_data
from evaluation.papers.figure import Task
from ratslam.service.own_cells import read_own_cells
from robot.recordings.nwb_file import NwbConfig
from tactile.base.errors import InputError
from tests.evaluation.cells.box_walk import random_walk, sheet_recording
from tests.helpers.commands import refused, said

WALK = random_walk(2400)
CELLS = np.arange(50, 15876, 640)
CONFIG = "backend: classic\nrat_simulation: {seconds: 120, phases: [{start: 60, rotate_cues_deg: 90}]}\n"


@pytest.fixture(scope="module")
def pynwb() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return importlib.import_module("pynwb")


@pytest.fixture(scope="module")
def model() -> CellRecording:
    made = sheet_recording(WALK, CELLS)
    return made._replace(activity=0.04 * made.activity)


@pytest.fixture
def run(model: CellRecording, tmp_path: Path) -> Path:
    directory = tmp_path / "run"
    directory.mkdir()
    (directory / "config.yaml").write_text(CONFIG)
    write_recording(directory / "cells.npz", model)
    return directory


@pytest.fixture(scope="module")
def session() -> own_data.OwnSession:
    return own_data.draw_session(12, 41000, 120.0)


@pytest.fixture
def data(session: own_data.OwnSession, tmp_path: Path) -> Path:
    own_data.write_session(tmp_path / "data.nwb", session)
    return tmp_path / "data.nwb"


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def test_units_are_scored_as_cells_of_a_network_each_score_beside_its_control(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = said(capsys, "cells", "score", data, "-o", tmp_path / "s.csv", "--shuffles", 20, "--seed", 3)
    assert "unnamed subject, 1970-01-01T00:00:00+00:00: 12 cells" in text
    assert "120 s, measured heading, place and heading known in 100.0 %" in text
    rows, cells = table(tmp_path / "s.csv"), read_own_cells(data).recording
    scores, controls = analyse_cells(cells), control_scores(cells, 20, 3)
    for name in ("information", "grid", "border", "vector_length", "mean_rate"):
        np.testing.assert_array_equal([float(row[name]) for row in rows], getattr(scores, name))
    for name, control in controls.items():
        limit = [float(row["sparsity_p05" if name == "sparsity" else f"{name}_p95"]) for row in rows]
        np.testing.assert_array_equal(
            limit, control.low_percentile if name == "sparsity" else control.percentile
        )
    two = refused(capsys, "cells", "score", data, "-o", tmp_path / "t.csv", "--set", "leds=[front, back]")
    assert "no series 'front'; expected it among 'position'" in two
    assert [row["cell"] for row in rows] == [str(number) for number in range(12)]
    assert "exists already" in refused(capsys, "cells", "score", data, "-o", tmp_path / "s.csv")
    assert "data.nw: no such file" in refused(
        capsys, "cells", "score", tmp_path / "data.nw", "-o", tmp_path / "t.csv"
    )
    assert "--set unit: 0" in refused(
        capsys, "cells", "score", data, "-o", tmp_path / "t.csv", "--set", "unit=0"
    )
    assert not (tmp_path / "t.csv").exists()


def test_without_a_compass_the_heading_is_that_of_motion_and_files_without_units_are_refused(
    session: own_data.OwnSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    straight = session._replace(spikes=session.spikes[:2])
    own_data.write_session(tmp_path / "a.nwb", straight)
    h5py = importlib.import_module("h5py")
    with h5py.File(tmp_path / "a.nwb", "r+") as file:
        del file["processing/behavior/CompassDirection"]
    found = read_own_cells(tmp_path / "a.nwb")
    assert "no head direction, so that of motion above 0.03 m/s" in found.described
    known = np.isfinite(found.recording.truth).all(axis=1)
    assert 0.8 < known.mean() < 1
    wag = 0.4 * np.sin(2 * np.pi * 0.7 * found.recording.time)  # of the head about the direction of motion
    off = np.exp(1j * (found.recording.truth[:, 2] + wag)) - np.exp(1j * session.truth[:, 2])
    assert np.median(np.abs(off[known])) < 0.1
    own_data.write_session(tmp_path / "b.nwb", session._replace(spikes=[]))
    with pytest.raises(InputError, match="no units with spike times"):
        read_own_cells(tmp_path / "b.nwb")
    with pytest.raises(InputError, match="no series 'head'"):
        read_own_cells(tmp_path / "a.nwb", NwbConfig(position="head"))


def test_a_run_stands_beside_recorded_cells_with_intervals_and_its_cue_turn(
    run: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = ("cells", "compare", run, data, "--shuffles", 20, "--turn", 60)
    text = said(capsys, *own, "-o", tmp_path / "c.csv")
    assert text == said(capsys, *own, "-o", tmp_path / "d.csv").replace("d.csv", "c.csv")
    assert (tmp_path / "c.csv").read_bytes() == (tmp_path / "d.csv").read_bytes()
    assert "peak rate 20 Hz, seed 0" in text
    assert "over cells, not over animals" in text
    rows = {row["score"]: row for row in table(tmp_path / "c.csv")}
    for name in ("information, corrected", "grid, share beyond shuffles", "speed", "vector_length", "border"):
        assert float(rows[name]["data_low"]) <= float(rows[name]["data"]) <= float(rows[name]["data_high"])
    assert float(rows["vector_length"]["model_low"]) > float(rows["vector_length"]["data"])
    # Neither the sheet of this model nor these cells follow the cues.
    turned = rows["turn of preferred directions, rad"]
    assert abs(float(turned["model"])) < 0.4
    assert abs(float(turned["data"])) < 0.4
    said(capsys, *own, "-o", tmp_path / "c.png")
    assert (tmp_path / "c.png").read_bytes()[:4] == b"\x89PNG"
    assert ".csv or .png" in refused(capsys, *own, "-o", tmp_path / "c.txt")
    assert "cells.npz: no such file" in refused(capsys, "cells", "compare", tmp_path / "none", data)


def test_our_file_says_whose_session_it_is_and_how_its_spikes_were_drawn_and_is_read_back(
    run: Path, model: CellRecording, tmp_path: Path, pynwb: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    about = [
        "subject_id=rat-3", "species=Rattus norvegicus", "age=P90D", "sex=F", "description=open field",
        "start=2024-05-01T10:00:00+02:00",
    ]  # fmt: skip
    about = [word for each in about for word in ("--about", each)]
    said(capsys, "export", run, "-o", tmp_path / "a.nwb", "--spike-seed", 7, "--peak-rate", 15, *about)
    assert pynwb.validate(path=str(tmp_path / "a.nwb")) == []
    with pynwb.NWBHDF5IO(tmp_path / "a.nwb", "r") as source:
        file = source.read()
        assert (file.subject.subject_id, file.subject.species, file.subject.sex) == (
            "rat-3",
            "Rattus norvegicus",
            "F",
        )
        assert file.session_start_time.isoformat() == "2024-05-01T08:00:00+00:00"
        assert file.session_description.startswith("open field. spikes simulated")
        assert file.notes == "Poisson spikes, peak rate 15 Hz, seed 7"
        assert file.units.description == f"simulated; {file.notes}"
    found = read_own_cells(tmp_path / "a.nwb")
    assert found.described.startswith("rat-3, 2024-05-01T08:00:00+00:00: 25 cells")
    np.testing.assert_allclose(found.recording.truth[:, :2], model.truth[:, :2])
    wrong = refused(capsys, "export", run, "-o", tmp_path / "b.nwb", "--about", "start=monday")
    assert "'monday' is no ISO time" in wrong
    assert "did you mean" in refused(capsys, "export", run, "-o", tmp_path / "b.nwb", "--about", "subject=3")
    assert not (tmp_path / "b.nwb").exists()


def test_the_exported_table_has_controls_unless_the_session_is_too_short_for_them(
    run: Path, model: CellRecording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said(capsys, "export", run, "-o", tmp_path / "a.csv", "--shuffles", 20)
    rows = table(tmp_path / "a.csv")
    controls = control_scores(model, 20)
    np.testing.assert_array_equal([float(row["grid_p95"]) for row in rows], controls["grid"].percentile)
    np.testing.assert_array_equal(
        [float(row["information_corrected"]) for row in rows], controls["information"].corrected
    )
    said(capsys, "export", run, "-o", tmp_path / "b.csv", "--shuffles", 0)
    assert not [name for name in table(tmp_path / "b.csv")[0] if name.endswith("_p95")]
    rows_ = model._replace(
        **{
            name: getattr(model, name)[:600]
            for name in ("time", "truth", "packet", "energy", "place", "activity")
        }
    )
    write_recording(run / "cells.npz", rows_)
    said(capsys, "export", run, "-o", tmp_path / "c.csv")
    assert not [name for name in table(tmp_path / "c.csv")[0] if name.endswith("_p95")]


def test_scores_and_maps_of_a_file_are_those_of_three_packages() -> None:
    found = own_data.compare_through_nwb(Task(41000, 6), 120.0)
    assert {row[:2]: row[3] for row in found if not row[3] <= 1e-6} == {}
    assert {package for _, package, *_ in found} == {"opexebo", "pynapple", "RatInABox"}
    assert len(found) == 18
