"""Where every step of a session was, relative to the keyframes, and where the newest keyframe is.

An optimisation costs time that grows with the map, so it does not follow every closure. In between, a
Kalman filter moves the newest keyframe by the odometry, and corrects it by every closure of an accepted
sequence; the matched keyframes count as known. The next optimisation replaces the pose. Source: Thrun,
Burgard & Fox 2005, table 7.2 (extended Kalman filter with known correspondences).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.core.compiled import compiled, wrapped
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate
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
        self._frame.rows[:] = settled(self._frame.rows, count)

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


def settled(frame: np.ndarray, count: int) -> np.ndarray:
    """[T] numbers of steps; those that lead to no keyframe of `count` taken ones have that of the newest."""
    return np.where(frame <= leading_to(count), count - 1, frame)


def leading_to(frame: Any) -> Any:
    """The number of a step before the first keyframe of a piece, and the keyframe of such a number."""
    return -2 - frame


LEAST_WEIGHT = 0.05
"""Least robust weight of a sequence in the filter."""


class LiveFilter(Checkpointed):
    """Covariance of the newest keyframe's pose against the keyframes that it was matched to.

    Attributes:
        covariance: [3, 3] in the frame of the map, m, m, rad. strayed: sum of the corrections since the
            last optimisation, standard deviations of a closure.
    """

    VALUES = ("covariance", "strayed")

    def __init__(self) -> None:
        self.covariance, self.strayed = np.zeros((3, 3)), 0.0

    def advance(self, graph: KeyframeGraph) -> None:
        """Adds the noise of the odometry into the newest keyframe of `graph`; all is forgotten where a
        piece begins."""
        if graph.count < 2:
            return
        if graph.begins.rows[-1]:
            self.covariance = np.diag(graph.newest_variance())
            return
        before, after = graph.pose.rows[-2:]
        self.covariance = _moved_covariance(self.covariance, before, after, graph.newest_variance())

    def correct(self, graph: KeyframeGraph, candidate: Candidate, weight: float) -> np.ndarray:
        """[3] the newest keyframe's pose corrected by a closure of a sequence with this robust weight. The
        covariance takes over the closure."""
        claimed, pose = graph.pose.rows[candidate.match], graph.pose.rows[candidate.keyframe]
        variance, turn = graph.closure_variance(), -candidate.shift * graph.sector_angle
        noise = variance / max(weight, LEAST_WEIGHT)
        corrected, self.covariance, moved = _corrected_pose(self.covariance, pose, claimed, turn, noise)
        self.strayed += float(np.sqrt((moved**2 / variance).sum()))
        return corrected


@compiled
def _corrected_pose(
    covariance: np.ndarray, pose: np.ndarray, claimed: np.ndarray, turn: float, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pose [3] with a covariance [3, 3] after a measurement of it with variances `noise` [3]: the pose
    `claimed` [3], turned on the spot. Returns pose, covariance, and the correction [3]."""
    error = claimed - pose
    error[2] = wrapped(error[2] + turn)
    gain = np.linalg.solve(covariance + np.diag(noise), covariance).T
    moved, after = np.zeros(3), covariance.copy()
    for i in range(3):
        for j in range(3):
            moved[i] += gain[i, j] * error[j]
            for k in range(3):
                after[i, j] -= gain[i, k] * covariance[k, j]
    corrected = pose + moved
    corrected[2] = wrapped(corrected[2])
    return corrected, after, moved


@compiled
def _moved_covariance(
    covariance: np.ndarray, before: np.ndarray, after: np.ndarray, variance: np.ndarray
) -> np.ndarray:
    """[3, 3] covariance of a pose after a motion from `before` to `after` [3] with variances [3]; position
    has the same in all directions."""
    x, y = before[1] - after[1], after[0] - before[0]
    moved = covariance.copy()
    for k in range(3):
        moved[0, k] += x * moved[2, k]
        moved[1, k] += y * moved[2, k]
    for k in range(3):
        moved[k, 0] += x * moved[k, 2]
        moved[k, 1] += y * moved[k, 2]
        moved[k, k] += variance[k]
    return moved
