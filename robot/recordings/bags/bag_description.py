"""What a bag holds: topics, rates, gaps, frames, shapes and magnitudes, and what each topic can serve as; the
settings that read it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from robot.recordings.bags import transforms
from robot.recordings.bags.bag import Bag, Topic, leaps, nanoseconds
from robot.recordings.bags.bag_reader import ARRAYS, JOINTS, NAMED, TOUCHES, TouchReader
from robot.recordings.bags.topics_config import TouchTopic
from robot.recordings.bags.transforms import FORWARD, ODOMETRY, POSES, TWISTS, mount_of
from robot.recordings.bags.views import (
    CLOUD,
    IMAGES,
    RAW,
    SCAN,
    Extent,
    cloud_points,
    extent_of,
    grey_image,
    scan_limits,
    wider_extent,
)
from robot.recordings.bags.wrench_pokes import WRENCHES, force_of
from robot.recordings.input_judge import MotionTrack, typical_motion
from robot.recordings.sanity_checks import SPOILT
from robot.sources.odometry import from_poses, from_velocities
from tactile.base.errors import InputError

Role = Literal["odometry", "views", "touch", "pokes (wrench)", "truth"]


class Times(NamedTuple):
    """Times of N messages by one clock.

    Attributes:
        first, last: s. rate_hz: median; 0 with fewer than two different times. gap, gap_at: longest pause, s,
            and the time at which it begins. zero, repeated, backwards: messages with a stamp of 0, with the
            stamp of the message before, and with an earlier one. total: N. leaps: steps that leap where the
            other clock does not. ahead: median time before the other clock, s.
    """

    first: float
    last: float
    rate_hz: float
    gap: float
    gap_at: float
    zero: int
    repeated: int
    backwards: int
    total: int = 0
    leaps: int = 0
    ahead: float = 0.0

    @property
    def in_order(self) -> bool:
        """Whether the messages can be read by this clock; a few are left out."""
        return max(self.zero, self.backwards) <= max(1, SPOILT * self.total)


class Shape(NamedTuple):
    """What the messages of a topic hold.

    Attributes:
        words: all of it, for a reader. size: beams of a scan (the median); width and height of an image,
            pixels; dimensions of values.
        low, high: of all values (positions of joints); high: of scans, limit of the range, m.
        extent: directions of all scans together; wider: if the first has fewer.
        pose_path, twist_path: length of poses and of velocities, m, NaN without these.
    """

    words: str
    size: tuple[int, ...] = ()
    low: float = np.nan
    high: float = np.nan
    extent: Extent | None = None
    wider: bool = False
    pose_path: float = np.nan
    twist_path: float = np.nan


class TopicDescription(NamedTuple):
    """A topic.

    Attributes:
        kind: message type. total: number of messages. received: times of receipt. stamped: times in the
            headers, None without headers. frame, child: frames of the first message, '' if it has none.
        shape: what the messages hold, None for types that cannot be read. roles: what it can serve as.
        fault: why its messages cannot be read, ''.
    """

    name: str
    kind: str
    total: int
    received: Times
    stamped: Times | None
    frame: str
    child: str
    shape: Shape | None
    roles: tuple[Role, ...]
    fault: str


class BagDescription(NamedTuple):
    """A bag.

    Attributes:
        topics: by name, with messages. links: of /tf and /tf_static: parent, child,
            whether it is fixed (on /tf_static) and the number of transforms. notes: what is left out.
    """

    topics: tuple[TopicDescription, ...]
    links: tuple[tuple[str, str, bool, int], ...]
    notes: tuple[str, ...] = ()


@np.errstate(all="ignore")  # numbers may be any
def describe_bag(path: Path) -> BagDescription:
    """Reads the whole bag; faults of a single topic are described, not raised.

    Raises:
        InputError: the bag is missing, damaged or empty.
    """
    told = list[str]()
    with Bag(path, told.append) as bag:
        topics = tuple(_describe_topic(bag, topic) for topic in bag.topics.values() if topic.total)
        links = []
        for name in (transforms.MOVING, transforms.STATIC):
            try:
                found = transforms.read_links(bag, name)
            except InputError:
                continue  # the fault of the topic says why
            links += [(*pair, name == transforms.STATIC, len(link)) for pair, link in found.items()]
    return BagDescription(topics, tuple(links), tuple(told))


_ROLES: dict[str, tuple[Role, ...]] = {
    **dict.fromkeys(TWISTS, ("odometry",)),
    **dict.fromkeys(POSES, ("odometry", "truth")),  # also of types that have both
    **dict.fromkeys((SCAN, CLOUD, *IMAGES), ("views",)),
    **dict.fromkeys(TOUCHES, ("touch",)),
    **dict.fromkeys(WRENCHES, ("pokes (wrench)",)),
}
"""What messages of a type can serve as."""


def _describe_topic(bag: Bag, topic: Topic) -> TopicDescription:
    received, stamps, fault, shape = list[int](), list[int](), "", None
    frames, roles, kept = ("", ""), _ROLES.get(topic.kind, ()), list[Any]()
    only_first = topic.kind in (CLOUD, *IMAGES)  # which would take too long to describe one by one
    try:
        if not roles:
            received = list(bag.receipts(topic))
        else:

            def read(content: Any, place: str) -> None:
                if not (only_first and kept):
                    kept.append(_summary_of(content, topic.kind, place))

            for _, time, content, _ in bag.usable(topic, read):
                received.append(time)
                if hasattr(content, "header"):
                    stamps.append(nanoseconds(content.header.stamp))
                    frames = frames if any(frames) else transforms.frames_of(content)
            shape = _shape_of(bag, topic.kind, kept, stamps or received)
    except InputError as error:
        fault, roles = str(error), ()
        received = received or list(bag.receipts(topic))
    stamped = _times_of(stamps, received) if len(stamps) == len(received) > 0 else None
    return TopicDescription(*topic, _times_of(received), stamped, *frames, shape, roles, fault)


def _times_of(stamps: list[int], other: list[int] | None = None) -> Times:
    """The times of N messages, ns, at least one; other: by the other clock."""
    times = np.array(stamps, np.int64)
    others = times if other is None else np.array(other, np.int64)
    steps = np.diff(times)
    ahead = steps[steps > 0]
    longest = int(steps.argmax()) if len(steps) else 0
    return Times(
        first=int(times.min()) / 1e9,
        last=int(times.max()) / 1e9,
        rate_hz=1e9 / float(np.median(ahead)) if len(ahead) else 0.0,
        gap=max(float(steps.max()) / 1e9, 0.0) if len(steps) else 0.0,
        gap_at=int(times[longest]) / 1e9,
        zero=int((times == 0).sum()),
        repeated=int((steps == 0).sum()),
        backwards=int((steps < 0).sum()),
        total=len(times),
        leaps=int(leaps(times, others).sum()),
        ahead=float(np.median(times - others)) / 1e9,
    )


def _summary_of(content: Any, kind: str, where: str) -> Any:
    """What is kept of a message, for `_shape_of`."""
    if kind == SCAN:
        own, (low, high) = extent_of(content, where), scan_limits(content)
        ranges = np.asarray(content.ranges, float)
        nothing = (ranges > high) | np.isposinf(ranges)
        within = ranges[~nothing & (ranges >= low)]
        median = float(np.median(within)) if len(within) else np.nan
        return len(ranges), high, median, nothing.mean(), content.header.frame_id, own
    if kind == CLOUD:
        return cloud_points(content, where)
    if kind in WRENCHES:
        return force_of(content, where)
    if kind in IMAGES:
        grey = grey_image(content, kind, where)
        encoding = content.encoding if kind == RAW else content.format
        height, width = grey.shape
        return Shape(f"{width} x {height} {encoding}, mean grey {grey.mean():.0f}", (width, height))
    if kind == JOINTS:
        return (len(content.name),), np.asarray(content.position, float)
    if kind in NAMED:
        values = TouchReader(kind, TouchTopic(topic="")).values(content, where)
        values = np.zeros(0) if values is None else values
        return values.shape, values
    if kind in ARRAYS:
        sizes = tuple(int(dim.size) for dim in content.layout.dim)
        return sizes or (len(content.data),), np.asarray(content.data, float)
    # [6] pose (x, y, heading) and velocity (forward, left, turn), NaN where the type has none
    pose = transforms.pose_in_plane(*POSES[kind](content), where) if kind in POSES else (np.nan,) * 3
    twist = transforms.twist_in_plane(TWISTS[kind](content)) if kind in TWISTS else (np.nan,) * 3
    return np.array([*pose, *twist])


def _shape_of(bag: Bag, kind: str, kept: list[Any], stamps: list[int]) -> Shape:
    """What the messages of a topic hold; kept: of each (`_summary_of`); stamps: their times, ns."""
    if kind == SCAN:
        beams, highs, medians, nothing, frames, extents = zip(*kept, strict=True)
        known = [median for median in medians if np.isfinite(median)]
        median = float(np.median(known)) if known else np.nan
        if len(set(frames)) > 1:  # directions in the frame of the first
            mounts = {each: mount_of(bag, "", each) or FORWARD for each in dict.fromkeys(frames)}
            turned = zip(frames, extents, strict=True)
            extents = tuple(own.turned(mounts[frame], mounts[frames[0]]) for frame, own in turned)
        wider, count = wider_extent(extents), int(np.median(beams))
        extent = wider or extents[0]
        turn = "all around" if extent.ring else f"over {np.degrees(abs(extent.width)):.0f} degrees"
        words = f"{count} beams {turn}, median {median:.2g} m, {np.mean(nothing):.0%} empty"
        return Shape(words, (count,), high=highs[0], extent=extent, wider=wider is not None)
    if kind == CLOUD:
        points = kept[0][np.isfinite(kept[0]).all(axis=1)]
        reach = float(np.median(np.hypot(points[:, 0], points[:, 1]))) if len(points) else np.nan
        return Shape(f"{len(kept[0])} points, median {reach:.2g} m away")
    if kind in IMAGES:
        return kept[0]
    if kind in WRENCHES:
        size = np.linalg.norm(np.array(kept) - np.median(kept, axis=0), axis=1)
        return Shape(f"forces, usually {np.median(size):.3g} N from their median, at most {size.max():.3g} N")
    if kind in TOUCHES:
        numbers = np.concatenate([value for _, value in kept])
        low, high = (float(numbers.min()), float(numbers.max())) if len(numbers) else (np.nan, np.nan)
        words = f"{' x '.join(map(str, kept[0][0]))} values from {low:.3g} to {high:.3g}"
        return Shape(words, kept[0][0], low, high)
    rows, time, paths, speeds = np.array(kept), np.array(stamps, float) / 1e9, list[float](), list[float]()
    order = np.argsort(time, kind="stable")
    rows, time = rows[order], time[order]
    for motion in (from_poses(time, rows[:, :3]), from_velocities(time, *rows[:, 3:].T)):
        measured = np.isfinite(motion[:, 0]).any()
        track = MotionTrack(time, np.ones(len(time), bool), motion)
        paths.append(float(np.nansum(np.hypot(motion[:, 0], motion[:, 1]))) if measured else np.nan)
        speeds.append(typical_motion(track).speed)
    first = 0 if np.isfinite(paths[0]) else 1
    words = f"{paths[first]:.3g} m at {speeds[first]:.2g} m/s"
    return Shape(words, pose_path=paths[0], twist_path=paths[1])


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
    wrench = _first(bag, "pokes (wrench)", bag.topics)
    seen = views[0] if views else None
    if views is not None:
        found["views"] = views[1]
    elif touch is not None and touch.shape is not None:
        seen, found["touch"] = touch, touch.name
        low, high = touch.shape.low, touch.shape.high
        if low < high and not (low >= 0 and high <= 1):
            found["touch"] = {"topic": touch.name, "low": low, "high": high}
    elif wrench is not None:
        seen, found["wrench"], found["samples"] = wrench, wrench.name, "views"
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
        if named and child in [named[1] + body for body in (*transforms.BODIES, "base")]:
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
    return not clocks or max(times.first for times in clocks) <= min(times.last for times in clocks)
