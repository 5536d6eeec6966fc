"""Every message type, in every kind of bag, gives the samples that it stands for."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ratslam.examples import taxel_array
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.odometry import from_poses, from_velocities
from robot.touch_source import TOUCH, open_touch_source
from tactile.base.errors import InputError
from tactile.frontend import TouchConfig
from tests.helpers.ros_bags import (
    KINDS,
    Entry,
    header,
    image,
    odometry,
    pose,
    quaternion,
    scan,
    tf,
    transform,
    write_bag,
)

START, STEP = 1_700_000_000_123_456_789, 100_000_000  # ns
TIMES = [START + STEP * row for row in range(12)]
SECONDS = np.array([time / 10**9 for time in TIMES])
PATH = np.column_stack([0.1 * np.arange(12), 0.02 * np.arange(12), 0.05 * np.arange(12)])
WHEELS = [odometry(time, *row) for time, row in zip(TIMES, PATH.tolist(), strict=True)]
LATER = 5_000_000  # ns between a measurement and its receipt
Read = Callable[..., InMemorySource]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Writes messages to a bag and reads it; warnings are appended to `told`, else they fail."""

    def call(
        entries: Sequence[Entry],
        kind: str = "mcap",
        told: list[str] | None = None,
        recording: dict[str, Any] | None = None,
        **topics: Any,
    ) -> InMemorySource:
        folder = tmp_path / kind
        folder.mkdir()
        path = write_bag(folder, kind, entries)
        config = RecordingConfig.model_validate(
            {"file": path, "topics": {"odometry": "/odom"} | topics} | (recording or {})
        )
        source = open_recording(config, pytest.fail if told is None else told.append)
        assert isinstance(source, InMemorySource)
        return source

    return call


