"""Real recordings as bags give the rows, and the maps, of tables that hold what their messages hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ratslam
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.sources.in_memory import InMemorySource
from tests.helpers import real_bags
from tests.helpers.ros_bags import write_bag

RECORDINGS = {"intel_laser": real_bags.intel, "create_lab": real_bags.create}
STORED = ("ros1", "sqlite3", "mcap")
COLUMNS = ("time", "motion", "moved", "views", "seen", "label", "truth")


def opened(**recording: Any) -> InMemorySource:
    source = open_recording(RecordingConfig.model_validate(recording), pytest.fail)
    assert isinstance(source, InMemorySource)
    return source


@pytest.mark.parametrize("name", RECORDINGS)
def test_rows_are_those_of_the_table_to_the_bit(name: str, reference_data: Path, tmp_path: Path) -> None:
    real = RECORDINGS[name](reference_data / "data", tmp_path)
    table = opened(file=tmp_path / "odometry.csv", table=real.table)
    assert table.seen.sum() > 0.9 * table.length
    for kind in STORED:
        (tmp_path / kind).mkdir()
        bag = opened(file=write_bag(tmp_path / kind, kind, real.entries), topics=real.topics)
        for column in COLUMNS:
            assert np.array_equal(getattr(bag, column), getattr(table, column), equal_nan=column == "truth")


def trajectory(name: str, out: Path, recording: dict[str, Any]) -> np.ndarray:
    """[N, 8] the mapped path of a run, as written."""
    config = ratslam.load_config(name)
    config = config.model_copy(update={"recording": RecordingConfig.model_validate(recording)})
    ratslam.run(config, out)
    return np.loadtxt(out / "trajectory.tum")


@pytest.mark.soak
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", RECORDINGS)
def test_maps_are_those_of_the_table_to_the_bit(
    name: str, reference_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Prints how far the map is from that of the original table, whose numbers have more or fewer digits."""
    monkeypatch.setenv("RATSLAM_DATA", str(reference_data))
    real = RECORDINGS[name](reference_data / "data", tmp_path)
    recording = {"file": tmp_path / "odometry.csv", "table": real.table}
    table = trajectory(name, tmp_path / "table", recording)
    for kind in STORED:
        (tmp_path / kind).mkdir()
        recording = {"file": write_bag(tmp_path / kind, kind, real.entries), "topics": real.topics}
        bag = trajectory(name, tmp_path / f"map_{kind}", recording)
        assert np.array_equal(bag, table)
    config = ratslam.load_config(name)
    ratslam.run(config, tmp_path / "original")
    original = np.loadtxt(tmp_path / "original" / "trajectory.tum")
    away = np.hypot(*(table - original)[:, 1:3].T)
    print(
        f"{name}: {np.sqrt(np.mean(away**2)):.3g} m RMS, at most {away.max():.3g} m from the original's map"
    )
    assert away.max() < 1e-4
