"""Messages of a robot that drives for 1.1 s, and how its bag is written and read."""

from itertools import chain, count

import numpy as np
import pytest

from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tests.helpers.ros_bags import odometry, quaternion, scan, tf, transform, write_bag

START, STEP = 1_700_000_000_123_456_789, 100_000_000  # ns
TIMES = [START + STEP * row for row in range(12)]
PATH = np.column_stack([0.1 * np.arange(12), 0.02 * np.arange(12), 0.05 * np.arange(12)])
WHEELS = [odometry(time, *row) for time, row in zip(TIMES, PATH.tolist(), strict=True)]
SCANS = [scan(time, np.arange(1, 19) * 0.25, -1.5, 3.0 / 18) for time in TIMES]


def link(parent, child, yaw=0.0, x=0.0, topic="/tf_static"):
    return tf(START, transform(START, parent, child, x, 0.0, quaternion(yaw)), topic=topic)


def framed(parent, child, path=PATH, times=TIMES):
    rows = zip(times, path.tolist(), strict=True)
    return [tf(time, transform(time, parent, child, x, y, quaternion(yaw))) for time, (x, y, yaw) in rows]


def opened(path, told=None, **settings):
    """Reads a bag with these topics and other settings; warnings are appended to `told`."""
    other = {key: settings.pop(key) for key in ("image", "visual_odometry", "to") if key in settings}
    recording = {"file": path, "topics": {"odometry": "/odom"} | settings} | other
    return open_recording(RecordingConfig.model_validate(recording), None if told is None else told.append)


@pytest.fixture
def write(tmp_path):
    """Writes lists of messages, in the order of their receipt, to a bag in a new folder."""
    numbers = count()

    def call(*parts, kind="mcap", little_endian=True):
        folder = tmp_path / str(next(numbers))
        folder.mkdir()
        entries = sorted(chain(*parts), key=lambda entry: entry.time)
        return write_bag(folder, kind, entries, little_endian=little_endian)

    return call
