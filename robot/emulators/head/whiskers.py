"""The whiskers of an emulated head, simulated in blocks of samples, and what its bridge asks of any whiskers.

Their drives whisk, rest, and retract if no commands arrive. A whisk starts at the start of a block of samples
or at the end of the previous whisk. The head stands, moves along a path or is carried by an arm.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from robot.drivers.head import usb_protocol as usb
from robot.drivers.ur10.driver_config import BaseTransformConfig
from robot.drivers.ur10.rtde_protocol import PoseListener
from robot.emulators.head.emulator_config import HeadEmulatorConfig
from robot.simulation.head.baseline import make_baseline
from robot.simulation.head.whisk_stream import (
    WhiskerBalance,
    advance_balance,
    draw_noise,
    sensor_readings,
    sweep_air,
    sweep_walls,
    whiskers_at_rest,
)
from robot.world.scene import HeadPath, poses_at
from robot.world.walls import Surroundings, Walls
from tactile.base.random_streams import stream
from tactile.whisker_geometry import Head, ur10_head
from tactile.whisking import WhiskDrive, WhiskingConfig, whisk_command, whisk_phase

BLOCK = 0.01
"""Samples are made and sent in blocks of this duration, s."""


def block_samples(rate: float) -> int:
    """Samples of a block at a rate, Hz."""
    return max(round(BLOCK * rate), 2)


class Block(NamedTuple):
    """T samples.

    Attributes:
        angle: [T, W] rad. deflection: [T, W, 2] rad. begins: [T] bool, the first sample of a whisk.
        fed_back: whether feedback has lowered an amplitude.
    """

    angle: np.ndarray
    deflection: np.ndarray
    begins: np.ndarray
    fed_back: bool


class SensorArray:
    """Simulated whiskers; fixed ones have no drives. Times are the host's monotonic clock, s."""

    count: int
    """Number of whiskers."""

    @property
    def resting(self) -> bool:
        """Whether all drives rest, so that blocks nobody reads need not be made."""
        return True

    def begin(self, time: float) -> None:
        """The stream of samples starts."""

    def block(self, start: float, end: float) -> Block:
        """The samples between two times."""
        raise NotImplementedError

    def skip_block(self) -> None:
        """Skips a block without samples or motion."""

    def receive(self, command: usb.Command, now: float) -> None:
        """Executes a command."""

    def stop(self) -> None:
        """Retracts the whiskers and stops the drives."""

    def state(self, now: float) -> dict[str, Any]:
        """Pose and activity, as JSON values."""
        raise NotImplementedError


STEP = 1e-4
"""Resolution of lifts, m; an arm at working height stays within it."""


