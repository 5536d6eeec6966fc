"""The keyframes' poses and odometry, and the least-squares problem that joins them to the loop closures.

A keyframe may begin a piece of the map: no odometry leads to it. Until closures join it, a piece lies in the
frame of its first keyframe, which is `APART` cells from that of the piece before, so that nothing mistakes it
for a part of the map. Once accepted closures join it, it is moved to where they claim.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy, deepcopy
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.mapping.appearance import Appearance
from ratslam.mapping.config import Ablation, KeyframeMapConfig
from ratslam.mapping.loop_closures import ClosureLog
from ratslam.mapping.odometry_calibration import HeadingNoise, learn_heading_noise, starting_calibration
from ratslam.mapping.optimizer import (
    LOOSE,
    NO_LINKS,
    CalibrationPrior,
    LoopClosures,
    MapCovariance,
    MapFit,
    MapProblem,
    OdometryChain,
    solve,
)
from ratslam.mapping.pose_graph import Edges
from tactile.base.se2 import between, compose, correct_heading, fit_rigid_motion, integrate, inverse

INTERRUPTED = int(np.iinfo(np.int64).max)
"""Value of `cut` where keyframes before were taken out of the map: no sequence shows the break."""
NO_ROBUST_SCALE = 1e12
"""Robust scale at which no closure sequence loses weight."""


class KeyframeGraph(Checkpointed):
    """Keyframes as a chain of odometry with breaks, and the heading bias of the odometry.

    Args:
        cell: size of a pose cell, m. appearance: of the keyframes. guard: number of newest keyframes, which
            are never recalled.

    Attributes:
        pose: [N, 3] in the map, m, m, rad. motion: [N, 3] odometry into each keyframe. length: [N] distance
            travelled into it, m. turn: [N] sum of absolute turns into it, rad. cut: [N] the closure
            sequence that shows a break of the odometry before the keyframe, -1 for none, or `INTERRUPTED`.
            begins: [N] a piece of the map begins with the keyframe, to which no odometry leads
            (`begin_piece`). seam: [N] the motion into the keyframe is composed of that into merged ones
            too, and `links` count in its place. taken: [N] number of the keyframe among all ever taken.
            bias: heading bias of the odometry, rad/m. turn_error: correction of its turns, rad/rad. prior:
            of both.
        start: the prior before any view.
        heading_noise: factor on the variance of its turns. reckoned: [3] the newest keyframe by odometry
            with the calibration of the start.
    """

    VALUES = ("bias", "turn_error", "prior", "heading_noise", "reckoned", "links")

    def __init__(
        self, config: KeyframeMapConfig, cell: float, appearance: Appearance, guard: int, ablation: Ablation
    ) -> None:
        self.config, self.cell, self.guard, self.ablation = config, cell, guard, ablation
        self.appearance = appearance
        self.pose = GrowableArray((3,), np.float64)
        self.motion = GrowableArray((3,), np.float64)
        self.length = GrowableArray((), np.float64)
        self.turn = GrowableArray((), np.float64)
        self.cut = GrowableArray((), np.int64)
        self.begins = GrowableArray((), np.bool_)
        self.seam = GrowableArray((), np.bool_)
        self.taken = GrowableArray((), np.int64)
        self.links = NO_LINKS
        self.start = self.prior = starting_calibration(config, cell)
        self.bias, self.turn_error = self.prior.bias, self.prior.turn_error
        self.heading_noise = HeadingNoise.of_start(config)
        self.reckoned = np.zeros(3)

    @property
    def count(self) -> int:
        """Number of keyframes."""
        return len(self.pose.rows)

    @property
    def total(self) -> int:
        """Number of keyframes ever taken; the newest one is never merged."""
        return int(self.taken.rows[-1]) + 1 if self.count else 0

    @property
    def sector_angle(self) -> float:
        """Turn per sector shift of a view, rad; 0 while unknown."""
        return self.appearance.metric().angle

    @property
    def half_turns(self) -> bool:
        """Whether views turned by half a turn are compared too, as those of whiskers."""
        return bool(np.cos(self.sector_angle) < 0)

    def copy(self) -> KeyframeGraph:
        """A copy of the present state, which may change independently."""
        other = copy(self)
        for name, array in self._growable_arrays().items():
            setattr(other, name, deepcopy(array))
        other.appearance = self.appearance.present()
        return other

    def append(self, pose: np.ndarray, motion: np.ndarray, length: float, turn: float) -> None:
        """Adds a keyframe at `pose` [3], reached by `motion` [3]."""
        self.reckoned = self.reckoned_after(motion, length) if self.count else np.array(pose, float)
        self._append_row(pose, motion, length, turn, -1, False, False, self.total)

    def begin_piece(self) -> None:
        """Adds a keyframe to which no odometry leads, as the start of a new piece (`piece_placement`); an
        empty graph gets its first keyframe."""
        self.reckoned = self.next_start()
        motion = between(self.pose.rows[-1], self.reckoned) if self.count else np.zeros(3)
        self._append_row(self.reckoned, motion, 0.0, 0.0, -1, self.count > 0, False, self.total)

    def append_newest(self, other: KeyframeGraph) -> None:
        """Adds the newest keyframe of another graph."""
        self._append_row(*(array.rows[-1] for array in other._growable_arrays().values()))
        self.reckoned = other.reckoned

    def next_start(self) -> np.ndarray:
        """[3] the pose of the next keyframe if it begins a piece."""
        return piece_start(int(self.begins.rows.sum()) + min(self.count, 1), self.cell)

    def replace(self, other: KeyframeGraph, poses: np.ndarray, cut: np.ndarray) -> None:
        """Takes over all keyframes of a graph without links, with other poses [N, 3] and breaks [N]."""
        for name, array in self._growable_arrays().items():
            array.replace(getattr(other, name).rows)
        self.pose.replace(poses)
        self.cut.replace(cut)
        self.links = NO_LINKS

    def take(self, rows: np.ndarray) -> None:
        """Reduces all arrays to the keyframes `rows` [n]; links are not touched."""
        self._take_rows(rows)

    def pose_after(self, motion: np.ndarray, length: float) -> np.ndarray:
        """[3] the pose after a motion [3] over a distance since the newest keyframe."""
        origin = self.pose.rows[-1] if self.count else np.zeros(3)
        return compose(origin, self.correct(motion, length))

    def reckoned_after(self, motion: np.ndarray, length: float) -> np.ndarray:
        """The same by odometry with the calibration of the start."""
        return compose(self.reckoned, self.calibrated(motion, length))

    def calibrated(self, motion: np.ndarray, length: np.ndarray | float) -> np.ndarray:
        """Motions [..., 3] over distances [...] with the calibration of the start; to the bit the same
        without one."""
        bias, turn_error = self.start.bias, self.start.turn_error
        return correct_heading(motion, length, bias, turn_error) if bias or turn_error else motion

    def correct(self, motion: np.ndarray, length: np.ndarray | float) -> np.ndarray:
        """Motions [..., 3] over distances [...] without the systematic errors of the odometry."""
        return correct_heading(motion, length, self.bias, self.turn_error)

    def dead_reckoned(self, bias: float = 0.0, turn_error: float = 0.0) -> np.ndarray:
        """[N, 3] poses by odometry with this calibration, rad/m and rad/rad, from the first keyframe's;
        each piece from its own start."""
        first = self.pose.rows[:1]
        if not len(first):
            return first
        motion = correct_heading(self.motion.rows[1:], self.length.rows[1:], bias, turn_error)
        poses = np.concatenate([first, integrate(motion, first[0])])
        return placed_pieces(poses, self.begins.rows, *NOTHING_JOINED, self.cell)

    def dead_reckon(self) -> None:
        """Replaces all poses by odometry with the current calibration."""
        self.pose.rows[:] = self.dead_reckoned(self.bias, self.turn_error)

    def adopt_prior(self, log: ClosureLog, prior: CalibrationPrior) -> None:
        """Takes over a prior of the calibration; the poses follow its means until a closure fixes them."""
        self.prior = prior
        means = prior.bias, prior.turn_error
        if not len(log.accepted_rows()) and (self.bias, self.turn_error) != means:
            self.bias, self.turn_error = means
            self.dead_reckon()

    def move_to(self, fit: MapFit, log: ClosureLog) -> None:
        """Takes over a fit, moved as a whole so that the keyframes move as little as possible; pieces that
        nothing joins to the first one start where they started."""
        before, first = self.pose.rows.copy(), self.pieces(log) == 0
        poses = compose(fit_rigid_motion(fit.poses[first], before[first]), fit.poses)
        self.pose.rows[:] = self.placement(log)(poses)
        self.bias, self.turn_error = fit.bias, fit.turn_error

    def pieces(self, log: ClosureLog) -> np.ndarray:
        """[N] the piece of each keyframe: pieces are joined by accepted closures; a cut separates none."""
        i, j, _ = self._joints(log)
        return number_pieces(self.begins.rows, np.column_stack([j, i]))

    def placement(self, log: ClosureLog) -> Place:
        """Moves pieces to where the closures now accepted in a log, and odometry links, claim them."""
        begins, (i, j, turn) = self.begins.rows.copy(), self._joints(log)
        return lambda poses: placed_pieces(poses, begins, i, j, turn, self.cell)

    def _joints(self, log: ClosureLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What joins the pieces: `i`, `j` and `turn` of `placed_pieces`."""
        if not self.begins.rows.any():
            return NOTHING_JOINED
        table = log.table()[log.accepted_middle_first()]
        match, frame = table[:, 1].astype(int), table[:, 0].astype(int)
        turn = np.concatenate([-table[:, 2] * self.sector_angle, np.full(len(self.links.i), np.nan)])
        return np.concatenate([match, self.links.i]), np.concatenate([frame, self.links.j]), turn

    def place_pieces(self, log: ClosureLog) -> None:
        """Moves pieces as wholes to where the accepted closures claim them."""
        self.pose.rows[:] = self.placement(log)(self.pose.rows)

    def fit(self) -> MapFit:
        """The current poses (not copied) and calibration."""
        return MapFit(self.pose.rows, self.bias, np.zeros(0), self.turn_error)

    def odometry(self, cut: GrowableArray) -> OdometryChain:
        """The odometry between keyframes with its variances, loose at the breaks `cut` and between pieces."""
        return OdometryChain(self.motion.rows[1:], self.length.rows[1:], self.variances(cut)[1:])

    def variances(self, cut: GrowableArray) -> np.ndarray:
        """[N, 3] variances of the odometry into each keyframe, loose at the breaks `cut`, where a piece
        begins, and at seams."""
        variance = self.odometry_variance(self.length.rows, self.turn.rows)
        loose = self.is_broken(cut) | self.seam.rows
        return np.where(loose[:, None], self._loose_variance(), variance)

    def is_broken(self, cut: GrowableArray) -> np.ndarray:
        """[N] bool: no odometry leads to the keyframe, for a break of `cut` or because a piece begins."""
        return (cut.rows >= 0) | self.begins.rows

    def own_variances(self) -> np.ndarray:
        """[N, 3] variances of the odometry into each keyframe without breaks, as if no noise were learned."""
        learned = np.array([1.0, 1.0, self.heading_noise.factor])
        return self.odometry_variance(self.length.rows, self.turn.rows) / learned

    def heading_variance(self, length: np.ndarray | float, turn: np.ndarray | float) -> np.ndarray | float:
        """Variance of heading by odometry over distances (m) and sums of absolute turns (rad), with the
        learned noise, rad^2."""
        noise = self.config.noise
        driven = noise.heading_per_cell**2 * length / self.cell + noise.heading_per_radian**2 * turn
        return driven * self.heading_noise.factor

    def newest_variance(self) -> np.ndarray:
        """[3] variance of the odometry into the newest keyframe."""
        if self.begins.rows[-1]:
            return self._loose_variance()
        return self.odometry_variance(self.length.rows[-1], self.turn.rows[-1])

    def closure_variance(self) -> np.ndarray:
        """[3] variance of a closure, m^2, m^2, rad^2."""
        spread = self.config.closure_sd * self.cell
        return np.array([spread**2, spread**2, self.config.closure_heading**2])

    def closures(self, log: ClosureLog) -> LoopClosures:
        """The accepted loop closures with their variances and robust scales."""
        config, variance = self.config, self.closure_variance()
        scales = (config.robust_per_score, config.robust_least, config.robust_most)
        closures = log.closures(self.sector_angle, variance, scales)
        if config.select_every:
            spare = (closures.score - config.sequence_cost) * closures.credit
            worth = 2 * np.maximum(spare, 1.0) / closures.size
            # A sequence must be able to cost more than its evidence, else it could never be refused.
            limit = np.maximum(config.closure_cost_limit, 1.5 * worth)
            return closures._replace(scale=worth, cost_limit=limit)
        if not self.ablation.robust:
            return closures._replace(scale=np.full_like(closures.scale, NO_ROBUST_SCALE))
        return closures

    def problem(self, log: ClosureLog, cut: GrowableArray) -> MapProblem:
        """The least-squares problem of the keyframes with the odometry broken at `cut`."""
        links = self.links._replace(variance=self.links.variance * [1.0, 1.0, self.heading_noise.factor])
        prior = self.prior if self.ablation.heading_bias else CalibrationPrior(self.bias, 1e-9)
        return MapProblem(self.odometry(cut), self.closures(log), prior, links)

    def misfits(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """See `Appearance.least_misfits`."""
        taken = self.taken.rows
        return self.appearance.misfits(taken[frame], taken[others], reversed)

    def log_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """See `Appearance.log_odds`."""
        taken = self.taken.rows
        return self.appearance.log_odds(taken[frame], taken[others], reversed)

    def least_misfit(self, frame: int, near: np.ndarray, reversed: np.ndarray) -> float:
        """See `Appearance.least_misfit`."""
        return self.appearance.least_misfit(int(self.taken.rows[frame]), self.taken.rows[near], reversed)

    def solve(self, log: ClosureLog, iterations: int) -> MapFit:
        """The optimised map, from the current poses."""
        return solve(self.fit(), self.problem(log, self.cut), iterations)

    def optimise(self, log: ClosureLog) -> None:
        """Solves for the poses and the bias, and stores the robust weights in the log."""
        fit = self.solve(log, self.config.iterations)
        log.weigh(fit.weights)
        self.move_to(fit, log)

    def calibration(self, fit: MapFit, log: ClosureLog, cut: GrowableArray) -> CalibrationPrior:
        """Means and standard deviations of the calibration of a solution."""
        bias_sd, turn_error_sd = MapCovariance(fit, self.problem(log, cut)).calibration_sd()
        return CalibrationPrior(fit.bias, bias_sd, fit.turn_error, turn_error_sd)

    def learn_noise(self, fit: MapFit, log: ClosureLog) -> None:
        """Updates the noise of the odometry from a fit that solves the problem of the accepted closures."""
        start, problem = HeadingNoise.of_start(self.config), self.problem(log, self.cut)
        self.heading_noise = learn_heading_noise(self.heading_noise, start, fit, problem)

    def map_covariance(self, log: ClosureLog) -> MapCovariance:
        """The covariance of the current map."""
        return MapCovariance(self.fit(), self.problem(log, self.cut))

    def newest_covariance(self, log: ClosureLog) -> np.ndarray:
        """[3, 3] covariance of the newest keyframe's pose in the frame of the first one of its piece (m, m,
        rad)."""
        if self.count < 2:
            return np.zeros((3, 3))
        piece = self.pieces(log)
        first = int(np.flatnonzero(piece == piece[-1])[0])
        return self.map_covariance(log).relative(first, self.count - 1, 0.0)

    def edges(self, fit: MapFit, log: ClosureLog, cut: GrowableArray) -> Edges:
        """Edges of a solution: odometry, corrected by its bias in pieces with a closure, none where it is
        broken, and closures with their robust weights."""
        chain, closures, _, links = self.problem(log, cut)
        broken, pairs = self.is_broken(cut), log.accepted_pairs()
        steps, piece = np.flatnonzero(~broken[1:]), number_pieces(broken, pairs)
        closed = np.isin(piece[1:], piece[pairs[:, 0]])[:, None]
        moved = np.where(closed, fit.corrected(chain), self.calibrated(chain.motion, chain.length))
        zero = np.zeros(len(closures.i))
        turned = np.stack([zero, zero, closures.turn], axis=1)
        trust = log.weights()[:, None] / closures.variance
        i = np.concatenate([steps, links.i, closures.i])
        j = np.concatenate([steps + 1, links.j, closures.j])
        motion = np.concatenate([moved[steps], fit.corrected_links(links), turned])
        return Edges(i, j, motion, np.concatenate([1 / chain.variance[steps], 1 / links.variance, trust]))

    def _loose_variance(self) -> np.ndarray:
        return np.array([LOOSE * self.cell, LOOSE * self.cell, LOOSE]) ** 2

    def odometry_variance(self, length: Any, turn: Any) -> np.ndarray:
        """[..., 3] variances of odometry over distances [...], m, and sums of absolute turns [...], rad."""
        noise, cell = self.config.noise, self.cell
        along = noise.per_cell**2 * length * cell + (noise.least * cell) ** 2
        least = noise.least_heading**2 * self.heading_noise.factor
        return np.stack([along, along, self.heading_variance(length, turn) + least], axis=-1)


APART = 1000.0
"""Distance between the first keyframes of pieces that nothing joins, cells."""


Place = Callable[[np.ndarray], np.ndarray]
"""Moves the pieces of poses [N, 3] to where they belong, see `placed_pieces`."""
NOTHING_JOINED = np.zeros(0, int), np.zeros(0, int), np.zeros(0)
"""No closures: `i`, `j` and `turn` of `placed_pieces`."""


def piece_start(number: int, cell: float) -> np.ndarray:
    """[3] pose of the first keyframe of the piece that begins as the `number`-th, 0 for the first one."""
    return np.array([APART * cell * number, 0.0, 0.0])


def placed_pieces(
    poses: np.ndarray, begins: np.ndarray, i: np.ndarray, j: np.ndarray, turn: np.ndarray, cell: float
) -> np.ndarray:
    """[N, 3] the poses [N, 3] with pieces moved as wholes: joined ones that lie apart to where their closures
    claim, and each that is not joined to the first one to its own start. The first piece stays.

    Args:
        begins: [N] bool, a piece begins with the keyframe. i, j: [M] keyframes of accepted closures, of each
            sequence the middle one first, and of odometry links. turn: [M] see `LoopClosures`; NaN for a
            link. cell: m.
    """
    starts = np.flatnonzero(begins)
    if not len(starts):
        return poses
    # A stretch is a run of keyframes from one beginning to the next. Joined stretches are moved together;
    # `group` is the first stretch that each is joined to.
    poses, stretch = poses.copy(), np.cumsum(begins)
    group = np.arange(int(stretch[-1]) + 1)
    far = np.hypot(*(poses[i] - poses[j])[:, :2].T) > APART / 2 * cell
    for m in np.argsort(far, kind="stable").tolist():
        a, b = int(i[m]), int(j[m])
        low, high = sorted((int(group[stretch[a]]), int(group[stretch[b]])))
        if low == high:
            continue
        if far[m] and np.isfinite(turn[m]):
            frames, turned = group[stretch] == high, np.array([0.0, 0.0, turn[m]])
            if frames[b]:  # keyframe b comes to where a claims it, or a to where b does
                moved = compose(compose(poses[a], turned), inverse(poses[b]))
            else:
                moved = compose(compose(poses[b], -turned), inverse(poses[a]))
            poses[frames] = compose(moved, poses[frames])
        group[group == high] = low
    for number in np.unique(group)[1:].tolist():
        start, frames = starts[number - 1], group[stretch] == number
        moved = compose(piece_start(number, cell), inverse(poses[start]))
        poses[frames] = compose(moved, poses[frames])
    return poses


def number_pieces(broken: np.ndarray, closures: np.ndarray) -> np.ndarray:
    """[N] the piece of each keyframe, numbered from 0 in the order of their first keyframes.

    Args:
        broken: [N] bool, no odometry leads to the keyframe: it is cut before it, or a piece begins there.
            closures: [M, 2] keyframes joined by accepted closures.
    """
    if not len(broken):
        return np.zeros(0, int)
    stretch = np.cumsum(broken)
    stretch = stretch - stretch[0]  # a stretch is a run of keyframes without a break
    later, earlier = stretch[closures].T
    count = int(stretch[-1]) + 1
    joined = coo_array((np.ones(len(closures), bool), (later, earlier)), shape=(count, count))
    _, piece = connected_components(joined, directed=False)
    _, first, number = np.unique(piece[stretch], return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number]
