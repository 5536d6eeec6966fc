"""The description of a bag says what is in it, and the settings that follow from it read the bag."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.recordings.bags.bag_description import Shape, describe_bag, suggested_topics
from tests.helpers.ros_bags import Entry, header, image, odometry, pose, scan
from tests.robot.recordings.bags.conftest import START, STEP, framed, opened

TIMES = [START + STEP * row for row in range(20)]
LINE = np.column_stack([0.1 * np.arange(20), np.zeros(20), np.zeros(20)])
WHEELS = [odometry(time, 0.1 * row, 0.0, 0.05 * row, (1.0, 0.0, 0.5)) for row, time in enumerate(TIMES)]
SCANS = [scan(time, [np.inf, np.nan, 2.0, 2.0], -0.2, 0.1, range_max=30.0) for time in TIMES[::2]]


def stamped(topic: str, kind: str, fields: Callable[[int, int], dict[str, Any]]) -> list[Entry]:
    return [Entry(topic, kind, time, fields(row, time)) for row, time in enumerate(TIMES)]


def along(parent: str, child: str) -> list[Entry]:
    return framed(parent, child, LINE, TIMES)


SKIN = stamped("/skin", "std_msgs/msg/Float64MultiArray", lambda row, _: {"data": [200.0, 900.0 + row]})
MOCAP = lambda _, time: {"header": header(time), "pose": pose(0, 0, 0)}  # noqa: E731
TRUE = stamped("/mocap/pose", "geometry_msgs/msg/PoseStamped", MOCAP)
FRAMES = along("odom", "base_link")
IMAGES = [image(time, np.full((12, 60), 7, np.uint8)) for time in range(START, TIMES[-1], STEP // 3)]
Write = Callable[..., Path]


def test_topics_are_described(write: Write) -> None:
    custom = [Entry("/lab", "lab_msgs/msg/Custom", time, {}) for time in TIMES[:3]]
    bag = describe_bag(write(WHEELS, SCANS, SKIN, IMAGES, FRAMES, custom))
    topics = {topic.name: topic for topic in bag.topics}
    assert {name: topic.roles for name, topic in topics.items()} == {
        "/image": ("views",), "/lab": (), "/odom": ("odometry", "truth"), "/scan": ("views",),
        "/skin": ("touch",), "/tf": (),
    }  # fmt: skip
    shapes = {name: topic.shape or Shape("") for name, topic in topics.items()}
    assert shapes["/scan"][:2] == ("4 beams over 23 degrees, median 2 m, 25% empty", (4,))
    assert (shapes["/scan"].high, shapes["/scan"].wider) == (30.0, False)
    assert shapes["/scan"].extent == pytest.approx((-0.05, 0.4, 0.1))
    assert shapes["/image"][:2] == ("60 x 12 mono8, mean grey 7", (60, 12))
    assert shapes["/skin"][:4] == ("2 values from 200 to 919", (2,), 200.0, 919.0)
    assert (topics["/lab"].total, topics["/lab"].shape) == (3, None)
    wheels = topics["/odom"]
    assert (wheels.frame, wheels.child, wheels.total) == ("odom", "base_link", 20)
    assert (wheels.stamped.rate_hz, wheels.stamped.gap) == (10.0, 0.1)
    assert shapes["/odom"].words == "1.9 m at 1 m/s"
    assert (shapes["/odom"].pose_path, shapes["/odom"].twist_path) == pytest.approx((1.9, 1.9))
    assert bag.links == (("odom", "base_link", False, 20),)


def test_faults_of_a_topic_are_described(write: Write) -> None:
    spoilt = [entry._replace(topic="/bad", fields=entry.fields | {"encoding": "yuv"}) for entry in IMAGES]
    stamps = [TIMES[0], 0, TIMES[5], TIMES[5], TIMES[2], TIMES[15]]
    disorder = [
        odometry(stamp, 0, 0, 0)._replace(time=time) for stamp, time in zip(stamps, TIMES, strict=False)
    ]
    topics = {topic.name: topic for topic in describe_bag(write(spoilt, disorder)).topics}
    assert topics["/bad"].roles == ()
    assert "encoding 'yuv'" in topics["/bad"].fault
    found = topics["/odom"].stamped
    assert (found.zero, found.repeated, found.backwards, found.in_order) == (1, 1, 2, False)
    assert found.gap == pytest.approx(START / 1e9 + 0.5)


RAYS = {"topic": "/scan", "rows": 1, "columns": 4}
STILL = [odometry(time, 0, 0, 0, (1.0, 0.0, 0.5)) for time in TIMES]
UNSTAMPED = [odometry(0, 0.1 * row, 0, 0)._replace(time=time) for row, time in enumerate(TIMES)]


BEFORE_B = [SCANS[0]._replace(fields=dict(SCANS[0].fields) | {"header": header(START, "b/laser")})]
TWO = [along("a_odom_combined", "a_base"), along("b/odom", "b/base_link"), BEFORE_B]
ROBOT = ["robot1/odom", "robot1/base_footprint"]
TAXELS, WIDE = (
    {"topic": "/skin", "low": 200.0, "high": 919.0},
    RAYS | {"columns": 14, "span": [-0.625, 0.575]},
)
SUGGESTED: dict[str, tuple[list[list[Entry]], dict[str, Any]]] = {
    "scan": ([WHEELS, SCANS, IMAGES, TRUE], {"odometry": "/odom", "views": RAYS, "truth": "/mocap/pose"}),
    "images": ([WHEELS, IMAGES], {"odometry": "/odom", "views": "/image", "samples": "views"}),
    "touch": ([WHEELS, SKIN], {"odometry": "/odom", "touch": TAXELS}),
    "frames": ([FRAMES, SCANS], {"odometry": {"tf": ["odom", "base_link"]}, "views": RAYS}),
    "frames of a robot": ([along(*ROBOT), SCANS], {"odometry": {"tf": ROBOT}, "views": RAYS}),
    "frames of two": (TWO, {"odometry": {"tf": ["b/odom", "b/base_link"]}, "views": RAYS}),
    "frames of none": ([along("map", "odom"), along("a/odom", "b/base_link"), SCANS], {}),
    "scans that vary": ([WHEELS, SCANS[:1], [scan(TIMES[5], [2.0] * 24, -0.6, 0.05)]],
                        {"odometry": "/odom", "views": WIDE}),
    "velocities": ([STILL], {"odometry": {"topic": "/odom", "use": "twist"}}),
    "no stamps": ([UNSTAMPED], {"odometry": "/odom", "clock": "bag"}),
    "nothing": ([SCANS], {}),
}  # fmt: skip


@pytest.mark.parametrize("case", SUGGESTED)
def test_suggested_settings_read_the_bag(case: str, write: Write) -> None:
    parts, expected = SUGGESTED[case]
    path = write(*parts)
    topics = suggested_topics(describe_bag(path))
    assert topics == expected
    if topics:
        assert len(opened(path, **topics).time) >= 20


def test_a_turtlebot_is_read(reference_data: Path) -> None:
    """A real ring, mounted a quarter turn to the left."""
    path, told = reference_data / "bags" / "turtlebot4_first_floor", list[str]()
    bag = describe_bag(path)
    ring = next(topic.shape for topic in bag.topics if topic.name == "/scan")
    assert ring.words.startswith("720 beams all around")
    assert ring.words.endswith("24% empty")
    settings = suggested_topics(bag)
    assert settings == {"odometry": "/odom", "views": "/scan"}
    views = opened(path, told, **settings)
    assert (views.length, views.seen.sum()) == (920, 355)
    assert len(told) == 1
    assert "/scan: 2 of 357 views" in told[0]
    size = {"topic": "/scan", "rows": 1, "columns": 8}
    ahead, mounted = (opened(path, views=part).views[9].ravel() for part in (size | {"yaw": 0.0}, size))
    assert np.allclose(np.roll(ahead, 2), mounted, atol=0.1)
