"""Every message type, in every kind of bag, gives the samples that it stands for."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from robot.sources.in_memory import InMemorySource
from robot.sources.odometry import from_poses, from_velocities
from tactile.base.errors import InputError
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
)
from tests.robot.recordings.bags.conftest import (
    PATH,
    SCANS,
    SECONDS,
    START,
    STEP,
    TIMES,
    WHEELS,
    framed,
    link,
    opened,
)

LATER = 5_000_000  # ns between a measurement and its receipt
Write = Callable[..., Path]


def read(path: Path, told: list[str] | None = None, **settings: Any) -> InMemorySource:
    """Reads a bag; unless warnings are told there are none."""
    found: list[str] = []
    source = opened(path, found if told is None else told, **settings)
    assert found == []
    return source


def stamped(kind: str, fields: Callable[[int], dict[str, Any]]) -> list[Entry]:
    return [
        Entry("/topic", kind, time + LATER, {"header": header(time, "odom")} | fields(row))
        for row, time in enumerate(TIMES)
    ]


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_bag_gives_the_same_rows(kind: str, little_endian: bool, write: Write) -> None:
    if kind.startswith("ros1") and not little_endian:
        return
    custom = [Entry("/lab", "lab_msgs/msg/Custom", TIMES[3], {"energy": 1.0, "note": "unused"})]
    source = read(write(WHEELS, SCANS, custom, kind=kind, little_endian=little_endian), views="/scan")
    assert np.array_equal(source.time, SECONDS)
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    assert source.views[4].ravel() == pytest.approx(np.arange(1, 19) * 0.25 / 8)
    assert source.seen.all()


POSES: dict[str, Callable[[int], dict[str, Any]]] = {
    "PoseStamped": lambda row: {"pose": pose(*PATH[row])},
    "PoseWithCovarianceStamped": lambda row: {"pose": {"pose": pose(*PATH[row])}},
    "TransformStamped": lambda row: {
        "transform": transform(0, "", "", *PATH[row][:2], quaternion(PATH[row][2]))["transform"]
    },
}


@pytest.mark.parametrize("kind", POSES)
def test_poses_are_odometry_and_truth_by_the_clock_of_the_header_or_of_the_bag(kind, write):
    entries = stamped(f"geometry_msgs/msg/{kind}", POSES[kind])
    source = read(write(entries, kind="ros1"), odometry="topic", truth="topic")
    assert np.array_equal(source.time, SECONDS)
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    assert source.truth == pytest.approx(PATH)
    source = read(write(entries), odometry="/topic", clock="bag")
    assert np.array_equal(source.time, [(time + LATER) / 10**9 for time in TIMES])


def test_velocities_hold_since_the_message_before(write: Write) -> None:
    rates = np.column_stack([0.1 * np.arange(12), np.full(12, 0.05), np.full(12, 0.3)])
    expected = from_velocities(SECONDS, *rates.T)

    def fields(row: int) -> dict[str, Any]:
        forward, left, turn = rates[row].tolist()
        return {"twist": {"linear": {"x": forward, "y": left}, "angular": {"z": turn}}}

    source = read(write(stamped("geometry_msgs/msg/TwistStamped", fields)), odometry="/topic")
    assert np.array_equal(source.motion, expected)
    wheels = [odometry(time, 0, 0, 0, tuple(rate)) for time, rate in zip(TIMES, rates.tolist(), strict=True)]
    source = read(write(wheels, kind="sqlite3"), odometry={"topic": "/odom", "use": "twist"})
    assert np.array_equal(source.motion, expected)


def test_several_messages_can_make_one_sample(write: Write) -> None:
    source = read(write(WHEELS), odometry={"topic": "/odom", "every": 4})
    assert np.array_equal(source.time, SECONDS[::4])
    assert source.motion == pytest.approx(from_poses(SECONDS[::4], PATH[::4]), abs=1e-12)


def test_frames_are_odometry_and_truth(write: Write) -> None:
    """odom to base_link at 10 Hz; map to odom drifts at a third of the rate; base_link is a child of base."""
    drift = np.array([[0.3 * number, 0.0, np.pi / 2] for number in range(4)])
    entries = [*framed("odom", "base"), *framed("map", "odom", drift, TIMES[::3])]
    entries.append(link("base", "base_link", x=0.5))
    source = read(write(entries), odometry={"tf": ["odom", "base"]}, truth={"tf": ["map", "base_link"]})
    assert source.motion == pytest.approx(from_poses(SECONDS, PATH), abs=1e-12)
    ahead = PATH[:, :2] + 0.5 * np.column_stack([np.cos(PATH[:, 2]), np.sin(PATH[:, 2])])
    assert source.truth[:10, 0] == pytest.approx((0.1 * np.arange(12) - ahead[:, 1])[:10], abs=1e-6)
    assert source.truth[:10, 1] == pytest.approx(ahead[:10, 0])
    assert source.truth[:10, 2] == pytest.approx(PATH[:10, 2] + np.pi / 2)
    assert np.isnan(source.truth[10:]).all()  # after the last transform of map to odom
    upwards = read(write(entries, kind="ros1"), odometry={"tf": ["base", "odom"]})
    assert upwards.motion[:, 2] == pytest.approx(-source.motion[:, 2])


def test_touch_of_joints_named_in_any_order(write: Write) -> None:
    def fields(row: int) -> dict[str, Any]:
        names = ["wheel", "left", "right"] if row % 2 else ["right", "wheel", "left"]
        values = {"wheel": 40.0, "left": 0.1 * row, "right": 1.0}
        return {"name": names, "position": [0.0] * 3, "effort": [values[name] for name in names]}

    kind = "sensor_msgs/msg/JointState"
    other = [Entry("/topic", kind, START + 1, {"header": header(START), "name": ["wheel"]})]
    touch = {"topic": "/topic", "use": "effort", "joints": ["left", "right"], "high": 2.0, "columns": 2}
    source = read(write(WHEELS, stamped(kind, fields), other), touch=touch)
    assert (source.view_shape, source.whiskers) == ((1, 2, 1), 2)
    assert source.views[3].ravel() == pytest.approx([0.15, 0.5])


@pytest.mark.parametrize("number", [32, 64])
def test_touch_of_arrays_by_their_layout(number: int, write: Write) -> None:
    layout = {"dim": [{"label": "ring", "size": 2}, {"label": "whisker", "size": 3}], "data_offset": 1}
    fields = {"layout": layout, "data": [9, 1, 2, 3, 4, 5, 6]}
    arrays = [Entry("/skin", f"std_msgs/msg/Float{number}MultiArray", time, fields) for time in TIMES]
    path = write(WHEELS, arrays)
    source = read(path, touch={"topic": "/skin", "low": 1.0, "high": 6.0})
    assert source.views[2, :, :, 0] == pytest.approx(np.array([[0.0, 0.2, 0.4], [0.6, 0.8, 1.0]]))
    assert source.whiskers == 6
    views = read(path, touch={"topic": "/skin", "rows": 3, "high": 6.0}, samples="views")
    assert (views.length, views.view_shape) == (12, (3, 2, 1))


def test_views_faster_than_the_odometry_can_be_the_samples(write: Write) -> None:
    moments = range(START - STEP, TIMES[-1], STEP // 4)
    path, told = write(WHEELS, [scan(t, np.full(18, 1.0), -1.5, 0.1) for t in moments]), list[str]()
    source = read(path, told, views="/scan", samples="views")
    assert source.length == 44
    assert source.seen.all()
    assert np.hypot(*source.motion[1:, :2].T) == pytest.approx(np.hypot(0.1, 0.02) / 4, rel=1e-4)
    assert source.motion[:, 2].sum() == pytest.approx(0.05 * (11 - 0.25))
    assert len(told) == 1
    assert "/scan: 4 of 48 views" in told[0]
    assert read(path, told, views="/scan").seen.sum() == 12
    assert "farther from their sample than another" in told[-1]


def test_the_topics_of_openratslam_are_a_preset(write: Write) -> None:
    wheels = [odometry(time, 0, 0, 0, (0.5, 0, 0))._replace(topic="/irat_red/odom") for time in TIMES]
    grey = np.full((24, 80), 51, np.uint8)
    images = [image(time, grey, topic="/irat_red/camera/image") for time in TIMES]
    source = read(write(wheels, images), odometry=None, openratslam="irat_red")
    assert source.motion[5, 0] == pytest.approx(0.05)
    assert source.view_shape == (12, 60, 1)
    assert source.views[5] == pytest.approx(0.2)


@pytest.mark.parametrize("stored", ["ros1", "mcap"])
def test_a_camera_alone_gives_views_and_odometry(stored: str, write: Write) -> None:
    """Compressed images, as OpenRatSLAM's users record them, of a turn by 6 degrees to the left a step."""
    scene = np.random.default_rng(1).integers(0, 255, 120, dtype=np.uint8)

    def fields(row: int) -> dict[str, Any]:
        file = io.BytesIO()
        Image.fromarray(np.tile(np.roll(scene, 2 * row), (24, 1))).save(file, "PNG")
        return {"format": "png", "data": np.frombuffer(file.getvalue(), np.uint8)}

    source = read(
        write(stamped("sensor_msgs/msg/CompressedImage", fields), kind=stored),
        visual_odometry={"fov_deg": 360},
        image={"rows": 2, "columns": 12},
        odometry=None,
        views="/topic",
    )
    assert (source.length, source.view_shape) == (12, (2, 12, 1))
    assert np.array_equal(source.time, SECONDS)
    assert np.rad2deg(source.motion[1:, 2]) == pytest.approx(6.0)
    blocks = np.roll(scene, 6).reshape(12, 10).mean(axis=1) / 255
    assert source.views[3, :, :, 0] == pytest.approx(np.tile(blocks, (2, 1)))


