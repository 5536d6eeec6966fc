"""Arm and head of a live session, polled a hundred times a second, with one clock for both.

Odometry of the arm gives its pose at any time, and the motion between whisks.
"""

from __future__ import annotations

import time
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable
from itertools import islice
from operator import itemgetter

import numpy as np

from robot.drivers.clock_sync import ClockSync
from robot.drivers.head.device import open_bridge
from robot.drivers.head.reader import HeadReader
from robot.drivers.head.whisk_control import HeadDriver
from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.driver_config import tcp_heading
from robot.live.live_config import LiveConfig
from robot.live.polling import TICK, HeadRig, OperatorStop, PolledRig, SessionFault, session_fault
from robot.simulation.head.odometry_errors import OdometryErrors, motions_between
from robot.sources.odometry import from_velocities
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, wrap
from tactile.base.types import Odometry
from tactile.whisker_geometry import HeadConfig, ur10_head

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

    def pose(self, time: float) -> np.ndarray:
        """Pose of the head in the map [3] at a time, interpolated between two states; outside
        their span, the nearest pose."""
        last = len(self._states) - 1
        k = min(max(bisect_left(self._states, time, key=itemgetter(0)), 1), last)
        pair = [self._states[max(k - 1, 0)], self._states[k]]
        poses, _ = self._config.arm.placing.pose_from_tcp(np.stack([state[1] for state in pair]))
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
        since, until = (bisect_right(self._states, end, key=itemgetter(0)) for end in (time - took, time))
        states = list(islice(self._states, since, until))
        if not states:
            return start
        _, tcp, speed = (np.array(column) for column in zip(*states, strict=True))
        heading = tcp_heading(tcp)
        c, s = np.cos(heading), np.sin(heading)
        forward, left = c * speed[:, 0] + s * speed[:, 1], -s * speed[:, 0] + c * speed[:, 1]
        mean = [np.array([0.0, part.mean()]) for part in (forward, left, speed[:, 5])]
        motion = from_velocities(np.array([0.0, took]), mean[0], mean[1], mean[2])
        return compose(start, motion[1, :3])


MAX_REST_TIME, REST_TIME = 2.0, 0.3
"""Longest wait for a stopped arm, and required time at rest, s: after a contact it stops, then backs off."""


class ArmRig(PolledRig):
    """The arm of a session; a context manager that leaves it at rest.

    Attributes:
        arm: the arm. odometer: its odometry. state_ages: age of the newest state at each poll, s.
    """

    def __init__(self, config: LiveConfig, stopped: Callable[[], bool]) -> None:
        PolledRig.__init__(self, config, stopped)
        self.arm = Arm(config.arm)
        self.odometer = ArmOdometry(config)
        self.state_ages: list[float] = []
        self._arm_clock = ClockSync()
        self._seen = 0

    def poll(self) -> None:
        """Reads the states of the arm; see `PolledRig`."""
        self._take_states()
        self._check()

    def _check(self) -> None:
        fault = self.arm.fault or (self.recorder and self.recorder.fault)
        if fault:
            raise SessionFault(fault)
        if self._arm_clock.jumps:
            raise session_fault(SessionOutcome.CLOCK_JUMPED, "the controller's clock jumped")
        if self._stopped():
            raise OperatorStop

    def begin(self) -> None:
        """Sets time 0 of the session to now."""
        self.epoch = time.monotonic()
        self.state_ages = []

    def rest(self) -> bool:
        """Stops the arm, unless a fault has; returns whether it rests."""
        if self.arm.fault is None:
            self.arm.halt()
        began = stood = now = time.monotonic()
        while now - stood < REST_TIME and now - began < MAX_REST_TIME:
            time.sleep(TICK)
            now = time.monotonic()
            if not self.arm.still() and self.arm.age() <= self.config.arm.stale:
                stood = now
        return self.arm.still()

    def _take_states(self) -> None:
        states = self.arm.states(self._seen)
        if self.arm.latest() is not None:
            self.state_ages.append(self.arm.age())
        if not len(states):
            return
        self._seen = int(states["counter"][-1])
        for robot, host in zip(states["robot"].tolist(), states["host"].tolist(), strict=True):
            self._arm_clock.observe(robot, host)
        times = np.asarray(self._arm_clock.to_host(states["robot"]))
        self.odometer.add(times, states["tcp"], states["speed"])
        if self.recorder is not None:
            states["host"] -= self.epoch
            self.recorder.add_states(states)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is KeyboardInterrupt:  # second interrupt: stop by the dashboard server at once
            dashboard.stop_program(self.config.arm.host)
        self.arm.close()


class Rig(ArmRig, HeadRig):
    """Arm and whisker head of a session; a context manager that leaves both at rest.

    Attributes:
        head, driver: the head and its commands.
    """

    def __init__(self, config: LiveConfig, head: HeadConfig, stopped: Callable[[], bool]) -> None:
        ArmRig.__init__(self, config, stopped)
        self.shape = ur10_head(head)
        shape, link = self.shape, config.head

        def stop(whisker: int) -> None:
            self.arm.fail(SessionOutcome.CONTACT, f"whisker {whisker} is bent beyond the overload limit")

        reader = HeadReader(
            lambda: open_bridge(link.address), len(shape.length), link, alive=shape.alive, on_overload=stop
        )
        self.driver = HeadDriver(reader, self.shape)
        HeadRig.__init__(self, config, reader, stopped)

    def poll(self) -> None:
        """Reads the data of both devices; see `HeadRig`."""
        for frames, arrival in self.stream.take():
            if self.recorder is not None:
                self.recorder.add_frames(frames, arrival - self.epoch)
        self._take_states()
        if self.arm.fault is None and self.stream.fault is not None:
            raise SessionFault(self.stream.fault)
        self._check()

    def rest(self) -> bool:
        """Stops the arm, unless a fault has, and retracts the whiskers; returns whether the arm rests."""
        if self.arm.fault is None:
            self.arm.halt()
        self.driver.rest()
        return super().rest()

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        super().__exit__(kind, *error)
        self.head.close()
