"""Odometry and true poses of a bag."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from robot.recordings.bags.bag import OTHER_CLOCK, Bag, Series, as_series
from robot.recordings.bags.topics_config import OdometryTopic, PoseTopic
from robot.recordings.bags.transforms import (
    POSES,
    TWISTS,
    frames_of,
    plane_errors,
    pose_in_plane,
    poses_between,
    twist_in_plane,
)
from robot.recordings.sanity_checks import nonfinite_errors
from robot.sources.odometry import from_poses, from_velocities
from tactile.base.errors import InputError
from tactile.base.se2 import integrate, wrap

TURNED = 0.5
"""Typical turn between poses of different frames, rad, from which they disagree."""


def read_odometry(bag: Bag, config: OdometryTopic) -> Series:
    """The odometry: motions [N, 4] (dx m, dy m, dtheta rad, dt s) since the previous sample.

    Raises:
        InputError: the topic does not exist or has no odometry.
    """
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


def read_poses(bag: Bag, config: PoseTopic, role: str = "truth") -> Series:
    """Poses [M, 3] (x m, y m, heading rad) of a topic or between two frames; of odometry, also velocities.

    Args:
        role: `truth` or `odometry`.

    Raises:
        InputError: the topic does not exist or has neither.
    """
    if config.tf is not None:
        series = poses_between(bag, config.tf, role, config.plane)._replace(body=config.tf[1])
        return series._replace(errors=series.errors + nonfinite_errors(series.values, role, series.place))
    assert config.topic is not None
    topic = bag.topic(config.topic, f"recording.topics.{role}")
    where = f"{bag.path}, {topic.name}"
    wanted_twist = isinstance(config, OdometryTopic) and (config.use == "twist" or topic.kind not in POSES)
    twist = wanted_twist and topic.kind in TWISTS
    if topic.kind not in POSES and not twist:
        known = [*POSES, *TWISTS] if role == "odometry" else [*POSES]
        raise InputError(where, f"messages of type {topic.kind}", f"one of {', '.join(dict.fromkeys(known))}")
    rows, kept, points, doubts = list[Any](), list[Any](), list[Any](), dict[str, list[str]]()
    wanted = tuple(frame.lstrip("/") for frame in config.frames)

    def read(content: Any, place: str) -> Any:
        if wanted != frames_of(content)[: len(wanted)]:
            return None
        if twist:
            value = twist_in_plane(TWISTS[topic.kind](content))
            if not np.isfinite(value).all():
                raise InputError(place, f"the velocities are {', '.join(map(str, value))}", "finite numbers")
            return value
        position, turn = POSES[topic.kind](content)
        value = pose_in_plane(position, turn, place, config.plane)
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
            stamps = (bag.stamp(content, time, each) for each in (bag.clock, OTHER_CLOCK[bag.clock]))
            rows.append((number, *stamps, frames_of(content), time))
            kept.append(value)
    if not rows:
        raise InputError(where, f"no message of the frames {wanted}", "one at least", "`doctor` lists them")
    numbers, times, others, pairs, received = ([row[k] for row in rows] for k in range(5))
    values = np.array(kept).reshape(-1, 3)
    poses = values * (0.0 if twist else 1.0)  # velocities of several nodes do not contradict each other
    errors = _frame_errors(where, numbers, pairs, role, poses, received, bag)
    for doubt, at in doubts.items() if not errors else ():
        bag.warn(f"{at[0]}: {len(at)} of {len(rows)} {doubt}; look at the publisher")
    if not (twist or errors):
        errors = plane_errors(np.array(points), where, role, config.plane)
    series = as_series(bag, where, numbers, times, values, others)
    errors += series.errors
    errors += nonfinite_errors(series.values, role, series.place)
    body = pairs[0][1] or ("" if topic.kind in POSES else pairs[0][0])
    return series._replace(errors=errors, body=body, held=twist)


def _frame_errors(
    where: str,
    numbers: list[int],
    frames: list[Any],
    role: str,
    poses: np.ndarray,
    received: list[int],
    bag: Bag,
) -> list[InputError]:
    """The error for messages of several frames whose poses [M, 3] disagree; those that agree are told.

    Several nodes that publish in turn make a path longer than that of each; a change of frame jumps or turns.
    `received`: times of receipt, ns; the cure of a single change is the longer part beside it.
    """
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
