"""Where every step of a session was, relative to the keyframes."""

from __future__ import annotations

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.core.growable_array import GrowableArray
from ratslam.keyframes.optimizer import MapFit
from ratslam.keyframes.travel import Travel
from tactile.base.se2 import compose, correct_heading


class StepRecord(Checkpointed):
    """The keyframe of each of T steps and the motion since; keyframes are numbered as they were taken."""

    def __init__(self) -> None:
        self._frame = GrowableArray((), np.int64)
        self._motion = GrowableArray((4,), np.float64)  # since that keyframe, and its length

    def append(self, frame: int, travel: Travel) -> None:
        """Adds a step; frame: -1 before the first keyframe."""
        self._frame.append(frame)
        self._motion.append([*travel.motion, travel.length])

    def take(self, number: np.ndarray) -> np.ndarray:
        """Reduces the record to the steps of keyframes that remain; steps before the first keyframe remain
        with it.

        Args:
            number: [E] new number of each keyframe, -1 if it does not remain.

        Returns:
            [t] the former numbers of the steps.
        """
        frame = self._frame.rows
        steps = np.flatnonzero(number[np.maximum(frame, 0)] >= 0)
        self._frame.replace(np.where(frame >= 0, number[frame], -1)[steps])
        self._motion.replace(self._motion.rows[steps])
        return steps

    def frames(self) -> np.ndarray:
        """[T] the keyframe of each step."""
        return self._frame.rows

    def first_steps(self, count: int) -> np.ndarray:
        """[count] the step at which each keyframe was taken."""
        return np.searchsorted(self._frame.rows, np.arange(count))

    def of_keyframes(self, values: np.ndarray) -> np.ndarray:
        """[T] the value of each step's keyframe, of values [E]; zeros without keyframes."""
        frame = self._frame.rows
        return values[np.maximum(frame, 0)] if len(values) else np.zeros_like(frame)

    def poses(self, fit: MapFit) -> np.ndarray:
        """[T, 3] of all steps by a fit of the keyframes."""
        frame, motion = self._frame.rows, self._motion.rows
        moved = correct_heading(motion[:, :3], motion[:, 3], fit.bias, fit.turn_error)
        if not len(fit.poses):
            return moved
        origin = np.where(frame[:, None] >= 0, fit.poses[np.maximum(frame, 0)], 0.0)
        return compose(origin, moved)