def test_a_missing_library_is_named(write: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(WHEELS)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(InputError, match=r"rosbags: not installed; pip install 'ratslam\[ros\]'"):
        read(path)


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("topic", ["/tf_static", "/robot/tf_static", "/tf"])
def test_a_ring_is_mounted_by_the_frames(named: bool, topic: str, write: Write) -> None:
    """A laser that looks to the left, on a plate on the robot; something near is on its axis."""
    child = {"child_frame_id": "/base_link" if named else ""}
    wheels = [entry._replace(fields=dict(entry.fields) | child) for entry in WHEELS]
    ranges = np.full(360, 4.0)
    ranges[140:220] = 1.0
    links = tf(
        START,
        transform(START, "base_link", "plate", 0.1, 0.0, quaternion(np.pi / 4)),
        transform(START, "plate", "laser", 0.1, 0.0, quaternion(np.pi / 4)),
        topic=topic,
    )
    path = write([links], wheels, [scan(time, ranges, -np.pi, np.pi / 180) for time in TIMES])
    view = {"topic": "/scan", "rows": 1, "columns": 4, "max_range": 4.0}
    assert np.flatnonzero(read(path, views=view).views[3].ravel() < 0.9).tolist() == [2, 3]
    told: list[str] = []
    other = read(path, told, views=view, body="somewhere")
    assert np.flatnonzero(other.views[3].ravel() < 0.9).tolist() == [1, 2]
    assert "no transform from somewhere to laser" in told[0]