class Whiskers(SensorArray):
    """The whiskers of an emulated head with their state between blocks, among the walls of its maze.

    Attributes:
        drives: the drives, which receive commands. pose, lift: of the head at the end of the last block.
    """

    def __init__(self, config: HeadEmulatorConfig, walls: Walls, place: PoseSource) -> None:
        rate, mechanics, head = config.stream.rate, config.mechanics, ur10_head(config.head)
        self.config, self.mechanics, self.head = config.stream, mechanics, head
        self.walls, self.place, self.random = walls, place, stream(config.seed, "sensor")
        self.count, self.samples = len(head.length), block_samples(rate)
        self.baseline = make_baseline(mechanics.baseline, mechanics.noise, rate, self.count, config.seed)
        self.drives = _ServoDrives(head, rate)
        self.balance = whiskers_at_rest(1, self.count)
        self.pose: np.ndarray | None = None
        self.lift = np.inf
        self._around: Surroundings | None = None
        self._lowered = np.inf
        # Above this lift no tip reaches the tallest wall.
        self._clear = float(walls.height.max() + (head.length - head.base[:, 2]).max())

    @property
    def resting(self) -> bool:
        return self.drives.resting

    def begin(self, time: float) -> None:
        if isinstance(self.place, AlongPath):
            self.place.begin(time)

    def receive(self, command: usb.Command, now: float) -> None:
        self.drives.receive(command, now)

    def stop(self) -> None:
        self.drives.stop()

    def state(self, now: float) -> dict[str, Any]:
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
        self.pose = None

    def block(self, start: float, end: float) -> Block:
        config, drives, size = self.config, self.drives, self.samples
        if self.pose is None:
            self.pose, self.lift = self.place.at(start)
        before = self.pose
        self.pose, self.lift = self.place.at(end)
        pose = np.stack([before, self.pose])[None]
        noise = draw_noise(self.mechanics, (1, size, self.count), self.random, self.baseline)
        begins, parts, done = np.zeros(size, bool), [], 0
        while done < size:
            share = done / size
            self.balance = drives.begin(start + share * (end - start), self.balance)
            first, left = drives.sample, drives.samples_left
            begins[done] = drives.whisk is not None and first == 0
            count = size - done if left is None else min(size - done, left)
            # Time counts from the start of the whisk, possibly within the block.
            knots = np.array([first - done, first - done + size]) / config.rate
            time = (first + np.arange(count)) / config.rate
            some = noise[:, done : done + count]
            if self.lift < self._clear:
                # The walls relative to a lifted head are lower by the lift, m.
                lift = STEP * round(self.lift / STEP)
                if self._around is None or lift != self._lowered:
                    lower = self.walls._replace(height=self.walls.height - lift)
                    self._around, self._lowered = Surroundings(lower, self.head), lift
                sweep = sweep_walls(self._around, pose, knots, time, some)
            else:
                sweep = sweep_air(time, some)
            truth, self.balance = advance_balance(config, self.mechanics, drives.law, sweep, self.balance)
            turned = np.interp(done + np.arange(count), [0, size], pose[0, :, 2])[None]
            parts.append(sensor_readings(config, self.head, truth, sweep.noise, self.baseline, turned))
            drives.sample = 0 if left is None else first + count
            done += count
        angle, deflection = (np.concatenate([part[k][0] for part in parts]) for k in range(2))
        return Block(angle, deflection, begins, bool((self.balance.drive.most > 0).any()))


RETRACTION = 0.2
"""Duration of the retraction, s."""


class _Whisk(NamedTuple):
    """A commanded whisk.

    Attributes:
        whisking: settings of the whisking law. samples: samples per cycle. offset: added to all angles, rad;
            with the amplitude it is within the limit of the drives. threshold: [W] rad. feedback: whether the
            law uses deflections; if not, the host sends amplitudes. amplitude: [W] rad, without feedback.
    """

    whisking: WhiskingConfig
    samples: int
    offset: float
    threshold: np.ndarray
    feedback: bool
    amplitude: np.ndarray


