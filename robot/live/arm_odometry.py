"""Odometry of the arm: poses at any time, and the motion between whisks."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from itertools import islice

import numpy as np

from robot.drivers.ur10.base_transform import pose_from_tcp, tcp_heading
from robot.live.live_config import LiveConfig
from robot.sources.odometry import MIDPOINT, OdometryErrors, from_velocities, motions_between
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, wrap
from tactile.base.types import Odometry

HISTORY = 10.0
"""Time span of the stored states, s."""


class ArmOdometry:
    """Collects the arm's states by host time and interpolates poses and motions."""

    def __init__(self, config: LiveConfig) -> None:
        self._config = config
        self._states: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self._errors = OdometryErrors(config.noise, stream(config.seed, "live.odometry"))
        self._last: tuple[float, np.ndarray] | None = None  # time stamp and pose of the last call of `step`

    def add(self, time: np.ndarray, tcp: np.ndarray, speed: np.ndarray) -> None:
        """Adds states.

        Args:
            time: [N] s, host. tcp, speed: [N, 6] tool poses and their rates in the base frame."""
        self._states.extend(zip(time.tolist(), tcp, speed, strict=True))
        while self._states and self._states[0][0] < self._states[-1][0] - HISTORY:
            self._states.popleft()

    @property
    def span(self) -> float:
        """Time span of the stored states, s."""
        return self._states[-1][0] - self._states[0][0] if self._states else 0.0

    def pose(self, time: float) -> np.ndarray:
        """Pose of the head in the map [3] at a time, interpolated between two states; outside
        their span, the nearest pose."""
        last = len(self._states) - 1
        k = min(max(bisect_left(self._states, time, key=_time_of), 1), last)
        pair = [self._states[max(k - 1, 0)], self._states[k]]
        poses, _ = pose_from_tcp(self._config.arm.placing, np.stack([state[1] for state in pair]))
        span = pair[1][0] - pair[0][0]
        share = float(np.clip((time - pair[0][0]) / span, 0, 1)) if span > 0 else 0.0
        step = poses[1] - poses[0]
        step[2] = wrap(step[2])
        pose = poses[0] + share * step
        pose[2] = wrap(pose[2])
        return pose

    def step(self, stamp: float, time: float) -> tuple[Odometry, np.ndarray]:
        """The motion since the last call, with the configured errors, and the pose now.

        Args:
            stamp: time stamp of the whisk, session time, s. time: the same moment in host time, s.
        """
        truth = self.pose(time)
        if self._last is None:
            self._last = stamp, truth
            return Odometry(0.0, 0.0, 0.0, 0.0), truth
        before, start = self._last
        pose = truth
        if self._config.odometry == "velocity":
            pose = self._integrate_velocity(start, stamp - before, time)
        # Headings are not wrapped: errors depend on the total turn.
        pose = np.array([*pose[:2], start[2] + wrap(pose[2] - start[2])])
        self._last = stamp, pose
        motion = motions_between(np.stack([start, pose]))
        ((dx, dy, dtheta),) = self._errors.add_to(np.array([before, stamp]), motion)
        return Odometry(dx, dy, dtheta, np.float64(stamp) - before), truth

    def _integrate_velocity(self, start: np.ndarray, took: float, time: float) -> np.ndarray:
        """Pose reached from the last one at the mean velocity since then."""
        since, until = (bisect_right(self._states, end, key=_time_of) for end in (time - took, time))
        states = list(islice(self._states, since, until))
        if not states:
            return start
        _, tcp, speed = (np.array(column) for column in zip(*states, strict=True))
        heading = tcp_heading(tcp)
        c, s = np.cos(heading), np.sin(heading)
        forward, left = c * speed[:, 0] + s * speed[:, 1], -s * speed[:, 0] + c * speed[:, 1]
        times = np.array([0.0, took])
        mean = [np.array([0.0, part.mean()]) for part in (forward, left, speed[:, 5])]
        motion = from_velocities(times, mean[0], mean[1], mean[2], MIDPOINT)[1, :3]
        return compose(start, motion)


def _time_of(state: tuple[float, np.ndarray, np.ndarray]) -> float:
    return state[0]
