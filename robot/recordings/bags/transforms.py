"""Poses of a bag, in the plane: odometry and true poses of topics, and between the frames of /tf and
/tf_static; where a sensor is mounted.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from itertools import compress
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.bags import bag as bags
from robot.recordings.bags.bag import Bag, Messages, Series, as_series
from robot.recordings.bags.topics_config import OdometryTopic, PoseTopic
from robot.recordings.sanity_checks import leave_out, nonfinite_errors, still_axis
from robot.sources.input_files import missing_error, raise_errors
from robot.sources.odometry import from_poses, from_velocities
from tactile.base.errors import InputError
from tactile.base.se2 import integrate, wrap

ODOMETRY = "nav_msgs/msg/Odometry"
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def frames_of(message: Any) -> tuple[str, str]:
    """Frame and child frame of a message, without leading slashes; '' where it names none."""
    frame, child = str(message.header.frame_id), str(getattr(message, "child_frame_id", ""))
    return frame.lstrip("/"), child.lstrip("/")


def pose_in_plane(position: Vector, turn: Quaternion, where: str, plane: str = "xy") -> Vector:
    """(x m, y m, heading rad) of a position (x, y, z) and a quaternion (x, y, z, w).

    Args:
        plane: `xy`; `xz` of a camera (x to the right, y down, z ahead): x = z, y = -x, heading of its z axis.

    Raises:
        InputError: the quaternion is 0, or a number is not finite.
    """
    if not any(turn):
        cure = "of odometry, the velocities remain: --set recording.topics.odometry.use=twist"
        raise InputError(where, "the orientation is 0, 0, 0, 0", "a unit quaternion", cure)
    place = tuple(position["xyz".index(axis)] for axis in plane)
    for name, values in (("orientation", turn), ("position", place)):
        if not all(map(math.isfinite, values)):
            raise InputError(where, f"the {name} is {', '.join(map(str, values))}", "finite numbers")
    x, y, z, w = turn
    if plane == "xz":
        return place[1], -place[0], float(np.arctan2(-2 * (x * z + w * y), w * w + z * z - x * x - y * y))
    return place[0], place[1], float(np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z))


def _pose_at(*fields: str) -> Callable[[Any], tuple[Vector, Quaternion]]:
    """Reads the position (x, y, z) and the quaternion (x, y, z, w) in these fields of a message."""

    def read(message: Any) -> tuple[Vector, Quaternion]:
        move, turn = attrgetter(*fields)(message)
        where = float(move.x), float(move.y), float(move.z)
        return where, (float(turn.x), float(turn.y), float(turn.z), float(turn.w))

    return read


_transform = _pose_at("transform.translation", "transform.rotation")
POSES = {
    ODOMETRY: _pose_at("pose.pose.position", "pose.pose.orientation"),
    "geometry_msgs/msg/PoseStamped": _pose_at("pose.position", "pose.orientation"),
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_at("pose.pose.position", "pose.pose.orientation"),
    "geometry_msgs/msg/TransformStamped": _transform,
}
"""Message types with a pose: its position and orientation."""
TWISTS = {ODOMETRY: attrgetter("twist.twist"), "geometry_msgs/msg/TwistStamped": attrgetter("twist")}
"""Message types with velocities in the frame of the robot."""


def _plane_errors(points: np.ndarray, where: str, role: str, plane: str) -> list[InputError]:
    """The error for positions [M, 3] that lie in another plane than x and y; another one is taken as told."""
    still = still_axis(points) if plane == "xy" and len(points) > 1 else ""
    if not still:
        return []
    x, y, z = np.ptp(points, axis=0)
    found = f"the path spans {x:.3g} m in x, {y:.3g} m in y and {z:.3g} m in z: another plane"
    camera = f"if the poses are a camera's (z ahead), --set recording.topics.{role}.plane=xz"
    cure = camera if still == "y" else "turn the poses into the plane of x and y"
    return [InputError(where, found, "a path in the plane of x and y", cure)]


def twist_in_plane(twist: Any) -> Vector:
    """(forward m/s, left m/s, turn rad/s) of a twist."""
    return float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)


STATIC, MOVING = "/tf_static", "/tf"
BODIES = ("base_link", "base_footprint")
"""Usual names of the robot's frame."""


Link = list[tuple[int, Vector, Quaternion, int]]
"""The transforms from a frame to a child frame: stamp in ns, (x, y, z) in m, quaternion (x, y, z, w), number
of the message; one is enough for a fixed link."""
Links = dict[tuple[str, str], Link]
_Chain = list[tuple[tuple[str, str], bool]]  # links, each with whether it is followed downwards


