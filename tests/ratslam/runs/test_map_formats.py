"""Map files of every format that was ever written: each is opened, continued and compared."""

from pathlib import Path

import numpy as np
import pytest

import ratslam
from ratslam.methods.map_file import FORMAT
from ratslam.runs.saved_map import read_map
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig

ROOT = Path(__file__).parents[3]
FILES = sorted((ROOT / "tests" / "data" / "maps").glob("*.npz"))
LARGEST = 200_000


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_map_of_any_format_goes_on(file: Path) -> None:
    """`tests/data/maps/make_map.py` makes the file of the present one."""
    assert FORMAT in {one.stem for one in FILES}
    assert file.stat().st_size < LARGEST
    expected, saved = np.loadtxt(file.with_suffix(".csv"), delimiter=","), read_map(file)
    engine = "window" if file == FILES[-1] else "dense"  # moved since the first
    assert (saved.config.pose_cells.cells_xy, saved.config.attractor.engine) == (11, engine)
    assert saved.sensor.describe() == "whisker head, 18 whiskers; views of 3 x 6 x 1, values in 0..1"
    slam = ratslam.Slam.load(file)
    assert slam.steps == saved.steps > 0
    with open_recording(RecordingConfig(file=ROOT / "tests" / "golden" / "touch_circuits.mcap")) as recording:
        readings = [sample.reading for sample in recording]
    for reading in readings[saved.steps : len(expected)]:
        slam.step(reading)
    assert len(slam.map.closures()) > 0
    np.testing.assert_allclose(slam.trajectory(), expected, rtol=0, atol=1e-6)