class _ServoDrives:
    """The drives of one head, sample by sample.

    Attributes:
        whisk: the whisk in progress; None at rest or during retraction. sample: next sample of the cycle.
    """

    def __init__(self, head: Head, rate: float) -> None:
        self.head, self.rate, self._retraction = head, rate, round(RETRACTION * rate)
        self.whisk: _Whisk | None = None
        self.sample = 0
        self._next: _Whisk | None = None
        self._command_time, self._stopped = -np.inf, False
        self._centre = np.zeros(len(head.length))
        self._from: np.ndarray | None = None  # angles at the start of the retraction

    @property
    def resting(self) -> bool:
        """Whether the drives are at rest and no command is pending."""
        return self.whisk is None and self._next is None and self._from is None

    @property
    def samples_left(self) -> int | None:
        """Samples until the next change; None while unknown."""
        if self.whisk is not None:
            return self.whisk.samples - self.sample
        return None if self._from is None else self._retraction - self.sample

    def receive(self, command: usb.Command, time: float) -> None:
        """Stores a command received at a time, s (the clock of `begin`)."""
        self._command_time = time
        kind, whisk, fits = command.kind, self.whisk, len(command.numbers) == len(self._centre)
        if kind == usb.CommandKind.DRIVE:
            self._next = self._make_whisk(command) or self._next
        elif kind == usb.CommandKind.CENTRE and fits:
            self._centre = command.numbers * usb.ANGLE
        elif kind == usb.CommandKind.AMPLITUDES and fits and whisk is not None and not whisk.feedback:
            most = self.head.limit - whisk.offset
            self.whisk = whisk._replace(amplitude=np.clip(command.numbers * usb.ANGLE, 0.0, most))

    def stop(self) -> None:
        """Retracts and discards pending commands."""
        self._stopped, self._next = True, None

    def begin(self, time: float, balance: WhiskerBalance) -> WhiskerBalance:
        """Selects the next activity; called at the start of each block and after `samples_left` samples.

        Returns:
            state of the whiskers: at rest at the beginning of a cycle.
        """
        silent = time - self._command_time > usb.COMMAND_TIMEOUT
        self._next = None if silent else self._next
        stop, self._stopped = silent or self._stopped, False
        if self.whisk is not None and stop:
            self.whisk, self._from, self.sample = None, balance.before[0].copy(), 0
        if self._from is not None:
            if self.sample < self._retraction:
                return balance
            self._from, self.sample = None, 0
            balance = whiskers_at_rest(*balance.before.shape)
        ended = self.whisk is None or self.sample >= self.whisk.samples
        following = self._next or self.whisk
        if ended and following is not None:
            common = np.full(len(self._centre), np.radians(following.whisking.amplitude_deg))
            self.whisk, self._next, self.sample = following._replace(amplitude=common), None, 0
            return whiskers_at_rest(*balance.before.shape)
        return balance

    def law(self, drive: WhiskDrive, time: float, deflection: np.ndarray) -> tuple[np.ndarray, WhiskDrive]:
        """A `robot.simulation.head.whisk_stream.WhiskingLaw`; `time` counts from the start of the whisk."""
        if self.whisk is None:
            share = 0.0 if self._from is None else max(1 - time / RETRACTION, 0.0)
            return np.zeros_like(deflection) + (0.0 if self._from is None else self._from * share), drive
        whisk = self.whisk
        if whisk.feedback:
            bend = deflection - self._centre
            aim, drive = whisk_command(whisk.whisking, drive, time, bend, whisk.threshold, self.head.shape)
        else:
            aim = np.zeros_like(deflection) + whisk.amplitude * whisk_phase(whisk.whisking, time)
        return aim + whisk.offset if whisk.offset else aim, drive

    def _make_whisk(self, command: usb.Command) -> _Whisk | None:
        """The whisk of a command; None (no change) if it exceeds the limits of the drives."""
        threshold = np.full(len(self._centre), np.inf)
        numbers = command.numbers[: len(threshold)]
        threshold[: len(numbers)] = np.where(numbers == usb.NO_THRESHOLD, np.inf, numbers * usb.ANGLE)
        feedback = command.mode == usb.FeedbackMode.RCP
        offset = min(max(command.offset, 0.0), self.head.limit)
        amplitude = min(command.amplitude, self.head.limit - offset)
        try:
            whisking = WhiskingConfig(
                mode="rcp" if feedback else "open",
                rate=command.frequency,
                amplitude_deg=float(np.degrees(amplitude)),
                gain=command.gain,
                window=command.window if feedback else WhiskingConfig().window,
            )
        except ValidationError:
            return None
        samples = round(self.rate / whisking.rate)
        if samples < 2:
            return None
        return _Whisk(whisking, samples, offset, threshold, feedback, np.zeros(len(threshold)))


AHEAD = 0.1
"""Longest extrapolation of a pose by the arm's speed, s; after that the head stands still."""


class CarriedByArm:
    """The newest pose of an arm, extrapolated by its speed."""

    def __init__(self, arm: PoseListener, placing: BaseTransformConfig) -> None:
        self.arm, self.placing = arm, placing

    def at(self, time: float) -> tuple[np.ndarray, float]:
        newest = self.arm.latest()
        if newest is None:
            return np.zeros(3), np.inf
        ahead = min(max(time - newest.time, -AHEAD), AHEAD)
        tool = np.array(newest.tcp, float)
        tool[:3] += ahead * newest.speed[:3]
        pose, lift = self.placing.pose_from_tcp(tool)
        # The rotation axes of the arm and of the map's headings are both vertical.
        return pose + np.array([0.0, 0.0, ahead * float(newest.speed[5])]), float(lift)


class AlongPath:
    """A motion along a path that starts at the time given to `begin`; before, the path's first pose."""

    def __init__(self, path: HeadPath) -> None:
        self.path = path
        self.began: float | None = None

    def begin(self, time: float) -> None:
        """Starts the motion at a time, s; later calls have no effect."""
        self.began = time if self.began is None else self.began

    def at(self, time: float) -> tuple[np.ndarray, float]:
        since = 0.0 if self.began is None else time - self.began
        return poses_at(self.path, np.array(since)), 0.0


PoseSource = CarriedByArm | AlongPath
"""The pose of the head in the map [3] (m, m, rad) and its lift above working height, m, at a time, s, of the
host's monotonic clock."""
