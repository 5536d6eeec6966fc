"""Where every step of a session was, relative to the keyframes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.mapping.optimizer import MapFit
from tactile.base.se2 import between, compose, correct_heading


class Travel(NamedTuple):
    """Odometry added up: motion [3] (m, m, rad), distance m, sum of absolute turns rad."""

    motion: np.ndarray
    length: float
    turn: float

    def onwards(self, odometry: Any) -> Travel:
        """With one more step, if that is finite: the kernel reports as an outcome what is not, and NaN
        would spoil the whole map."""
        moved = np.array([float(odometry.dx), float(odometry.dy), float(odometry.dtheta)])
        if not np.isfinite(moved).all():
            return self
        length = self.length + float(np.hypot(moved[0], moved[1]))
        return Travel(compose(self.motion, moved), length, self.turn + abs(moved[2]))


NO_TRAVEL = Travel(np.zeros(3), 0.0, 0.0)
Bend = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Motions [n, 3] over distances [n], m, as another calibration takes them."""


class StepRecord(Checkpointed):
    """The keyframe of each of T steps and the motion from there; keyframes are numbered as they were taken.

    The steps of a piece before its first keyframe k have number -2 - k (`leading_to`), and the motion from
    it back to them. Number -1: from the origin, before any keyframe. The odometry is kept as it adds up
    from step to step, so that a map without closures gives it to the bit.
    """

    def __init__(self) -> None:
        self._frame = GrowableArray((), np.int64)
        self._motion = GrowableArray((4,), np.float64)  # from that keyframe, and its length
        self._odometry = GrowableArray((3,), np.float64)

    @property
    def odometry(self) -> np.ndarray:
        """[T, 3] the odometry of all steps from the first one; NaN where it is not known."""
        return self._odometry.rows

    def append(self, frame: int, travel: Travel, moved: np.ndarray) -> None:
        """Adds a step.

        Args:
            frame, travel: see the class. moved: [3] in the step.
        """
        odometry = compose(self.odometry[-1] if len(self.odometry) else np.zeros(3), moved)
        self._append_row(frame, [*travel.motion, travel.length], odometry)

    def arrive(self, frame: int, travel: Travel) -> None:
        """The steps that lead to a keyframe are known from it, once it is taken after `travel`."""
        rows = np.flatnonzero(self._frame.rows == leading_to(frame))
        self._motion.rows[rows, :3] = between(travel.motion, self._motion.rows[rows, :3])
        self._motion.rows[rows, 3] -= travel.length

    def settle(self, count: int) -> None:
        """The steps that lead to no keyframe of the `count` taken belong to the newest one."""
        frame = self._frame.rows
        frame[:] = np.where(frame <= leading_to(count), count - 1, frame)

    def extend(self, other: StepRecord, count: int, start: np.ndarray, bend: Bend) -> None:
        """Adds the steps of another map, whose keyframes follow `count` of this one; those before its first
        keyframe, at `start` [3], lead to that.

        Args:
            bend: odometry of the other map to that of this one.
        """
        self.settle(count)
        frame, motion = other._frame.rows, other._motion.rows.copy()
        early = frame == -1
        motion[early, :3] = between(start, motion[early, :3])
        motion[:, :3] = np.where(early[:, None], motion[:, :3], bend(motion[:, :3], motion[:, 3]))
        motion[early, 3] = 0.0
        number = np.where(frame < -1, frame - count, frame + count)
        self._frame.extend(np.where(early, leading_to(count), number))
        self._motion.extend(motion)
        self._odometry.extend(other.odometry)

    def take(self, number: np.ndarray) -> np.ndarray:
        """Reduces the record to the steps of keyframes that remain; steps before the first keyframe remain
        with it.

        Args:
            number: [E] new number of each keyframe, -1 if it does not remain.

        Returns:
            [t] the former numbers of the steps.
        """
        self.settle(len(number))
        frame, owner = self._frame.rows, number[self._owners(len(number))]
        steps = np.flatnonzero(owner >= 0)
        led = np.where(frame < -1, leading_to(owner), -1)
        self._frame.replace(np.where(frame >= 0, owner, led)[steps])
        self._motion.replace(self._motion.rows[steps])
        # What remains keeps its shape, which closures that are gone may have given it.
        self._odometry.replace(np.full((len(steps), 3), np.nan))
        return steps

    def first_steps(self, count: int) -> np.ndarray:
        """[count] the step at which each keyframe was taken."""
        return np.searchsorted(np.maximum.accumulate(self._frame.rows), np.arange(count))

    def of_keyframes(self, values: np.ndarray) -> np.ndarray:
        """[T] the value of each step's keyframe, of values [E]; zeros without keyframes."""
        return values[self._owners(len(values))] if len(values) else np.zeros_like(self._frame.rows)

    def poses(self, fit: MapFit, open_: np.ndarray | None = None) -> np.ndarray:
        """[T, 3] of all steps by a fit of the keyframes; from `open_` ones [E] on, by odometry alone."""
        frame, motion = self._frame.rows, self._motion.rows
        moved = correct_heading(motion[:, :3], motion[:, 3], fit.bias, fit.turn_error)
        if not len(fit.poses):
            return np.where(np.isfinite(self.odometry), self.odometry, moved)
        owner = self._owners(len(fit.poses))
        poses = compose(np.where(frame[:, None] == -1, 0.0, fit.poses[owner]), moved)
        if open_ is not None and open_.any():
            at = self.odometry[self.first_steps(len(fit.poses))][owner]
            onwards = compose(fit.poses[owner], between(at, self.odometry))
            onwards = np.where((at == fit.poses[owner]).all(axis=1)[:, None], self.odometry, onwards)
            poses = np.where(open_[owner, None] & np.isfinite(onwards), onwards, poses)
        return poses

    def _owners(self, count: int) -> np.ndarray:
        """[T] the keyframe of each step, of `count` keyframes taken."""
        frame = self._frame.rows
        return np.minimum(np.where(frame < -1, leading_to(frame), np.maximum(frame, 0)), count - 1)


def leading_to(frame: Any) -> Any:
    """The number of a step before the first keyframe of a piece, and the keyframe of such a number."""
    return -2 - frame