def stamped(kind: str, fields: Callable[[int], dict[str, Any]], frame: str = "odom") -> list[Entry]:
    """Messages with a header, received later than measured."""
    return [
        Entry("/topic", kind, time + LATER, {"header": header(time, frame)} | fields(row))
        for row, time in enumerate(TIMES)
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_the_same_rows(kind: str, read: Read) -> None:
    scans = [scan(time, np.arange(1, 19) * 0.25, -1.5, 3.0 / 18) for time in TIMES]
    custom = [Entry("/lab", "lab_msgs/msg/Custom", TIMES[3], {"energy": 1.0, "note": "unused"})]
    source = read(sorted([*WHEELS, *scans, *custom], key=lambda entry: entry.time), kind, views="/scan")
    assert np.array_equal(source.time, SECONDS)
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    assert source.views[4].ravel() == pytest.approx(np.arange(1, 19) * 0.25 / 8)
    assert source.seen.all()


POSES = {
    "geometry_msgs/msg/PoseStamped": lambda row: {"pose": pose(*PATH[row])},
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda row: {"pose": {"pose": pose(*PATH[row])}},
    "geometry_msgs/msg/TransformStamped": lambda row: {
        "transform": {
            "translation": {"x": PATH[row][0], "y": PATH[row][1]},
            "rotation": quaternion(PATH[row][2]),
        }
    },
}


@pytest.mark.parametrize("kind", POSES)
@pytest.mark.parametrize("stored", ["ros1", "sqlite3"])
def test_poses_are_odometry_and_truth(kind: str, stored: str, read: Read) -> None:
    source = read(stamped(kind, POSES[kind]), stored, odometry="topic", truth="topic")
    assert np.array_equal(source.time, SECONDS)
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    assert source.truth == pytest.approx(PATH)


def test_velocities_hold_since_the_message_before(read: Read) -> None:
    rates = np.column_stack([0.1 * np.arange(12), np.full(12, 0.05), np.full(12, 0.3)])
    expected = from_velocities(SECONDS, *rates.T)

    def fields(row: int) -> dict[str, Any]:
        forward, left, turn = rates[row].tolist()
        return {"twist": {"linear": {"x": forward, "y": left}, "angular": {"z": turn}}}

    source = read(stamped("geometry_msgs/msg/TwistStamped", fields), odometry="/topic")
    assert np.array_equal(source.motion, expected)
    wheels = [odometry(time, 0, 0, 0, tuple(rate)) for time, rate in zip(TIMES, rates.tolist(), strict=True)]
    source = read(wheels, "sqlite3", odometry={"topic": "/odom", "use": "twist"})
    assert np.array_equal(source.motion, expected)


def test_several_messages_can_make_one_sample(read: Read) -> None:
    source = read(WHEELS, odometry={"topic": "/odom", "every": 4})
    assert np.array_equal(source.time, SECONDS[::4])
    assert source.motion == pytest.approx(from_poses(SECONDS[::4], PATH[::4]), abs=1e-12)


def test_the_clock_is_that_of_the_header_or_of_the_bag(read: Read) -> None:
    entries = stamped("geometry_msgs/msg/PoseStamped", POSES["geometry_msgs/msg/PoseStamped"])
    assert read(entries, odometry="/topic").time[0] == START / 1e9
    source = read(entries, "ros1", odometry="/topic", clock="bag")
    assert np.array_equal(source.time, [(time + LATER) / 10**9 for time in TIMES])


def test_frames_are_odometry_and_truth(read: Read) -> None:
    """odom to base_link at 10 Hz; map to odom drifts at a third of the rate; base_link is a child of base."""
    entries = [
        tf(time, transform(time, "odom", "base", x, y, quaternion(yaw)))
        for time, (x, y, yaw) in zip(TIMES, PATH.tolist(), strict=True)
    ]
    drift = [(time, 0.3 * number) for number, time in enumerate(TIMES[::3])]
    entries += [tf(time, transform(time, "map", "odom", x, 0.0, quaternion(np.pi / 2))) for time, x in drift]
    entries.append(
        tf(START, transform(0, "base", "base_link", 0.5, 0.0, quaternion(0.0)), topic="/tf_static")
    )
    entries.sort(key=lambda entry: entry.time)
    links = {"odometry": {"tf": ["odom", "base"]}, "truth": {"tf": ["map", "base_link"]}}
    source = read(entries, **links)
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    assert source.truth is not None
    ahead = PATH[:, :2] + 0.5 * np.column_stack([np.cos(PATH[:, 2]), np.sin(PATH[:, 2])])
    assert source.truth[:10, 0] == pytest.approx((0.1 * np.arange(12) - ahead[:, 1])[:10], abs=1e-6)
    assert source.truth[:10, 1] == pytest.approx(ahead[:10, 0])
    assert source.truth[:10, 2] == pytest.approx(PATH[:10, 2] + np.pi / 2)
    assert np.isnan(source.truth[10:]).all()  # after the last transform of map to odom
    upwards = read(entries, "ros1", odometry={"tf": ["base", "odom"]})
    assert upwards.motion[:, 2] == pytest.approx(-source.motion[:, 2])


def test_touch_of_joints_named_in_any_order(read: Read) -> None:
    def fields(row: int) -> dict[str, Any]:
        names = ["wheel", "left", "right"] if row % 2 else ["right", "wheel", "left"]
        values = {"wheel": 40.0, "left": 0.1 * row, "right": 1.0}
        return {"name": names, "position": [0.0] * 3, "effort": [values[name] for name in names]}

    joints = stamped("sensor_msgs/msg/JointState", fields)
    joints += [
        Entry("/topic", "sensor_msgs/msg/JointState", START + 1, {"header": header(START), "name": ["wheel"]})
    ]
    entries = sorted([*WHEELS, *joints], key=lambda entry: entry.time)
    touch = {"topic": "/topic", "use": "effort", "joints": ["left", "right"], "high": 2.0, "columns": 2}
    source = read(entries, touch=touch)
    assert (source.view_shape, source.whiskers) == ((1, 2, 1), 2)
    assert source.views[3].ravel() == pytest.approx([0.15, 0.5])


@pytest.mark.parametrize("number", [32, 64])
def test_touch_of_arrays_by_their_layout(number: int, read: Read) -> None:
    layout = {"dim": [{"label": "ring", "size": 2}, {"label": "whisker", "size": 3}], "data_offset": 1}
    arrays = [
        Entry(
            "/skin",
            f"std_msgs/msg/Float{number}MultiArray",
            time,
            {"layout": layout, "data": [9, 1, 2, 3, 4, 5, 6]},
        )
        for time in TIMES
    ]
    entries = sorted([*WHEELS, *arrays], key=lambda entry: entry.time)
    source = read(entries, touch={"topic": "/skin", "low": 1.0, "high": 6.0})
    assert source.views[2, :, :, 0] == pytest.approx(np.array([[0.0, 0.2, 0.4], [0.6, 0.8, 1.0]]))
    assert source.whiskers == 6
    wide = read(entries, "ros1", touch={"topic": "/skin", "rows": 3, "high": 6.0})
    assert wide.view_shape == (3, 2, 1)


def test_views_faster_than_the_odometry_can_be_the_samples(read: Read) -> None:
    moments = range(START - STEP, TIMES[-1], STEP // 4)
    scans = [scan(time, np.full(18, 1.0), -1.5, 0.1) for time in moments]
    entries = sorted([*WHEELS, *scans], key=lambda entry: entry.time)
    told: list[str] = []
    source = read(entries, "mcap", told, views="/scan", samples="views")
    assert source.length == 44
    assert source.seen.all()
    assert source.motion[1:, 0] == pytest.approx(0.025 * np.cos(0.0) + 0 * source.motion[1:, 0], abs=0.005)
    assert source.motion[:, 2].sum() == pytest.approx(0.05 * (11 - 0.25))
    assert len(told) == 1
    assert "/scan: 4 of 48 views" in told[0]
    told.clear()
    assert read(entries, "ros1", told, views="/scan").seen.sum() == 12
    assert "farther from their sample than another" in told[-1]


def test_the_topics_of_openratslam_are_a_preset(read: Read) -> None:
    wheels = [entry._replace(topic="/irat_red/odom") for entry in WHEELS]
    for entry in wheels:
        entry.fields["twist"]["twist"]["linear"]["x"] = 0.5
    grey = np.full((24, 80), 51, np.uint8)
    images = [image(time, grey, topic="/irat_red/camera/image") for time in TIMES]
    entries = sorted([*wheels, *images], key=lambda entry: entry.time)
    source = read(entries, odometry=None, openratslam="irat_red")
    assert source.motion[5, 0] == pytest.approx(0.05)
    assert source.view_shape == (12, 60, 1)
    assert source.views[5] == pytest.approx(0.2)


def panorama(row: int) -> np.ndarray:
    """[24, 120] what a camera sees after turning by 6 degrees to the left in each step."""
    scene = np.random.default_rng(1).integers(0, 255, 120, dtype=np.uint8)
    return np.tile(np.roll(scene, 2 * row), (24, 1))


@pytest.mark.parametrize("stored", ["ros1", "mcap"])
def test_a_camera_alone_gives_views_and_odometry(stored: str, read: Read) -> None:
    """Compressed images, as OpenRatSLAM's users record them."""

    def fields(row: int) -> dict[str, Any]:
        file = io.BytesIO()
        Image.fromarray(panorama(row)).save(file, "PNG")
        return {"format": "png", "data": np.frombuffer(file.getvalue(), np.uint8)}

    source = read(
        stamped("sensor_msgs/msg/CompressedImage", fields),
        stored,
        recording={"visual_odometry": {"fov_deg": 360}, "image": {"rows": 2, "columns": 12}},
        odometry=None,
        views="/topic",
    )
    assert (source.length, source.view_shape) == (12, (2, 12, 1))
    assert np.array_equal(source.time, SECONDS)
    assert np.rad2deg(source.motion[1:, 2]) == pytest.approx(6.0)
    blocks = panorama(3).reshape(2, 12, 12, 10).mean(axis=(1, 3)) / 255
    assert source.views[3, :, :, 0] == pytest.approx(blocks)


def test_touch_can_be_turned_into_views_by_a_front_end(read: Read, monkeypatch: pytest.MonkeyPatch) -> None:
    """The taxel array of the examples: the largest pressures of several readings make one view."""
    monkeypatch.setitem(TOUCH.builtin, "taxels", taxel_array.ENTRY)
    skin = [
        Entry("/skin", "std_msgs/msg/Float32MultiArray", time + row, {"data": np.full(66, 0.1 + 0.01 * row)})
        for row, time in enumerate(range(START, TIMES[-1], STEP // 5))
    ]
    entries = sorted([*WHEELS, *skin], key=lambda entry: entry.time)
    source = read(entries, touch={"topic": "/skin", "rows": 3, "columns": 22}, samples="views")
    frontend = {"plugin": "taxels", "settings": {"frames": 10}}
    made = list(open_touch_source(source, TouchConfig.model_validate({"frontend": frontend})))
    assert [float(sample.reading.view.max()) for sample in made] == pytest.approx(
        [0.19, 0.29, 0.39, 0.49, 0.59]
    )
    assert sum(float(sample.reading.odometry.dtheta) for sample in made) == pytest.approx(
        0.05 * 9.8, abs=1e-3
    )


def test_a_missing_library_is_named(read: Read, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(InputError, match=r"rosbags: not installed; pip install 'ratslam\[ros\]'"):
        read(WHEELS)


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("topic", ["/tf_static", "/robot/tf_static", "/tf"])
def test_a_ring_is_mounted_by_the_frames(named: bool, topic: str, read: Read) -> None:
    """A laser that looks to the left, on a plate on the robot; something near is on its axis."""
    wheels = [entry._replace(fields=dict(entry.fields)) for entry in WHEELS]
    for entry in wheels:
        entry.fields["child_frame_id"] = "/base_link" if named else ""
    step = 2 * np.pi / 360
    ranges = np.full(360, 4.0)
    ranges[140:220] = 1.0
    scans = [scan(time, ranges, -np.pi, step) for time in TIMES]
    links = tf(
        START,
        transform(START, "base_link", "plate", 0.1, 0.0, quaternion(np.pi / 4)),
        transform(START, "plate", "laser", 0.1, 0.0, quaternion(np.pi / 4)),
        topic=topic,
    )
    entries = sorted([links, *wheels, *scans], key=lambda entry: entry.time)
    view = {"topic": "/scan", "rows": 1, "columns": 4, "max_range": 4.0}
    assert np.flatnonzero(read(entries, views=view).views[3].ravel() < 0.9).tolist() == [2, 3]
    told: list[str] = []
    other = read(entries, "ros1", told, views=view, body="somewhere")
    assert np.flatnonzero(other.views[3].ravel() < 0.9).tolist() == [1, 2]
    assert "no transform from somewhere to laser" in told[0]