class Mount(NamedTuple):
    """Where a sensor sits in the frame of the robot. Attributes: rotation: [3, 3] from the frame of the
    sensor. position: [3] m."""

    rotation: np.ndarray
    position: np.ndarray


FORWARD = Mount(np.eye(3), np.zeros(3))


def read_links(bag: Messages, name: str) -> Links:
    """All links on /tf or /tf_static, in any namespace; of fixed links (`/tf_static`) the last transform.

    Raises:
        InputError: the bag is damaged, or a rotation is 0.
    """
    links: Links = {}
    for topic in bag.topics.values():
        if topic.kind not in bags.TRANSFORMS or not topic.total or not f"/{topic.name}".endswith(name):
            continue
        where = f"{bag.path}, {topic.name}"
        spoilt, total, first = 0, 0, None
        for number, received, content, _ in bag.usable(topic, lambda content, place: None):
            for each in content.transforms:
                frames = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
                shift, quaternion = _transform(each)
                total += 1
                if not (np.isfinite((*shift, *quaternion)).all() and any(quaternion)):
                    place = f"{where}, message {number}, {frames[0]} to {frames[1]}"
                    found = f"the translation is {shift} and the orientation {quaternion}"
                    first = first or InputError(place, found, "numbers, and a unit quaternion")
                    spoilt += 1
                    continue
                stamp = bag.stamp(each, received)
                if name == STATIC:
                    links[frames] = []
                links.setdefault(frames, []).append((stamp, shift, quaternion, number))
        if first is not None:
            raise_errors(leave_out(spoilt, total, "transforms", first, bag.warn))
    return links


def _chain_between(links: Links, parent: str, child: str) -> _Chain | None:
    """The links from one frame to another, each with whether it is followed downwards; None: unconnected."""
    ways: dict[str, _Chain] = {parent: []}
    frames = deque([parent])
    while frames:
        frame = frames.popleft()
        for upper, lower in links:
            for here, there, down in ((upper, lower, True), (lower, upper, False)):
                if here == frame and there not in ways:
                    ways[there] = [*ways[frame], ((upper, lower), down)]
                    frames.append(there)
    return None if parent == child else ways.get(child)


def mount_of(bag: Messages, body: str, sensor: str) -> Mount | None:
    """The mount of a sensor's frame on a robot's; None if the bag does not say. Links that only /tf has are
    taken as they are at first.

    Args:
        body: frame of the robot; '': the first of `BODIES` that leads to the sensor.
    """
    bodies, sensor = (body.lstrip("/"),) if body else BODIES, sensor.lstrip("/")
    if sensor in bodies:
        return FORWARD
    links: Links = {}
    for name in (STATIC, MOVING):
        links = read_links(bag, name) | links
        chains = (_chain_between(links, each, sensor) for each in bodies)
        if (chain := next(filter(None, chains), None)) is not None:
            whole = np.eye(4)
            for frames, down in chain:
                whole = whole @ _matrices(links[frames][:1], np.zeros(1), np.zeros(1), down)[0]
            return Mount(whole[:3, :3], whole[:3, 3])
    return None


def _poses_between(bag: Bag, frames: tuple[str, str], role: str, plane: str) -> Series:
    """Poses [M, 3] of a frame in another, at the times of the moving link with most transforms; the other
    moving links are interpolated. A single link may lie in another plane."""
    parent, child = (frame.lstrip("/") for frame in frames)
    links = read_links(bag, MOVING) | read_links(bag, STATIC)
    there = sorted({frame for pair in links for frame in pair})
    for frame in (parent, child):
        if frame not in there:
            raise missing_error(f"{bag.path}, {MOVING}", "frame", frame, there)
    where = f"{bag.path}, {MOVING} {parent} to {child}"
    chain = _chain_between(links, parent, child)
    if chain is None:
        raise InputError(where, "frames that are not connected", f"a chain of links in {MOVING} or {STATIC}")
    moving = [pair for pair, _ in chain if len(links[pair]) > 1]
    if not moving:
        raise InputError(where, "frames that never move", "a link with several transforms")
    times, errors = dict[tuple[str, str], np.ndarray](), list[InputError]()
    for pair in moving:
        place = f"{bag.path}, {MOVING} {' to '.join(pair)}"
        use, faults = bags.usable_stamps(bag, [stamp for stamp, *_ in links[pair]], place)
        links[pair] = list(compress(links[pair], use))
        times[pair] = bags.in_seconds([stamp for stamp, *_ in links[pair]])
        errors += faults
    lead = max(moving, key=lambda pair: len(times[pair]))
    moments, numbers = times[lead], np.array([number for *_, number in links[lead]])
    if errors:
        return Series(where, moments, np.zeros((len(moments), 3)), numbers, errors)
    if len(chain) == 1 and chain[0][1]:
        poses = [pose_in_plane(shift, turn, where, plane) for _, shift, turn, _ in links[lead]]
        errors = _plane_errors(np.array([shift for _, shift, _, _ in links[lead]]), where, role, plane)
        return Series(where, moments, np.array(poses).reshape(-1, 3), numbers, errors)
    start, end = max(times[pair][0] for pair in moving), min(times[pair][-1] for pair in moving)
    inside = (start <= moments) & (moments <= end)
    if not inside.any():
        raise InputError(where, "links without common time", "transforms of all links at the same time")
    moments = moments[inside]
    whole = np.broadcast_to(np.eye(4), (len(moments), 4, 4))
    for pair, down in chain:
        whole = whole @ _matrices(links[pair], times.get(pair, np.zeros(1)), moments, down)
    values = np.column_stack([whole[:, 0, 3], whole[:, 1, 3], np.arctan2(whole[:, 1, 0], whole[:, 0, 0])])
    return Series(where, moments, values, numbers[inside], [])


