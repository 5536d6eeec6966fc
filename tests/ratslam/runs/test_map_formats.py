"""Map files of every format that was ever written: each is opened, continued and compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ratslam
from ratslam.runs.saved_map import FORMAT, read_map
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig

ROOT = Path(__file__).parents[3]
FILES = sorted((ROOT / "tests" / "data" / "maps").glob("*.npz"))
LARGEST = 200_000


def test_the_present_format_is_among_them() -> None:
    """`tests/data/maps/make_map.py` makes its file."""
    assert FORMAT in {file.stem for file in FILES}
    assert max(file.stat().st_size for file in FILES) < LARGEST


def test_moved_settings_of_an_earlier_map_are_read() -> None:
    config = read_map(FILES[0]).config
    assert (config.pose_cells.cells_xy, config.attractor.engine) == (11, "dense")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_map_of_any_format_goes_on(file: Path) -> None:
    expected = np.loadtxt(file.with_suffix(".csv"), delimiter=",")
    saved = read_map(file)
    assert saved.sensor.describe() == "whisker head, 18 whiskers; views of 3 x 6 x 1, values in 0..1"
    slam = ratslam.Slam.load(file)
    assert slam.steps == saved.steps > 0
    with open_recording(RecordingConfig(file=ROOT / "tests" / "golden" / "touch_circuits.mcap")) as recording:
        readings = [sample.reading for sample in recording]
    for reading in readings[saved.steps : len(expected)]:
        slam.step(reading)
    assert len(slam.map.closures()) > 0
    np.testing.assert_allclose(slam.trajectory(), expected, rtol=0, atol=1e-6)
