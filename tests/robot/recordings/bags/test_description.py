"""The description of a bag says what is in it, and the settings that follow from it read the bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.recordings.bags.bag_description import Shape, describe_bag, suggested_topics
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tests.helpers.ros_bags import (
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

START, STEP = 1_700_000_000_000_000_000, 100_000_000  # ns
TIMES = [START + STEP * row for row in range(20)]
WHEELS = [odometry(time, 0.1 * row, 0.0, 0.05 * row, (1.0, 0.0, 0.5)) for row, time in enumerate(TIMES)]
SCANS = [scan(time, [np.inf, np.nan, 2.0, 2.0], -0.2, 0.1, range_max=30.0) for time in TIMES[::2]]
SKIN = [
    Entry("/skin", "std_msgs/msg/Float64MultiArray", time, {"data": [200.0, 900.0 + row]})
    for row, time in enumerate(TIMES)
]
TRUE = [
    Entry(
        "/mocap/pose", "geometry_msgs/msg/PoseStamped", time, {"header": header(time), "pose": pose(0, 0, 0)}
    )
    for time in TIMES
]
FRAMES = [tf(time, transform(time, "odom", "base_link", 0.1, 0, quaternion(0.0))) for time in TIMES]
IMAGES = [image(time, np.full((12, 60), 7, np.uint8)) for time in range(START, TIMES[-1], STEP // 3)]


def write(folder: Path, *parts: list[Entry]) -> Path:
    return write_bag(
        folder, "mcap", sorted([e for part in parts for e in part], key=lambda entry: entry.time)
    )


def test_topics_are_described(tmp_path: Path) -> None:
    custom = [Entry("/lab", "lab_msgs/msg/Custom", time, {}) for time in TIMES[:3]]
    bag = describe_bag(write(tmp_path, WHEELS, SCANS, SKIN, IMAGES, FRAMES, custom))
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
    assert wheels.stamped is not None
    assert (wheels.stamped.rate_hz, wheels.stamped.gap) == (10.0, 0.1)
    assert shapes["/odom"].words == "1.9 m at 1 m/s"
    assert (shapes["/odom"].pose_path, shapes["/odom"].twist_path) == pytest.approx((1.9, 1.9))
    assert bag.links == (("odom", "base_link", False, 20),)


def test_faults_of_a_topic_are_described(tmp_path: Path) -> None:
    spoilt = [entry._replace(topic="/bad", fields=entry.fields | {"encoding": "yuv"}) for entry in IMAGES]
    stamps = [TIMES[0], 0, TIMES[5], TIMES[5], TIMES[2], TIMES[15]]
    disorder = [
        odometry(stamp, 0, 0, 0)._replace(time=time) for stamp, time in zip(stamps, TIMES, strict=False)
    ]
    topics = {topic.name: topic for topic in describe_bag(write(tmp_path, spoilt, disorder)).topics}
    assert topics["/bad"].roles == ()
    assert "encoding 'yuv'" in topics["/bad"].fault
    found = topics["/odom"].stamped
    assert found is not None
    assert (found.zero, found.repeated, found.backwards, found.in_order) == (1, 1, 2, False)
    assert found.gap == pytest.approx(1700000000.5)


RAYS = {"topic": "/scan", "rows": 1, "columns": 4}
STILL = [odometry(time, 0, 0, 0, (1.0, 0.0, 0.5)) for time in TIMES]
UNSTAMPED = [odometry(0, 0.1 * row, 0, 0)._replace(time=time) for row, time in enumerate(TIMES)]


def framed(parent: str, child: str) -> list[Entry]:
    """Odometry on /tf alone."""
    return [
        tf(time, transform(time, parent, child, 0.1 * row, 0, quaternion(0.0)))
        for row, time in enumerate(TIMES)
    ]


def seen_by(frame: str) -> Entry:
    entry = SCANS[0]
    return entry._replace(fields=dict(entry.fields) | {"header": header(entry.time, frame)})


SUGGESTED: dict[str, tuple[list[list[Entry]], dict[str, Any]]] = {
    "scan": ([WHEELS, SCANS, IMAGES, TRUE], {"odometry": "/odom", "views": RAYS, "truth": "/mocap/pose"}),
    "images": ([WHEELS, IMAGES], {"odometry": "/odom", "views": "/image", "samples": "views"}),
    "touch": (
        [WHEELS, SKIN],
        {"odometry": "/odom", "touch": {"topic": "/skin", "low": 200.0, "high": 919.0}},
    ),
    "frames": ([FRAMES, SCANS], {"odometry": {"tf": ["odom", "base_link"]}, "views": RAYS}),
    "frames of a robot": (
        [framed("robot1/odom", "robot1/base_footprint"), SCANS],
        {"odometry": {"tf": ["robot1/odom", "robot1/base_footprint"]}, "views": RAYS},
    ),
    "frames of two": (
        [framed("a_odom_combined", "a_base"), framed("b/odom", "b/base_link"), [seen_by("b/laser")]],
        {"odometry": {"tf": ["b/odom", "b/base_link"]}, "views": RAYS},
    ),
    "frames of none": ([framed("map", "odom"), framed("a/odom", "b/base_link"), SCANS], {}),
    "scans that vary": (
        [WHEELS, SCANS[:1], [scan(TIMES[5], [2.0] * 24, -0.6, 0.05)]],
        {"odometry": "/odom", "views": RAYS | {"columns": 14, "span": [-0.625, 0.575]}},
    ),
    "velocities": ([STILL], {"odometry": {"topic": "/odom", "use": "twist"}}),
    "no stamps": ([UNSTAMPED], {"odometry": "/odom", "clock": "bag"}),
    "nothing": ([SCANS], {}),
}


@pytest.mark.parametrize("case", SUGGESTED)
def test_suggested_settings_read_the_bag(case: str, tmp_path: Path) -> None:
    parts, expected = SUGGESTED[case]
    path = write(tmp_path, *parts)
    topics = suggested_topics(describe_bag(path))
    assert topics == expected
    if topics:
        source = open_recording(RecordingConfig.model_validate({"file": path, "topics": topics}))
        assert source.length is not None
        assert source.length >= 20


def test_a_turtlebot_is_read(reference_data: Path) -> None:
    """A real ring, mounted a quarter turn to the left."""
    path = reference_data / "bags" / "turtlebot4_first_floor"
    topics = {topic.name: topic for topic in describe_bag(path).topics}
    ring = topics["/scan"].shape
    assert ring is not None
    assert ring.words.startswith("720 beams all around")
    assert ring.words.endswith("24% empty")
    settings = suggested_topics(describe_bag(path))
    assert settings == {"odometry": "/odom", "views": "/scan"}
    told: list[str] = []
    recording = RecordingConfig.model_validate({"file": path, "topics": settings})
    views = open_recording(recording, told.append)
    assert (views.length, sum(bool(sample.reading.view_seen) for sample in views)) == (920, 355)
    assert len(told) == 1
    assert "/scan: 2 of 357 views" in told[0]
    ahead = {"odometry": "/odom", "views": {"topic": "/scan", "yaw": 0.0, "rows": 1, "columns": 8}}
    mounted = ahead | {"views": {"topic": "/scan", "rows": 1, "columns": 8}}
    rings = [
        [sample.reading.view.ravel() for sample in open_recording(RecordingConfig.model_validate(part))][9]
        for part in ({"file": path, "topics": ahead}, {"file": path, "topics": mounted})
    ]
    assert np.allclose(np.roll(rings[0], 2), rings[1], atol=0.1)