def _matrices(link: Link, time: np.ndarray, moments: np.ndarray, down: bool) -> np.ndarray:
    """[M, 4, 4] transforms of a link at the moments [M] s, interpolated; inverted if followed upwards."""
    from scipy.spatial.transform import Rotation, Slerp

    found = np.zeros((len(moments), 4, 4))
    found[:, 3, 3] = 1.0
    turns = Rotation.from_quat([turn for _, _, turn, _ in link])
    shifts = np.array([shift for _, shift, _, _ in link])
    if len(link) == 1:
        found[:, :3, :3], found[:, :3, 3] = turns[0].as_matrix(), shifts[0]
    else:
        found[:, :3, :3] = Slerp(time, turns)(moments).as_matrix()
        found[:, :3, 3] = np.column_stack([np.interp(moments, time, axis) for axis in shifts.T])
    return found if down else np.linalg.inv(found)


TURNED = 0.5
"""Typical turn between poses of different frames, rad, from which they disagree."""


def read_odometry(bag: Bag, config: OdometryTopic) -> Series:
    """The odometry: motions [N, 4] (dx m, dy m, dtheta rad, dt s) since the previous sample."""
    series = read_poses(bag, config, "odometry")
    time, values, errors = series.time, series.values, series.errors
    if len(time) < 2 and not errors:
        errors = [InputError(series.where, "one message with odometry", "at least two")]
    if errors:
        return series._replace(values=np.zeros((len(time), 4)), errors=errors)
    motion = from_velocities(time, *values.T) if series.held else from_poses(time, values)
    if config.every > 1:
        chosen = slice(None, None, config.every)
        path = integrate(motion[:, :3])[chosen]
        series = series._replace(time=time[chosen], numbers=series.numbers[chosen])
        motion, values = from_poses(series.time, path), values[chosen]
    return series._replace(values=motion, poses=None if series.held else values)


def holds_velocities(config: PoseTopic, kind: str) -> bool:
    """Whether the velocities of messages of this type are used, not their poses."""
    wanted = isinstance(config, OdometryTopic) and (config.use == "twist" or kind not in POSES)
    return wanted and kind in TWISTS


def value_of(config: PoseTopic, kind: str, content: Any, place: str) -> Vector | None:
    """The pose (x m, y m, heading rad) in a message of this type, or its velocities (m/s, m/s, rad/s); None
    if it is of other frames than the settings name.

    Raises:
        InputError: a number is not finite, or the orientation is 0.
    """
    wanted = tuple(frame.lstrip("/") for frame in config.frames)
    if wanted != frames_of(content)[: len(wanted)]:
        return None
    if not holds_velocities(config, kind):
        return pose_in_plane(*POSES[kind](content), place, config.plane)
    value = twist_in_plane(TWISTS[kind](content))
    if not all(map(math.isfinite, value)):
        raise InputError(place, f"the velocities are {', '.join(map(str, value))}", "finite numbers")
    return value


