"""What a bag holds: topics, rates, gaps, frames, shapes and magnitudes, and what each topic can serve as."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from robot.recordings.bags.bag import Bag, Topic
from robot.recordings.bags.images import COMPRESSED, IMAGES, RAW, grey_image
from robot.recordings.bags.motions import POSES, TWISTS, twist_in_plane
from robot.recordings.bags.scans import (
    CLOUD,
    SCAN,
    Extent,
    cloud_points,
    extent_of,
    scan_limits,
    wider_extent,
)
from robot.recordings.bags.stamps import leaps, nanoseconds
from robot.recordings.bags.touch import ARRAYS, JOINTS
from robot.recordings.bags.transforms import FORWARD, MOVING, STATIC, mount_of, read_links
from robot.recordings.input_judge import MotionTrack, typical_motion
from robot.recordings.sanity_checks import SPOILT
from robot.sources.odometry import from_poses, from_velocities
from tactile.base.errors import InputError

Role = Literal["odometry", "views", "touch", "truth"]


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


class ScanShape(NamedTuple):
    """LaserScan.

    Attributes:
        beams: median number. fov: rad, counter-clockwise positive. ring: it covers the whole turn.
        low, high: limits of the range, m. median: of the ranges within these, m, NaN if there are none.
        nothing, unmeasured: shares of beams without an object in range, and without a measurement.
        wider: directions of all messages together, if the first has fewer.
    """

    beams: int
    fov: float
    ring: bool
    low: float
    high: float
    median: float
    nothing: float
    unmeasured: float
    wider: Extent | None = None


class CloudShape(NamedTuple):
    """PointCloud2.

    Attributes:
        points: of the first message. reach: median distance, m. low, high: of z in the sensor's frame, m.
    """

    points: int
    reach: float
    low: float
    high: float


class ImageShape(NamedTuple):
    """Image, CompressedImage.

    Attributes:
        width, height: of the first message, pixels. encoding: or format. grey: mean, 0 to 255.
    """

    width: int
    height: int
    encoding: str
    grey: float


class ValueShape(NamedTuple):
    """JointState, MultiArray.

    Attributes:
        names: of joints. sizes: of the layout's dimensions, else the number of values. low, high: of all
            values (positions of joints).
    """

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    low: float
    high: float


class MotionShape(NamedTuple):
    """Poses, velocities.

    Attributes:
        pose_path, pose_speed, pose_turn_rate: length in m, typical speed in m/s and turn rate in rad/s, of
            the poses. twist_path, twist_speed, twist_turn_rate: of the velocities. NaN without these.
    """

    pose_path: float
    pose_speed: float
    pose_turn_rate: float
    twist_path: float
    twist_speed: float
    twist_turn_rate: float


Shape = ScanShape | CloudShape | ImageShape | ValueShape | MotionShape


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


class FrameLink(NamedTuple):
    """A link between frames. Attributes: fixed: it is on /tf_static. total: number of transforms."""

    parent: str
    child: str
    fixed: bool
    total: int


class BagDescription(NamedTuple):
    """A bag.

    Attributes:
        topics: by name, with messages. links: frames of /tf and /tf_static. notes: what is left out.
    """

    path: Path
    topics: tuple[TopicDescription, ...]
    links: tuple[FrameLink, ...]
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
        for name in (MOVING, STATIC):
            try:
                found = read_links(bag, name, "header")
            except InputError:
                continue  # the fault of the topic says why
            links += [FrameLink(*pair, name == STATIC, len(link.stamps)) for pair, link in found.items()]
    return BagDescription(path, topics, tuple(links), tuple(told))


def roles_of(kind: str) -> tuple[Role, ...]:
    """What messages of a type can serve as."""
    if kind in POSES:
        return ("odometry", "truth")
    if kind in TWISTS:
        return ("odometry",)
    if kind in (SCAN, CLOUD, *IMAGES):
        return ("views",)
    return ("touch",) if kind in (JOINTS, *ARRAYS) else ()


def _describe_topic(bag: Bag, topic: Topic) -> TopicDescription:
    received, stamps, fault, shape = list[int](), list[int](), "", None
    frames, roles, contents = ("", ""), roles_of(topic.kind), list[Any]()
    summary = SUMMARIES.get(topic.kind)
    try:
        if not roles:
            received = list(bag.receipts(topic))
        else:

            def read(content: Any, place: str) -> None:
                if summary is not None and (summary.every or not contents):
                    contents.append(summary.extract(content, topic.kind, place))

            for _, time, content, _ in bag.usable(topic, read):
                received.append(time)
                if hasattr(content, "header"):
                    stamps.append(nanoseconds(content.header.stamp))
                    frames = frames if any(frames) else _frames_of(content)
            if summary is not None:
                shape = summary.shape(contents, stamps or received)
            if isinstance(shape, ScanShape):
                shape = _with_wider(shape, bag, contents)
    except InputError as error:
        fault, roles = str(error), ()
        received = received or list(bag.receipts(topic))
    stamped = times_of(stamps, received) if len(stamps) == len(received) > 0 else None
    return TopicDescription(*topic, times_of(received), stamped, *frames, shape, roles, fault)


def _frames_of(content: Any) -> tuple[str, str]:
    return str(content.header.frame_id), str(getattr(content, "child_frame_id", ""))


def times_of(stamps: list[int], other: list[int] | None = None) -> Times:
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


class Summary(NamedTuple):
    """How the messages of a type are summed up.

    Attributes:
        every: whether all messages count, or the first only. extract: what is kept of a message.
        shape: of what was kept and the times, ns.
    """

    every: bool
    extract: Callable[[Any, str, str], Any]
    shape: Callable[[list[Any], list[int]], Shape]


def _scan_values(content: Any, kind: str, where: str) -> tuple[Any, ...]:
    own, (low, high) = extent_of(content, where), scan_limits(content)
    ranges = np.asarray(content.ranges, float)
    nothing, unmeasured = ranges > high, np.isnan(ranges) | (ranges < low)
    nothing |= np.isposinf(ranges)
    within = ranges[~nothing & ~unmeasured]
    median = float(np.median(within)) if len(within) else np.nan
    shares = nothing.mean(), unmeasured.mean()
    return len(ranges), own.width, own.ring, low, high, median, shares, content.header.frame_id, own


def _scan_shape(values: list[Any], stamps: list[int]) -> ScanShape:
    medians = np.array([value[5] for value in values])
    median = float(np.nanmedian(medians)) if np.isfinite(medians).any() else np.nan
    shares = np.mean([value[6] for value in values], axis=0)
    beams, (fov, ring, low, high) = int(np.median([value[0] for value in values])), values[0][1:5]
    return ScanShape(beams, fov, ring, low, high, median, float(shares[0]), float(shares[1]))


def _with_wider(shape: ScanShape, bag: Bag, values: list[Any]) -> ScanShape:
    """The shape with what the scans of a topic cover together, in the frame of the first."""
    frames = dict.fromkeys(value[7] for value in values)
    mounts = [mount_of(bag, "", frame, "header") or FORWARD for frame in frames if len(frames) > 1]
    at = dict(zip(frames, mounts, strict=False))
    wider = wider_extent([own.turned(at[frame], mounts[0]) if at else own for *_, frame, own in values])
    return shape if wider is None else shape._replace(fov=wider.width, ring=wider.ring, wider=wider)


def _cloud_shape(values: list[Any], stamps: list[int]) -> CloudShape:
    points = values[0][np.isfinite(values[0]).all(axis=1)]
    if not len(points):
        return CloudShape(len(values[0]), np.nan, np.nan, np.nan)
    reach = float(np.median(np.hypot(points[:, 0], points[:, 1])))
    return CloudShape(len(values[0]), reach, float(points[:, 2].min()), float(points[:, 2].max()))


def _image_values(content: Any, kind: str, where: str) -> ImageShape:
    grey = grey_image(content, kind, where)
    encoding = content.encoding if kind == RAW else content.format
    return ImageShape(grey.shape[1], grey.shape[0], encoding, float(grey.mean()))


def _array_values(content: Any, kind: str, where: str) -> tuple[Any, ...]:
    sizes = tuple(int(dim.size) for dim in content.layout.dim)
    return (), sizes or (len(content.data),), np.asarray(content.data, float)


def _joint_values(content: Any, kind: str, where: str) -> tuple[Any, ...]:
    return tuple(content.name), (len(content.name),), np.asarray(content.position, float)


def _value_shape(values: list[Any], stamps: list[int]) -> ValueShape:
    numbers = np.concatenate([value[2] for value in values])
    low, high = (float(numbers.min()), float(numbers.max())) if len(numbers) else (np.nan, np.nan)
    names = tuple(dict.fromkeys(name for value in values for name in value[0]))
    return ValueShape(names, values[0][1], low, high)


def _motion_values(content: Any, kind: str, where: str) -> np.ndarray:
    """[6] pose (x, y, heading) and velocity (forward, left, turn), NaN where the type has none."""
    pose = POSES[kind](content, where) if kind in POSES else (np.nan,) * 3
    return np.array([*pose, *(twist_in_plane(TWISTS[kind](content)) if kind in TWISTS else (np.nan,) * 3)])


def _motion_shape(values: list[Any], stamps: list[int]) -> MotionShape:
    rows, time = np.array(values), np.array(stamps, float) / 1e9
    order = np.argsort(time, kind="stable")
    rows, time = rows[order], time[order]
    poses = _magnitudes(from_poses(time, rows[:, :3]), time)
    return MotionShape(*poses, *_magnitudes(from_velocities(time, *rows[:, 3:].T), time))


def _magnitudes(motion: np.ndarray, time: np.ndarray) -> tuple[float, float, float]:
    if not np.isfinite(motion).any(axis=0)[0]:
        return np.nan, np.nan, np.nan
    typical = typical_motion(MotionTrack(time, np.ones(len(time), bool), motion, None))
    return float(np.nansum(np.hypot(motion[:, 0], motion[:, 1]))), typical.speed, typical.turn_rate


SUMMARIES: dict[str, Summary] = {
    SCAN: Summary(True, _scan_values, _scan_shape),
    CLOUD: Summary(False, lambda content, kind, where: cloud_points(content, where), _cloud_shape),
    **dict.fromkeys((RAW, COMPRESSED), Summary(False, _image_values, lambda values, stamps: values[0])),
    **dict.fromkeys(ARRAYS, Summary(True, _array_values, _value_shape)),
    JOINTS: Summary(True, _joint_values, _value_shape),
    **dict.fromkeys((*POSES, *TWISTS), Summary(True, _motion_values, _motion_shape)),
}
"""How the messages of each type are described."""
