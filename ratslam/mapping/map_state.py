"""The state of a map: one value that everything else in this room makes, changes or reads.

Keyframes form a chain of odometry with breaks; closures join them. A special case is a transformation of the
state, and the result is a state again: `append` takes a keyframe, `begin_piece` begins a piece to which no
odometry leads, `merge_keyframes` (merging) merges keyframes, `selected_solution` (map_solution) selects the
closures, `solved` optimises, `by_odometry` and `without_closures` give odometry back, `unmerged_solution`
restores merged keyframes, `crop_map` and `unite` (places) take a part and put two maps together. `problem`
states the least-squares problem of graph SLAM (Grisetti et al. 2010), which `optimizer` solves.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy, deepcopy
from typing import Any

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray, with_prefix
from ratslam.mapping.appearance import Appearance
from ratslam.mapping.config import Ablation, KeyframeMapConfig
from ratslam.mapping.loop_closures import CONFIRMED_WEIGHT, Candidate, ClosureLog, Verdict
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
    OdometryLinks,
    solve,
)
from ratslam.mapping.pieces import NOTHING_JOINED, Place, number_pieces, piece_start, placed_pieces
from ratslam.mapping.pose_graph import Edges
from ratslam.mapping.step_record import StepRecord
from tactile.base.se2 import between, compose, correct_heading, fit_rigid_motion, integrate, inverse

INTERRUPTED = int(np.iinfo(np.int64).max)
"""Value of `cut` where keyframes before were taken out of the map: no sequence shows the break."""
NO_ROBUST_SCALE = 1e12
"""Robust scale at which no closure sequence loses weight."""
CONFIRMED_MASS = 0.95
"""Least posterior mass of a closure for the likelihoods to learn from it."""
MOST_SOLVED = 4000
"""Largest number of keyframes, merged ones included, whose poses are solved for in the final map."""


class MapState(Checkpointed):
    """A map: its keyframes, the odometry between them with its breaks, steps, closures and calibration.

    Args:
        cell: size of a pose cell, m. appearance: of the keyframes. guard: number of newest keyframes, which
            are never recalled. archived: whether keyframes may be merged, so that an archive keeps them.

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
        log: candidates and closure sequences. steps: where every step was, relative to the keyframes.
        archive: all keyframes ever taken, as they were before any was merged; None in that state itself.
    """

    VALUES = ("bias", "turn_error", "prior", "heading_noise", "reckoned", "links")
    PARTS = ("log", "steps", "archive")

    def __init__(
        self, config: KeyframeMapConfig, cell: float, appearance: Appearance, guard: int, ablation: Ablation,
        *, archived: bool = True,
    ) -> None:  # fmt: skip
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
        self.log, self.steps, self.archive = ClosureLog(), StepRecord(), None
        self._origin: np.ndarray | None = None  # [1, 3] of dead reckoning; None: the first keyframe's pose
        if archived:
            self.archive = Archive(MapState(config, cell, appearance, guard, ablation, archived=False))
            self.archive.state.steps = self.steps

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

    @property
    def unmerged(self) -> MapState:
        """All keyframes ever taken, with the poses and closures of the last solution; the same before any
        merge."""
        return self.merged.state if self.merged else self

    @property
    def merged(self) -> Archive | None:
        """The archive once keyframes were merged."""
        return self.archive if self.archive is not None and self.archive.begun else None

    def copy(self) -> MapState:
        """A copy of keyframes and closures, which may change independently; steps and archive are shared."""
        other = copy(self)
        for name, array in self._growable_arrays().items():
            setattr(other, name, deepcopy(array))
        other.log, other.appearance = self.log.copy(), self.appearance.present()
        other._origin = None
        return other

    def trial(self) -> MapState:
        """The same keyframes, on whose poses, closures and breaks something is tried; all else is shared."""
        other = copy(self)
        other.pose, other.cut, other.log = deepcopy(self.pose), deepcopy(self.cut), self.log.copy()
        other._origin = self.pose.rows[:1].copy() if self._origin is None else self._origin
        return other

    def append(self, pose: np.ndarray, motion: np.ndarray, length: float, turn: float) -> None:
        """Adds a keyframe at `pose` [3], reached by `motion` [3]."""
        self.reckoned = self.reckoned_after(motion, length) if self.count else np.array(pose, float)
        self._append_row(pose, motion, length, turn, -1, False, False, self.total)
        self._archive_newest()

    def begin_piece(self) -> None:
        """Adds a keyframe to which no odometry leads, as the start of a new piece (`placed_pieces`); an
        empty map gets its first keyframe."""
        self.reckoned = self.next_start()
        motion = between(self.pose.rows[-1], self.reckoned) if self.count else np.zeros(3)
        self._append_row(self.reckoned, motion, 0.0, 0.0, -1, self.count > 0, False, self.total)
        self._archive_newest()

    def _archive_newest(self) -> None:
        archive = self.merged
        if archive:
            archive.state._append_row(*(array.rows[-1] for array in self._growable_arrays().values()))
            archive.state.reckoned = self.reckoned
            archive.row.append(self.count - 1)
            archive.offset.append(np.zeros(3))

    def add(self, candidate: Candidate, follows: bool) -> int:
        """Adds a candidate to the newest closure sequence if it follows that, else to a new one.

        Returns:
            the number of the sequence.
        """
        if self.merged:
            frame, match = self.taken.rows[[candidate.keyframe, candidate.match]].tolist()
            self.merged.state.log.add(candidate._replace(keyframe=frame, match=match), follows)
        return self.log.add(candidate, follows)

    def add_accepted(self, candidates: Sequence[Candidate]) -> None:
        """Adds the candidates of one sequence, which is accepted; the map is not optimised."""
        for k, candidate in enumerate(candidates):
            self.log.judge(self.add(candidate, k > 0), Verdict.ACCEPTED)

    def next_start(self) -> np.ndarray:
        """[3] the pose of the next keyframe if it begins a piece."""
        return piece_start(int(self.begins.rows.sum()) + min(self.count, 1), self.cell)

    def replace(self, other: MapState, poses: np.ndarray, cut: np.ndarray) -> None:
        """Takes over all keyframes of a state without links, with other poses [N, 3] and breaks [N]."""
        for name, array in self._growable_arrays().items():
            array.replace(getattr(other, name).rows)
        self.pose.replace(poses)
        self.cut.replace(cut)
        self.links = NO_LINKS

    def extend(self, other: MapState, motion: np.ndarray, links: OdometryLinks, taken: int) -> None:
        """Adds the keyframes and closures of another map as a piece of their own.

        Args:
            motion: [n, 3] into its keyframes. links: its own, with the numbers that its keyframes get here.
                taken: number of keyframes ever taken here.
        """
        first, cut = self.count, other.cut.rows
        shown = np.where((cut >= 0) & (cut < INTERRUPTED), cut + self.log.sequences, cut)
        moved = {"motion": motion, "cut": shown, "taken": other.taken.rows + taken}
        self.log.extend(other.log, first)
        for name, array in self._growable_arrays().items():
            array.extend(moved[name] if name in moved else getattr(other, name).rows)
        self.begins.rows[first] = True
        self.links = OdometryLinks(*map(np.concatenate, zip(self.links, links, strict=True)))

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
        first = self.pose.rows[:1] if self._origin is None else self._origin
        if not len(first):
            return first
        motion = correct_heading(self.motion.rows[1:], self.length.rows[1:], bias, turn_error)
        poses = np.concatenate([first, integrate(motion, first[0])])
        return placed_pieces(poses, self.begins.rows, *NOTHING_JOINED, self.cell)

    def dead_reckon(self) -> None:
        """Replaces all poses by odometry with the current calibration."""
        self.pose.rows[:] = self.dead_reckoned(self.bias, self.turn_error)

    def adopt_prior(self, prior: CalibrationPrior) -> None:
        """Takes over a prior of the calibration; the poses follow its means until a closure fixes them."""
        self.prior = prior
        means = prior.bias, prior.turn_error
        if not len(self.log.accepted_rows()) and (self.bias, self.turn_error) != means:
            self.bias, self.turn_error = means
            self.dead_reckon()

    def move_to(self, fit: MapFit) -> None:
        """Takes over a fit, moved as a whole so that the keyframes move as little as possible; pieces that
        nothing joins to the first one start where they started."""
        before, first = self.pose.rows.copy(), self.pieces() == 0
        self.pose.rows[:] = compose(fit_rigid_motion(fit.poses[first], before[first]), fit.poses)
        self.place_pieces()
        self.bias, self.turn_error = fit.bias, fit.turn_error

    def take_fit(self, fit: MapFit) -> None:
        """Takes over poses and calibration of a fit as they are."""
        self.pose.replace(fit.poses)
        self.bias, self.turn_error = fit.bias, fit.turn_error

    def pieces(self) -> np.ndarray:
        """[N] the piece of each keyframe: pieces are joined by accepted closures; a cut separates none."""
        i, j, _ = self._joints()
        return number_pieces(self.begins.rows, np.column_stack([j, i]))

    def parts(self) -> np.ndarray:
        """[N] the part of each keyframe: pieces, and what a cut separates, if no accepted closure joins
        them."""
        return number_pieces(self.is_broken(), self.log.accepted_pairs())

    def open_parts(self) -> np.ndarray:
        """[N] bool, keyframes of a part without an accepted closure."""
        part = self.parts()
        return ~np.isin(part, part[self.log.accepted_pairs()[:, 0]])

    def placement(self) -> Place:
        """Moves pieces to where the closures now accepted, and odometry links, claim them."""
        begins, (i, j, turn) = self.begins.rows.copy(), self._joints()
        return lambda poses: placed_pieces(poses, begins, i, j, turn, self.cell)

    def _joints(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What joins the pieces: `i`, `j` and `turn` of `placed_pieces`."""
        if not self.begins.rows.any():
            return NOTHING_JOINED
        table = self.log.table()[self.log.accepted_middle_first()]
        match, frame = table[:, 1].astype(int), table[:, 0].astype(int)
        turn = np.concatenate([-table[:, 2] * self.sector_angle, np.full(len(self.links.i), np.nan)])
        return np.concatenate([match, self.links.i]), np.concatenate([frame, self.links.j]), turn

    def place_pieces(self) -> None:
        """Moves pieces as wholes to where the accepted closures claim them."""
        self.pose.rows[:] = self.placement()(self.pose.rows)

    def fit(self) -> MapFit:
        """The current poses (not copied) and calibration."""
        return MapFit(self.pose.rows, self.bias, np.zeros(0), self.turn_error)

    def odometry(self) -> OdometryChain:
        """The odometry between keyframes with its variances, loose at cuts and between pieces."""
        return OdometryChain(self.motion.rows[1:], self.length.rows[1:], self.variances()[1:])

    def variances(self) -> np.ndarray:
        """[N, 3] variances of the odometry into each keyframe, loose at cuts, where a piece begins, and at
        seams."""
        variance = self.odometry_variance(self.length.rows, self.turn.rows)
        loose = self.is_broken() | self.seam.rows
        return np.where(loose[:, None], self._loose_variance(), variance)

    def is_broken(self) -> np.ndarray:
        """[N] bool: no odometry leads to the keyframe, for a cut or because a piece begins."""
        return (self.cut.rows >= 0) | self.begins.rows

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

    def closures(self) -> LoopClosures:
        """The accepted loop closures with their variances and robust scales."""
        config, variance = self.config, self.closure_variance()
        scales = (config.robust_per_score, config.robust_least, config.robust_most)
        closures = self.log.closures(self.sector_angle, variance, scales)
        if config.select_every:
            spare = (closures.score - config.sequence_cost) * closures.credit
            worth = 2 * np.maximum(spare, 1.0) / closures.size
            # A sequence must be able to cost more than its evidence, else it could never be refused.
            limit = np.maximum(config.closure_cost_limit, 1.5 * worth)
            return closures._replace(scale=worth, cost_limit=limit)
        if not self.ablation.robust:
            return closures._replace(scale=np.full_like(closures.scale, NO_ROBUST_SCALE))
        return closures

    def problem(self) -> MapProblem:
        """The least-squares problem of the keyframes: odometry, accepted closures, links, calibration."""
        links = self.links._replace(variance=self.links.variance * [1.0, 1.0, self.heading_noise.factor])
        prior = self.prior if self.ablation.heading_bias else CalibrationPrior(self.bias, 1e-9)
        return MapProblem(self.odometry(), self.closures(), prior, links)

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

    def solve(self, iterations: int) -> MapFit:
        """The optimised map, from the current poses."""
        return solve(self.fit(), self.problem(), iterations)

    def optimise(self) -> None:
        """Solves for the poses and the bias, and stores the robust weights in the log."""
        fit = self.solve(self.config.iterations)
        self.log.weigh(fit.weights)
        self.move_to(fit)

    def solved(self) -> MapState:
        """The map with the closures accepted so far, optimised; as it is without any."""
        other = self.trial()
        if len(self.log.accepted_rows()):
            other.take_fit(self.solve(self.config.settling))
        return other

    def without_closures(self) -> MapState:
        """Odometry as it was read, without cuts; all accepted sequences are open."""
        other = self.trial()
        for sequence in np.flatnonzero(self.log.verdicts() == Verdict.ACCEPTED).tolist():
            other.log.judge(sequence, Verdict.OPEN)
        other.cut.rows[:] = -1
        other.take_fit(MapFit(self.dead_reckoned(), 0.0, np.zeros(0)))
        return other

    def by_odometry(self) -> MapState:
        """The map whose parts without an accepted closure are their odometry, from where each begins: what
        views alone show of its bias may be wrong. A part whose odometry is not known stays as it is. The one
        place for this rule."""
        odometry = self.steps.odometry[self.steps.first_steps(self.total)[self.taken.rows]]
        part, open_, other = self.parts(), self.open_parts(), self.trial()
        poses = other.pose.rows
        for number in np.unique(part[open_]).tolist():
            rows = np.flatnonzero(part == number)
            own = odometry[rows]
            if rows[0]:
                own = compose(compose(poses[rows[0]], inverse(own[0])), own)
            poses[rows] = np.where(np.isfinite(own).all(), own, poses[rows])
        if open_.all() and np.isfinite(odometry).all():
            other.bias, other.turn_error = self.start.bias, self.start.turn_error
        return other

    def unmerged_poses(self) -> np.ndarray:
        """[E, 3] poses of all keyframes ever taken; the same before any merge."""
        archive, poses = self.merged, self.pose.rows
        return compose(poses[archive.row.rows], archive.offset.rows) if archive else poses

    def merged_into(self, frames: np.ndarray) -> np.ndarray:
        """[n] numbers, among all ever taken, of keyframes `frames` and of those merged with them."""
        archive = self.merged
        return np.flatnonzero(np.isin(archive.row.rows, frames)) if archive else self.taken.rows[frames]

    def unmerged_solution(self) -> MapState:
        """The map of all keyframes ever taken, solved for if these are not too many; the same before any
        merge. The archive takes it over."""
        if not self.merged:
            return self
        self.merged.follow(self)
        whole = self.merged.state.trial()
        if whole.count <= MOST_SOLVED:
            fit = whole.solve(self.config.settling)
            whole.take_fit(fit)
            whole.log.weigh(fit.weights)
        whole.place_pieces()
        return whole

    def confirmed_pairs(self) -> np.ndarray:
        """[P, 3] numbers of keyframe and match, among all ever taken, of accepted closures with a high
        posterior, and 1 where they face opposite ways; of merged keyframes the newest ones."""
        table = self.log.table()[self.log.accepted_rows()]
        sure = (table[:, 3] > CONFIRMED_MASS) & (table[:, 8] > CONFIRMED_WEIGHT)
        frame, match, shift = table[sure, :3].astype(int).T
        reversed = np.cos(shift * self.sector_angle) < 0
        own = np.column_stack([self.taken.rows[frame], self.taken.rows[match], reversed])
        return own if self.archive is None else np.concatenate([self.archive.pairs.rows, own])

    def calibration(self) -> CalibrationPrior:
        """Means and standard deviations of the calibration."""
        bias_sd, turn_error_sd = self.covariance().calibration_sd()
        return CalibrationPrior(self.bias, bias_sd, self.turn_error, turn_error_sd)

    def learn_noise(self) -> None:
        """Updates the noise of the odometry from poses that solve the problem of the accepted closures."""
        start = HeadingNoise.of_start(self.config)
        self.heading_noise = learn_heading_noise(self.heading_noise, start, self.fit(), self.problem())

    def covariance(self) -> MapCovariance:
        """The covariance of the current map."""
        return MapCovariance(self.fit(), self.problem())

    def newest_covariance(self) -> np.ndarray:
        """[3, 3] covariance of the newest keyframe's pose in the frame of the first one of its piece (m, m,
        rad)."""
        if self.count < 2:
            return np.zeros((3, 3))
        piece = self.pieces()
        first = int(np.flatnonzero(piece == piece[-1])[0])
        return self.covariance().relative(first, self.count - 1, 0.0)

    def edges(self) -> Edges:
        """Edges of a solution: odometry, corrected by its bias in parts with a closure, none where it is
        broken, and closures with their robust weights."""
        chain, closures, _, links = self.problem()
        fit, broken, part = self.fit(), self.is_broken(), self.parts()
        steps, pairs = np.flatnonzero(~broken[1:]), self.log.accepted_pairs()
        closed = np.isin(part[1:], part[pairs[:, 0]])[:, None]
        moved = np.where(closed, fit.corrected(chain), self.calibrated(chain.motion, chain.length))
        zero = np.zeros(len(closures.i))
        turned = np.stack([zero, zero, closures.turn], axis=1)
        trust = self.log.weights()[:, None] / closures.variance
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

    def arrays(self) -> dict[str, np.ndarray]:
        """The state; keyframes under `graph/`."""
        arrays, own = super().arrays(), self.PARTS
        return {n if n.partition("/")[0] in own else f"graph/{n}": values for n, values in arrays.items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays | with_prefix(arrays, "graph/"))

    def _parts(self) -> list[str]:
        return list(self.PARTS) if self.archive is not None else ["log"]


