"""A run as one MCAP file for ROS 2 tools, or as a ROS 2 bag: a folder with that file and `metadata.yaml`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from mcap.writer import CompressionType, Writer

from ratslam.service.export.ros_messages import LINES, POINTS, RosMessages
from ratslam.service.export.run_export import ExportedRun
from tactile.base.se2 import between, compose, inverse

GREY, GREEN, ORANGE, RED = (
    (0.5, 0.5, 0.5, 0.6),
    (0.1, 0.6, 0.2, 0.9),
    (0.9, 0.5, 0.1, 0.4),
    (0.8, 0.1, 0.1, 0.4),
)
VERDICTS = {"accepted": GREEN, "open": ORANGE, "undone": RED}
"""Colours of the candidates for loop closures by verdict."""
THIN, THICK = 0.1, 0.3
"""Width of links, and diameter of experiences, as shares of the median distance of linked experiences."""
LATCHED = ("/path/map", "/path/odometry", "/path/truth", "/map", "/markers")
"""Topics with one message, at the first stamp: late subscribers get it too."""


class Stamped(NamedTuple):
    """A message with its topic and stamp in ns."""

    topic: str
    stamp: int
    message: Any


class Topic(NamedTuple):
    """A topic in a file: its message type, and the number of its messages."""

    kind: str
    messages: int


def run_messages(exported: ExportedRun, ros: RosMessages) -> Iterator[Stamped]:
    """All messages of a run, in order of time."""
    first = int(exported.stamps[0])
    for topic, message in _latched_messages(exported, ros, first):
        yield Stamped(topic, first, message)
    run = exported.run
    images = exported.images()
    image = next(images, None)
    start = inverse(run.odometry[0])  # so that odom and map agree at the first step
    odometry = compose(compose(run.online[0], start), run.odometry)
    twist = _twists(run.time, odometry)
    offset = compose(run.online, inverse(odometry))
    for step, stamp in enumerate(exported.stamps.tolist()):
        yield Stamped("/tf", stamp, ros.transforms(stamp, offset[step], odometry[step]))
        yield Stamped("/odom", stamp, ros.odometry(stamp, odometry[step], twist[step]))
        yield Stamped("/pose", stamp, ros.pose(stamp, run.online[step], exported.spread[step]))
        if image is not None and image[0] == step:
            yield Stamped("/view", stamp, ros.image(stamp, image[1]))
            image = next(images, None)


def _latched_messages(exported: ExportedRun, ros: RosMessages, first: int) -> Iterator[tuple[str, Any]]:
    run, stamps = exported.run, exported.stamps
    yield "/path/map", ros.path(stamps, run.final)
    own = compose(inverse(run.odometry[0]), run.odometry)
    yield "/path/odometry", ros.path(stamps, compose(run.online[0], own))
    if exported.truth is not None:
        known = np.isfinite(exported.truth).all(axis=1)
        yield "/path/truth", ros.path(stamps[known], exported.truth[known])
    if exported.grid is not None:
        yield "/map", ros.grid(first, exported.grid)
    if markers := _markers(exported, ros, first):
        yield "/markers", ros.markers(markers)


def _markers(exported: ExportedRun, ros: RosMessages, stamp: int) -> list[Any]:
    """Experiences and their links, and the candidates for loop closures by verdict."""
    run, parts = exported.run, []
    nodes, links = run.nodes[:, :2], run.links
    between_nodes = np.hypot(*(nodes[links[:, 0]] - nodes[links[:, 1]]).T) if len(links) else np.zeros(0)
    size = float(np.median(between_nodes)) if len(links) else 0.1
    if len(nodes):
        parts.append(ros.marker(stamp, "graph/experiences", POINTS, nodes, GREY, THICK * size))
    if len(links):
        parts.append(ros.marker(stamp, "graph/links", LINES, nodes[links].reshape(-1, 2), GREY, THIN * size))
    for verdict, colour in VERDICTS.items():
        chosen = exported.candidates[np.array(exported.verdicts, dtype=str) == verdict]
        if len(chosen):
            ends = run.final[chosen, :2].reshape(-1, 2)
            parts.append(ros.marker(stamp, f"closures/{verdict}", LINES, ends, colour, THIN * size))
    return parts


def _twists(time: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """Mean velocity [N, 3] of each step in its own frame, m/s, m/s, rad/s; 0 without a duration."""
    twist = np.zeros_like(odometry)
    duration = np.diff(time)[:, None]
    np.divide(between(odometry[:-1], odometry[1:]), duration, out=twist[1:], where=duration > 0)
    return twist


def write_mcap(path: Path, exported: ExportedRun, ros: RosMessages) -> dict[str, Topic]:
    """Writes an MCAP file with the ROS 2 profile; equal runs give equal bytes.

    Returns:
        its topics.
    """
    kinds: dict[str, str] = {}
    channels: dict[str, int] = {}
    counts: dict[str, int] = {}
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="ratslam")
        schemas: dict[str, int] = {}
        for topic, stamp, message in run_messages(exported, ros):
            if topic not in channels:
                kind = message.__msgtype__
                if kind not in schemas:
                    schemas[kind] = writer.register_schema(kind, "ros2msg", ros.definition(kind).encode())
                profile = {"offered_qos_profiles": quality_of_service(topic)}
                channels[topic] = writer.register_channel(topic, "cdr", schemas[kind], profile)
                kinds[topic], counts[topic] = kind, 0
            writer.add_message(channels[topic], stamp, ros.serialize(message), stamp, counts[topic])
            counts[topic] += 1
        writer.finish()
    return {topic: Topic(kind, counts[topic]) for topic, kind in kinds.items()}


def write_bag(folder: Path, name: str, exported: ExportedRun, ros: RosMessages) -> None:
    """Writes a ROS 2 bag into an existing folder: NAME_0.mcap and metadata.yaml."""
    file = f"{name}_0.mcap"
    topics = write_mcap(folder / file, exported, ros)
    first, last = int(exported.stamps[0]), int(exported.stamps[-1])
    span = {
        "duration": {"nanoseconds": last - first},
        "starting_time": {"nanoseconds_since_epoch": first},
        "message_count": sum(topic.messages for topic in topics.values()),
    }
    information = {
        "version": 5,
        "storage_identifier": "mcap",
        **span,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": name,
                    "type": topic.kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": quality_of_service(name),
                },
                "message_count": topic.messages,
            }
            for name, topic in topics.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file],
        "files": [{"path": file, **span}],
    }
    text = yaml.safe_dump({"rosbag2_bagfile_information": information}, sort_keys=False)
    (folder / "metadata.yaml").write_text(text, encoding="utf-8")


def quality_of_service(topic: str) -> str:
    """The profile that rosbag2 plays a topic with: reliable, kept for late subscribers if `LATCHED`."""
    latched = topic in LATCHED
    forever = {"sec": 2147483647, "nsec": 4294967295}
    profile = {
        "history": 1,
        "depth": 1 if latched else 10,
        "reliability": 1,
        "durability": 1 if latched else 2,
        "deadline": forever,
        "lifespan": forever,
        "liveliness": 1,
        "liveliness_lease_duration": forever,
        "avoid_ros_namespace_conventions": False,
    }
    return yaml.safe_dump([profile], sort_keys=False, default_flow_style=None)
