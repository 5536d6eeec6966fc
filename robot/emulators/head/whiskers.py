"""The whiskers of an emulated head, simulated in blocks of samples."""

from __future__ import annotations

from typing import Any

import numpy as np

from robot.drivers.head.protocol import Command
from robot.emulators.head.config import HeadEmulatorConfig
from robot.emulators.head.pose_source import AlongPath, PoseSource
from robot.emulators.head.sensor_array import Block, block_samples
from robot.emulators.head.servo_drives import ServoDrives
from robot.simulation.head.baseline import Baseline, make_baseline
from robot.simulation.head.beam import StreamConfig
from robot.simulation.head.kinematic import MechanicsConfig
from robot.simulation.head.quasistatic import advance_balance, whiskers_at_rest
from robot.simulation.head.whisk_stream import WallSweep, draw_noise, sensor_readings, sweep_walls
from robot.world.walls import NO_CONTACT, Surroundings, Walls
from tactile.base.random_streams import stream
from tactile.whiskers.head_geometry import Head, ur10_head

STEP = 1e-4
"""Resolution of lifts, m; an arm at working height stays within it."""


class Whiskers:
    """The whiskers with their state between blocks, and the walls.

    Attributes:
        drives: the drives, which receive commands. pose, lift: of the head at the end of the last block.
    """

    def __init__(
        self,
        config: StreamConfig,
        mechanics: MechanicsConfig,
        head: Head,
        walls: Walls,
        place: PoseSource,
        random: np.random.Generator,
        samples: int,
        baseline: Baseline | None = None,
    ) -> None:
        self.config, self.mechanics, self.head = config, mechanics, head
        self.baseline = baseline
        self.walls, self.place, self.random, self.samples = walls, place, random, samples
        self.drives = ServoDrives(head, config.rate)
        self.balance = whiskers_at_rest(1, len(head.length))
        self.pose: np.ndarray | None = None
        self.lift = np.inf
        self._around: Surroundings | None = None
        self._lowered = np.inf
        # Above this lift no tip reaches the tallest wall.
        self._clear = float(walls.height.max() + (head.length - head.base[:, 2]).max())

    @property
    def count(self) -> int:
        return len(self.head.length)

    @property
    def resting(self) -> bool:
        return self.drives.resting

    def begin(self, time: float) -> None:
        if isinstance(self.place, AlongPath):
            self.place.begin(time)

    def receive(self, command: Command, now: float) -> None:
        self.drives.receive(command, now)

    def stop(self) -> None:
        self.drives.stop()

    def state(self, now: float) -> dict[str, Any]:
        """Pose and activity, as JSON values."""
        whisk = self.drives.whisk
        pose, lift = self.place.at(now)
        doing = {} if whisk is None else whisk.whisking.model_dump() | {"amplitude": whisk.amplitude.tolist()}
        return {
            "resting": self.drives.resting,
            "whisking": doing,
            "angle": self.balance.before[0].tolist(),
            "pose": pose.tolist(),
            "lift": float(lift) if np.isfinite(lift) else None,
        }

    def skip_block(self) -> None:
        """Skips a block without samples or motion."""
        self.pose = None

    def block(self, start: float, end: float) -> Block:
        """The samples between two times, s, host's monotonic clock."""
        rate, size = self.config.rate, self.samples
        if self.pose is None:
            self.pose, self.lift = self.place.at(start)
        before = self.pose
        self.pose, self.lift = self.place.at(end)
        pose = np.stack([before, self.pose])[None]
        noise = draw_noise(self.mechanics, (1, size, self.count), self.random, self.baseline)
        begins, parts, done = np.zeros(size, bool), [], 0
        while done < size:
            share = done / size
            self.balance = self.drives.begin(start + share * (end - start), self.balance)
            first, left = self.drives.sample, self.drives.samples_left
            begins[done] = self.drives.whisk is not None and first == 0
            count = size - done if left is None else min(size - done, left)
            # Time counts from the start of the whisk, possibly within the block.
            knots = np.array([first - done, first - done + size]) / rate
            time = (first + np.arange(count)) / rate
            sweep = self._sweep(pose, knots, time, noise[:, done : done + count])
            truth, self.balance = advance_balance(
                self.config, self.mechanics, self.drives.law, sweep, self.balance
            )
            parts.append(sensor_readings(self.config, self.head, truth, sweep.noise, self.baseline))
            self.drives.sample = 0 if left is None else first + count
            done += count
        angle, deflection = (np.concatenate([part[k][0] for part in parts]) for k in range(2))
        return Block(angle, deflection, begins, bool((self.balance.drive.most > 0).any()))

    def _sweep(self, pose: np.ndarray, knots: np.ndarray, time: np.ndarray, noise: np.ndarray) -> WallSweep:
        if self.lift < self._clear:
            return sweep_walls(self._surroundings(), pose, knots, time, noise)
        nothing = np.zeros((len(time), 1, len(self.head.length)))
        return WallSweep(time, nothing + NO_CONTACT, nothing + 1.0, nothing, noise)

    def _surroundings(self) -> Surroundings:
        """The walls relative to a lifted head: lower by the lift, m."""
        lift = STEP * round(self.lift / STEP)
        if self._around is None or lift != self._lowered:
            lower = self.walls._replace(height=self.walls.height - lift)
            self._around, self._lowered = Surroundings(lower, self.head), lift
        return self._around


def maze_whiskers(config: HeadEmulatorConfig, walls: Walls, place: PoseSource) -> Whiskers:
    """The whiskers of an emulated head among the walls of its maze."""
    rate, mechanics, head = config.stream.rate, config.mechanics, ur10_head(config.head)
    return Whiskers(
        config.stream,
        mechanics,
        head,
        walls,
        place,
        stream(config.seed, "sensor"),
        block_samples(rate),
        make_baseline(mechanics.baseline, mechanics.noise, rate, len(head.length), config.seed),
    )
