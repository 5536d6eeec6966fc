"""Odometry of the arm: poses at any time, and the motion between whisks."""

from __future__ import annotations

from collections import deque

import numpy as np

from robot.drivers.ur10.base_transform import pose_from_tcp, tcp_heading
from robot.live.config import LiveConfig
from robot.sources.odometry import MIDPOINT, from_velocities, simulate_odometry
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
        self._time: list[float] = []
        self._pose: list[np.ndarray] = []

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
        times = np.array([state[0] for state in self._states])
        k = int(np.clip(np.searchsorted(times, time), 1, len(times) - 1)) if len(times) > 1 else 0
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
        pose = self.pose(time)
        if self._config.odometry == "velocity" and self._time:
            pose = self._integrate_velocity(stamp - self._time[-1], time)
        # Headings are not wrapped: errors depend on the total turn.
        last = self._pose[-1][2] if self._pose else pose[2]
        self._pose.append(np.array([*pose[:2], last + wrap(pose[2] - last)]))
        self._time.append(stamp)
        random = stream(self._config.seed, "live.odometry")
        # Without noise a row depends on two poses only. Errors are drawn from the start each time, so that
        # those of a whisk do not depend on the whisks that follow.
        first = -2 if self._config.noise.noise == "none" else 0
        time_stamps, poses = np.array(self._time[first:]), np.array(self._pose[first:])
        rows = simulate_odometry(self._config.noise, time_stamps, poses, random)
        return Odometry(*rows[-1]), self.pose(time)

    def _integrate_velocity(self, took: float, time: float) -> np.ndarray:
        """Pose reached from the last one at the mean velocity since then."""
        states = [state for state in self._states if time - took < state[0] <= time]
        if not states:
            return self._pose[-1]
        _, tcp, speed = (np.array(column) for column in zip(*states, strict=True))
        heading = tcp_heading(tcp)
        c, s = np.cos(heading), np.sin(heading)
        forward, left = c * speed[:, 0] + s * speed[:, 1], -s * speed[:, 0] + c * speed[:, 1]
        times = np.array([0.0, took])
        mean = [np.array([0.0, part.mean()]) for part in (forward, left, speed[:, 5])]
        motion = from_velocities(times, mean[0], mean[1], mean[2], MIDPOINT)[1, :3]
        return compose(self._pose[-1], motion)
