"""Odometry and true poses of a bag."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from robot.recordings.bags.bag import Bag
from robot.recordings.bags.config import OdometryTopic, PoseTopic
from robot.recordings.bags.motions import ODOMETRY, POSES, TWISTS, twist_in_plane
from robot.recordings.bags.stamps import Clock, Report, Series, as_series, read_messages
from robot.recordings.bags.transforms import poses_between
from robot.recordings.sanity_checks import nonfinite_errors
from robot.recordings.unit_check import UnitLimits
from robot.sources.odometry import from_poses, from_velocities
from tactile.base.errors import InputError
from tactile.base.se2 import integrate


class BagOdometry(NamedTuple):
    """The odometry of a bag, N samples.

    Attributes:
        time: [N] s. motion: [N, 4] (dx m, dy m, dtheta rad, dt s) since the previous sample.
        where: file and topic. body: frame of the robot, '' if the bag does not say.
    """

    time: np.ndarray
    motion: np.ndarray
    where: str
    body: str
    errors: list[InputError]


def read_odometry(
    bag: Bag, config: OdometryTopic, clock: Clock, limits: UnitLimits, report: Report
) -> BagOdometry:
    """The odometry; steps faster than the limits are reported.

    Raises:
        InputError: the topic does not exist or has no odometry.
    """
    twist = False
    if config.tf is not None:
        body = config.tf[1]
        series = poses_between(bag, config.tf, clock, report)
    else:
        assert config.topic is not None
        kind = bag.topic(config.topic, "recording.topics.odometry").kind
        twist = kind in TWISTS and (config.use == "twist" or kind not in POSES)
        series, body = _read_series(bag, config.topic, "odometry", clock, report, twist)
    errors = series.errors + nonfinite_errors(series.values, "odometry", series.place)
    time, values = series.time, series.values
    if len(time) < 2 and not errors:
        errors.append(InputError(series.where, "one message with odometry", "at least two"))
    if errors:
        return BagOdometry(time, np.zeros((len(time), 4)), series.where, body, errors)
    motion = from_velocities(time, *values.T) if twist else from_poses(time, values)
    _report_jumps(motion, time, series.where, limits, report)
    if config.every > 1:
        time, poses = time[:: config.every], integrate(motion[:, :3])[:: config.every]
        motion = from_poses(time, poses)
    return BagOdometry(time, motion, series.where, body, [])


def read_poses(bag: Bag, config: PoseTopic, clock: Clock, report: Report) -> Series:
    """True poses [M, 3] (x m, y m, heading rad).

    Raises:
        InputError: the topic does not exist or has no poses.
    """
    if config.tf is not None:
        series = poses_between(bag, config.tf, clock, report)
    else:
        assert config.topic is not None
        series, _ = _read_series(bag, config.topic, "truth", clock, report, twist=False)
    return series._replace(errors=series.errors + nonfinite_errors(series.values, "truth", series.place))


def motion_at(moments: np.ndarray, time: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Odometry interpolated to other times.

    Args:
        moments: [M] s, increasing. time: [N] s of the odometry. motion: [N, 4].

    Returns:
        inside: [M] bool, moments within the odometry. motion: [I, 4] between these.
    """
    inside = (time[0] <= moments) & (moments <= time[-1])
    if not inside.any():
        return inside, np.zeros((0, 4))
    path = integrate(motion[:, :3])
    path[:, 2] = np.unwrap(path[:, 2])
    at = [np.interp(moments[inside], time, column) for column in path.T]
    return inside, from_poses(moments[inside], np.column_stack(at))


def _read_series(
    bag: Bag, name: str, role: str, clock: Clock, report: Report, twist: bool
) -> tuple[Series, str]:
    """Poses or velocities [M, 3] of a topic, and the frame of the robot."""
    topic = bag.topic(name, f"recording.topics.{role}")
    where = f"{bag.path}, {topic.name}"
    if topic.kind not in POSES and not twist:
        known = [*POSES, *TWISTS] if role == "odometry" else [*POSES]
        raise InputError(where, f"messages of type {topic.kind}", f"one of {', '.join(dict.fromkeys(known))}")
    numbers, stamps, values, body = list[int](), list[int](), list[tuple[float, float, float]](), ""
    for number, stamp, content in read_messages(bag, topic, clock):
        if twist:
            values.append(twist_in_plane(TWISTS[topic.kind](content)))
        else:
            values.append(POSES[topic.kind](content, f"{where}, message {number}"))
        body = body or _body_of(content, topic.kind)
        numbers.append(number)
        stamps.append(stamp)
    return as_series(where, numbers, stamps, np.array(values).reshape(-1, 3), clock, report), body


def _body_of(message: Any, kind: str) -> str:
    """The frame of the robot; '' if the message does not name it."""
    if kind == ODOMETRY:
        return str(message.child_frame_id)
    return "" if kind in POSES else str(message.header.frame_id)


def _report_jumps(
    motion: np.ndarray, time: np.ndarray, where: str, limits: UnitLimits, report: Report
) -> None:
    length = np.hypot(motion[1:, 0], motion[1:, 1])
    jumps = length > limits.speed * motion[1:, 3]
    if jumps.any():
        row = int((length * jumps).argmax()) + 1
        step = f"jumps by {length[row - 1]:.3g} m in {motion[row, 3]:.3g} s at {time[row]:.3f} s"
        count = f"the largest of {int(jumps.sum())} steps faster than limits.speed ({limits.speed:g} m/s)"
        report(f"{where}: {step}, {count}")
