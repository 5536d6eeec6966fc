"""An emulated arm with its whisker head in virtual time: whisks as fast as they are computed.

The arm is the emulator's, each move is checked and planned as for a real one, and the head gives contact
features (`robot.simulation.head.kinematic`). No sockets, processes or clocks.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from robot.drivers.outcome import Fault
from robot.drivers.ur10.base_transform import pose_from_tcp, tcp_from_pose
from robot.drivers.ur10.safety import plan_move
from robot.emulators.ur10.emulated_arm import EmulatedArm
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.emulators.ur10.urscript_moves import MoveL
from robot.live.arm_odometry import ArmOdometry
from robot.live.live_config import LiveConfig
from robot.simulation.head.kinematic import HeadSetup, simulate_kinematic
from robot.sources.source import Sample
from robot.world.head_trajectory import HeadPath
from robot.world.walls import Surroundings
from tactile.base.random_streams import stream
from tactile.base.types import Whisk
from tactile.whiskers.whisking import MID_PROTRACTION


class VirtualArm:
    """Arm and head; it has the methods of `robot.drivers.ur10.arm.Arm` that routes call.

    Args:
        start: [3] pose of the head in the arm's map (m, m, rad). surroundings: walls; they may be replaced.

    Attributes:
        surroundings: walls. time: s. poses: [3] of the head after each control step so far.
    """

    fault: Fault | None = None

    def __init__(self, config: LiveConfig, surroundings: Surroundings, start: np.ndarray) -> None:
        self.surroundings, self.time = surroundings, 0.0
        self._config, self._dt = config, 1.0 / config.arm.hz
        tcp = tuple(map(float, tcp_from_pose(config.arm.placing, start)))
        self._arm = EmulatedArm(UrEmulatorConfig(hz=config.arm.hz, start=tcp))  # type: ignore[arg-type]
        plan = config.plan
        self._setup = HeadSetup(surroundings.head, plan.stream, plan.mechanics, plan.whisking)
        self._random = stream(plan.seed, "live.sensor")
        self._odometer = ArmOdometry(config)
        self._remember()
        self.poses = [self._pose()]

    def move(self, tcp: np.ndarray, speed: float | None = None) -> None:
        """Starts a straight move; it replaces the present one.

        Raises:
            robot.drivers.ur10.safety.TargetRefused: the target is rejected.
        """
        move = plan_move(self._config.arm, tcp, np.array(self._arm.state.tcp), speed)
        goal = tuple(map(float, move.target))
        self._arm.order([MoveL(goal, move.speed, self._config.arm.acceleration)])  # type: ignore[arg-type]

    def arrived(self) -> bool:
        """Whether the arm has no unfinished move."""
        return not self._arm.busy

    def halt(self) -> None:
        """Stops the arm."""
        self._arm.halt(self._config.arm.deceleration)

    def whisk(self) -> Sample:
        """The next whisk, with the motion of the arm meanwhile; the odometry has the configured errors."""
        period = 1 / self._config.plan.whisking.rate
        begin, first = self.time, len(self.poses) - 1
        for _ in range(round(period / self._dt)):
            self._arm.step(self._dt)
            self.time += self._dt
            self._remember()
            self.poses.append(self._pose())
        steps = np.array(self.poses[first:])
        steps[:, 2] = np.unwrap(steps[:, 2])
        path = HeadPath(np.linspace(begin, self.time, len(steps)), steps)
        features = simulate_kinematic(self._setup, self.surroundings, path, np.array([begin]), self._random)
        stamp = begin + MID_PROTRACTION * period
        odometry, truth = self._odometer.step(stamp, stamp)
        alive = self._setup.head.alive
        return Sample(stamp, Whisk(odometry, alive, *(column[0] for column in features)), truth)

    def whisks(self) -> Iterator[Sample]:
        """Whisk after whisk, without end."""
        while True:
            yield self.whisk()

    def _pose(self) -> np.ndarray:
        return pose_from_tcp(self._config.arm.placing, np.array(self._arm.state.tcp))[0]

    def _remember(self) -> None:
        state = self._arm.state
        self._odometer.add(np.array([self.time]), np.array([state.tcp]), np.array([state.speed]))
