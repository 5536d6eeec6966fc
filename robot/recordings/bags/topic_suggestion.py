"""Settings that read a bag, from its description."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from robot.recordings.bags.bag_description import BagDescription, Times, TopicDescription
from robot.recordings.bags.bag_reader import JOINTS
from robot.recordings.bags.transforms import BODIES, ODOMETRY
from robot.recordings.bags.views import CLOUD, IMAGES, SCAN

TRUE = re.compile(r"truth|(^|[/_])gt([/_]|$)|mocap|vicon|optitrack|qualisys|ideal", re.IGNORECASE)
"""Names of topics and frames with true poses."""
WHEELS = re.compile(r"/?(|.+[/_.-])(odom|odom_combined)")
"""Frames whose link to the robot in /tf is odometry, and the prefix of the robot."""
LEAST_PATH = 0.01  # m: poses or velocities with less do not tell how the robot moved


def suggested_topics(bag: BagDescription) -> dict[str, Any]:
    """`recording.topics` that read the bag; {} if it has neither odometry nor images."""
    truth = _first(bag, "truth", [topic for topic in bag.topics if TRUE.search(topic.name)])
    odometry, wheels = _odometry(bag, truth)
    views, touch = _views(bag), None
    if views is None:
        touch = _first(bag, "touch", [topic for topic in bag.topics if topic.kind != JOINTS])
    found: dict[str, Any] = {}
    if odometry is not None:
        found["odometry"] = odometry
    elif views is None or views[0].kind not in IMAGES:
        return {}
    seen = views[0] if views else None
    if views is not None:
        found["views"] = views[1]
    elif touch is not None and touch.shape is not None:
        seen, found["touch"] = touch, touch.name
        low, high = touch.shape.low, touch.shape.high
        if low < high and not (low >= 0 and high <= 1):
            found["touch"] = {"topic": touch.name, "low": low, "high": high}
    if truth is not None:
        found["truth"] = truth.name
    used = [topic for topic in (wheels, seen, truth) if topic is not None]
    if not _headers_serve(used):
        found["clock"] = "bag"
    if seen is not None and wheels is not None and seen.received.rate_hz > 1.2 * wheels.received.rate_hz:
        found["samples"] = "views"
    return found


def _odometry(bag: BagDescription, truth: TopicDescription | None) -> tuple[Any, TopicDescription | None]:
    """The setting, and the topic that it names."""
    others = [topic for topic in bag.topics if topic != truth]
    best = _first(bag, "odometry", [topic for topic in others if topic.kind == ODOMETRY])
    best = best or _first(bag, "odometry", others)
    if best is None:
        robots = robots_of(bag)
        return ({"tf": list(robots[0])} if robots else None), None
    shape = best.shape
    still = shape is not None and not shape.pose_path > LEAST_PATH
    if best.kind == ODOMETRY and shape is not None and still and shape.twist_path > LEAST_PATH:
        return {"topic": best.name, "use": "twist"}, best
    return best.name, best


def robots_of(bag: BagDescription) -> list[tuple[str, str]]:
    """The frames of the odometry and of the body of each robot in /tf; that with a view comes first."""
    found = []
    for parent, child, fixed, total in bag.links:
        named = None if fixed or total < 2 else WHEELS.fullmatch(parent)
        if named and child in [named[1] + body for body in (*BODIES, "base")]:
            found.append((named[1], (parent, child)))
    views = _views(bag)
    frame = "" if views is None else views[0].frame
    return [pair for prefix, pair in sorted(found, key=lambda each: not frame.startswith(each[0]))]


def _views(bag: BagDescription) -> tuple[TopicDescription, Any] | None:
    for kinds in ((SCAN,), (CLOUD,), IMAGES):
        topic = _first(bag, "views", [topic for topic in bag.topics if topic.kind in kinds])
        if topic is not None:
            shape = topic.shape
            options: dict[str, Any] = {}
            if shape is not None and shape.extent is not None:  # of scans
                if shape.size[0] < 18:  # sectors of a view by default
                    options = {"rows": 1, "columns": shape.size[0]}
                if shape.wider:
                    options["span"] = [round(angle, 4) for angle in shape.extent.span]
            return topic, {"topic": topic.name, **options} if options else topic.name
    return None


def _first(bag: BagDescription, role: str, topics: Sequence[TopicDescription]) -> TopicDescription | None:
    """The readable topic with most messages that can serve as this."""
    able = [topic for topic in topics if role in topic.roles and topic.shape is not None]
    return max(able, key=lambda topic: topic.total, default=None)


def _headers_serve(topics: Sequence[TopicDescription]) -> bool:
    """Whether the stamps in the headers are in order, do not leap where the bag does not, on one clock."""
    stamped = [topic.stamped for topic in topics if topic.stamped is not None]
    if not all(times.in_order and not times.leaps - times.backwards for times in stamped):
        return False
    clocks: list[Times] = [topic.stamped or topic.received for topic in topics]
    return not clocks or bool(
        np.max([times.first for times in clocks]) <= np.min([times.last for times in clocks])
    )