def read_poses(bag: Bag, config: PoseTopic, role: str = "truth") -> Series:
    """Poses [M, 3] (x m, y m, heading rad) of a topic or between two frames; of odometry, also velocities.

    Args:
        role: `truth` or `odometry`.

    Raises:
        InputError: the topic does not exist or has neither.
    """
    if config.tf is not None:
        series = _poses_between(bag, config.tf, role, config.plane)._replace(body=config.tf[1])
        return series._replace(errors=series.errors + nonfinite_errors(series.values, role, series.place))
    assert config.topic is not None
    known = POSES | TWISTS if role == "odometry" else POSES
    topic = bag.topic(config.topic, f"recording.topics.{role}", known)
    where = f"{bag.path}, {topic.name}"
    twist = holds_velocities(config, topic.kind)
    rows, kept, points, doubts = list[Any](), list[Any](), list[Any](), dict[str, list[str]]()

    def read(content: Any, place: str) -> Any:
        value = value_of(config, topic.kind, content, place)
        if twist or value is None:
            return value
        position, turn = POSES[topic.kind](content)
        points.append(position)
        found = list[str]()  # doubtful, and can be read
        if abs(np.hypot(np.hypot(*turn[:2]), np.hypot(*turn[2:])) - 1) > 0.01:
            found.append("orientations are not unit quaternions (only their direction is used)")
        covariance = np.asarray(getattr(getattr(content, "pose", None), "covariance", 0.0), float).ravel()
        if not np.isfinite(covariance).all() or (covariance[::7] < 0).any():
            found.append("covariances are not numbers or negative: the publisher did not know the pose")
        for doubt in found:
            doubts.setdefault(doubt, []).append(place)
        return value

    for number, time, content, value in bag.usable(topic, read):
        if value is not None:
            stamps = (bag.stamp(content, time, each) for each in (bag.clock, bags.OTHER_CLOCK[bag.clock]))
            rows.append((number, *stamps, frames_of(content), time))
            kept.append(value)
    if not rows:
        found = f"no message of the frames {', '.join(config.frames)}"
        raise InputError(where, found, "one at least", "`doctor` lists them")
    numbers, times, others, pairs, _ = ([row[k] for row in rows] for k in range(5))
    values = np.array(kept).reshape(-1, 3)
    poses = values * (0.0 if twist else 1.0)  # velocities of several nodes do not contradict each other
    errors = _frame_errors(bag, where, role, rows, poses)
    for doubt, at in doubts.items() if not errors else ():
        bag.warn(f"{at[0]}: {len(at)} of {len(rows)} {doubt}; look at the publisher")
    if not (twist or errors):
        errors = _plane_errors(np.array(points), where, role, config.plane)
    series = as_series(bag, where, numbers, times, values, others)
    errors += series.errors
    errors += nonfinite_errors(series.values, role, series.place)
    body = pairs[0][1] or ("" if topic.kind in POSES else pairs[0][0])
    return series._replace(errors=errors, body=body, held=twist)


def _frame_errors(bag: Bag, where: str, role: str, rows: list[Any], poses: np.ndarray) -> list[InputError]:
    """The error for messages of several frames whose poses [M, 3] disagree; those that agree are told.

    Several nodes that publish in turn make a path longer than that of each; a change of frame jumps or turns.
    The cure of a single change is the longer part beside it.

    Args:
        rows: of each message its number, times by both clocks, frames, and time of receipt, ns.
    """
    numbers, _, _, frames, received = zip(*rows, strict=True)
    counts = Counter(frames)
    if len(counts) < 2:
        return []
    usual = counts.most_common(1)[0][0]
    parts = [f"{' to '.join(filter(None, pair)) or 'no frame'} ({n})" for pair, n in counts.most_common()]
    found = f"messages of several frames: {', '.join(parts)}"
    names = np.array([list(counts).index(pair) for pair in frames])
    changes, places = np.flatnonzero(np.diff(names)), poses[:, :2]
    at = f"{where}, message {numbers[changes[0] + 1]}"
    alone = [_length(places[names == k]) for k in range(len(counts))]
    in_turn = len(changes) > len(counts)
    turned = np.median(np.abs(wrap(poses[changes + 1, 2] - poses[changes, 2])))
    # Poses agree up to a path of all frames that is this many times that of each of them.
    if turned < TURNED and _length(places) <= 1.2 * (max(alone) if in_turn else sum(alone)):
        bag.warn(f"{at}: {found}; their poses agree, look at the publisher")
        return []
    cure = f"--set recording.topics.{role}.frames=[{','.join(filter(None, usual))}]"
    if len(changes) == 1:
        end = "to" if frames[0] == usual else "from"
        middle = float(np.mean(received[changes[0] : changes[0] + 2]))
        cure = f"--set recording.{end}={bag.since_start(middle):.3f}"
    found += "; several nodes publish here, or it changes"
    return [InputError(at, found, "one frame and child frame", cure)]


def _length(places: np.ndarray) -> float:
    return float(np.hypot(*np.diff(places, axis=0).T).sum())
