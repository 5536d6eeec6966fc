"""Poses of the head over time along a route, with random variation between visits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from robot.world.maze import Cell, cell_centre
from tactile.base.se2 import wrap
from tactile.base.settings import Settings


class JitterConfig(Settings):
    """Random variation between visits, as standard deviations; drawn anew in every cell."""

    position: NonNegativeFloat = 0.002
    """Position off the cell centre along each axis, m."""
    yaw_deg: NonNegativeFloat = 0.5
    """Heading off the direction of travel, degrees."""
    speed: NonNegativeFloat = 0.0
    """Speed, as a fraction of it."""


class MotionConfig(Settings):
    """Motion of the arm."""

    speed: PositiveFloat = 0.03
    """Speed along the route, m/s."""
    turn_rate: PositiveFloat = 0.4
    """Turn rate on the spot, rad/s."""
    backwards: bool = False
    """Whether the head faces backwards (reverse tracking)."""
    jitter: JitterConfig = JitterConfig()
    """Variation between visits."""


class HeadPath(NamedTuple):
    """Poses in order of time, with uniform motion in between.

    Attributes:
        time: [K] s. pose: [K, 3] m, m, rad; headings are not wrapped.
    """

    time: np.ndarray
    pose: np.ndarray

    @property
    def duration(self) -> float:
        return float(self.time[-1])


def plan_path(config: MotionConfig, way: Sequence[Cell], random: np.random.Generator) -> HeadPath:
    """The path along cells: straight from centre to centre, with turns on the spot."""
    jitter = config.jitter
    count = len(way)
    offset = jitter.position * random.standard_normal((count, 2))
    yaw = np.radians(jitter.yaw_deg) * random.standard_normal(count)
    pace = config.speed * np.clip(1 + jitter.speed * random.standard_normal(count), 0.2, 5.0)
    middle = np.array([cell_centre(cell) for cell in way])
    step = np.diff(middle, axis=0)
    course = np.arctan2(step[:, 1], step[:, 0]) + (np.pi if config.backwards else 0.0)
    heading = np.concatenate([course[:1], course[:1] + np.cumsum(wrap(np.diff(course)))])

    place = middle + offset
    time, pose = [0.0], [[*place[0], heading[0] + yaw[0]]]
    for k in range(count - 1):
        turn = heading[k] - (heading[k - 1] if k else heading[0])
        if turn:
            time.append(time[-1] + abs(turn) / config.turn_rate)
            pose.append([*place[k], heading[k] + yaw[k]])
        time.append(time[-1] + float(np.hypot(*step[k])) / pace[k])
        pose.append([*place[k + 1], heading[k] + yaw[k + 1]])
    return HeadPath(np.array(time), np.array(pose))


def poses_at(path: HeadPath, time: np.ndarray) -> np.ndarray:
    """Poses [..., 3] at times [...] s; clamped to the ends of the path."""
    return np.stack([np.interp(time, path.time, path.pose[:, k]) for k in range(3)], axis=-1)


def add_kidnaps(path: HeadPath, at_times: Sequence[float], ahead: float) -> tuple[HeadPath, np.ndarray]:
    """The path with kidnaps: at each of these times the head jumps to its pose `ahead` s later.

    Returns:
        the path, and the times [J] of the kidnaps, s.
    """
    times, poses, start, done = [], [], 0.0, 0.0
    jumps = []
    for when in [*sorted(at_times), np.inf]:
        stop = min(max(when + start - done, start), path.duration)
        inner = (path.time > start) & (path.time < stop)
        part = np.concatenate([[start], path.time[inner], [stop]])
        times.append(part - start + done)
        poses.append(poses_at(path, part))
        done += stop - start
        start = stop + ahead
        if start >= path.duration or not np.isfinite(when):
            break
        jumps.append(done)
    return HeadPath(np.concatenate(times), np.concatenate(poses)), np.array(jumps)