class Archive(Checkpointed):
    """The unmerged map; empty before the first merge.

    Attributes:
        state: its keyframes, [E], and candidates. Poses and verdicts are those of the last `follow`.
        row: [E] the keyframe of the map that each is or is merged with. offset: [E, 3] its pose in the
            frame of that one, m, m, rad.
        pairs: [P, 3] confirmed pairs of which a keyframe was merged, the newest ones.
    """

    PARTS = FLAT = ("state",)

    def __init__(self, state: MapState) -> None:
        self.state = state
        self.row = GrowableArray((), np.int64)
        self.offset = GrowableArray((3,), np.float64)
        self.pairs = GrowableArray((3,), np.int64)

    @property
    def begun(self) -> bool:
        """Whether keyframes were merged."""
        return len(self.row.rows) > 0

    def begin(self, state: MapState) -> None:
        """Takes over a map of which no keyframe is merged yet."""
        self.state.restore(state.arrays())
        self.row.replace(np.arange(state.count))
        self.offset.replace(np.zeros((state.count, 3)))

    def follow(self, solution: MapState) -> None:
        """Takes over a solution of the map."""
        state, poses = self.state, solution.unmerged_poses()
        state.pose.rows[:] = poses
        state.bias, state.turn_error = solution.bias, solution.turn_error
        state.prior, state.heading_noise = solution.prior, solution.heading_noise
        state.log.follow(solution.log)
        state.cut.replace(np.full(len(poses), -1))
        state.cut.rows[solution.taken.rows] = solution.cut.rows
