"""The frame map: every remembered view a node, closures verified before they count, drift solved for.

The filter proposes, the map disposes: a run of candidates becomes closures only if there is enough evidence
in it and if it lies where the map's own covariance allows. Accepted runs keep a robust weight, so that the
rest of the map may outvote them later. Long runs that contradict the map tell broken odometry: then the
odometry is cut where the views say, and the run joins the parts. The rules are ours.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import networkx
import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from ratslam.backend import Evidence
from ratslam.arbitration import KEPT, Case, arbitrate
from ratslam.closures import Candidate, Ledger, Verdict
from ratslam.framegraph import Chain, Closures, Fit, Prior, corrected, relative_covariance, solve
from ratslam.graphfile import write_g2o, write_json
from ratslam.grouping import Grouping
from ratslam.growing import Growing
from ratslam.posegraph import Edges
from ratslam.recall import Guidance
from ratslam.sectors import Fan
from ratslam.types import Estimate
from tactile.frames import between, compose, fitted, integrate, inverse, wrap
from tactile.settings import Settings
from tactile.types import Observation

EVERY = 16
"""Frames between two looks at the bias that the views show."""
EARLIEST = 40
"""Frames before the first."""
ENOUGH = 400
"""Errors against ruled-out frames before their quantile is taken for the scale of errors."""
BACKGROUND = (0.005, 0.01, 0.02, 0.04, 0.08)
"""The quantiles whose geometric mean is the scale: errors so small are still seen between different places.
Several, because the errors of places that look exactly alike make a step in the quantiles, and a scale taken
from one quantile falls down that step."""
ALIKE = 1e-3
"""Least such quantile, as a share of the largest: places may look alike to the last bit."""
LOOSE = 1e4
"""Standard deviation of a cut odometry edge, cells."""
FAR_BACK = 400
"""Frames among which a break is looked for."""


class FrameNoise(Settings):
    """How much the odometry between frames is believed; cells are pose cells."""

    per_cell: PositiveFloat = 0.05
    """Standard deviation of position after one cell, cells; grows with the root of the way."""
    heading_per_cell: NonNegativeFloat = 0.02
    """Standard deviation of heading after one cell, rad."""
    heading_per_radian: NonNegativeFloat = 0.04
    """Standard deviation of heading after a turn of one radian, rad."""
    least: PositiveFloat = 0.02
    """Standard deviation between any two frames, cells."""
    least_heading: PositiveFloat = 0.005
    """The same of heading, rad."""


class FrameMapConfig(Settings):
    """The map of frames: what is believed, and how much. Lengths are in pose cells."""

    noise: FrameNoise = FrameNoise()
    """Trust in odometry."""
    bias_in_map: bool = True
    """Whether the map solves for the heading bias."""
    bias_from_views: bool = True
    """Whether ordered views tell it beforehand."""
    bias_sd: PositiveFloat = 0.012
    """Standard deviation of the bias where views tell nothing, rad per cell."""
    bias_least: PositiveFloat = 0.003
    """The views are never believed better than this, rad per cell."""
    shrink: NonNegativeFloat = 3.0
    """Standard errors under which the views' bias is taken for none."""
    certain: PositiveFloat = 0.5
    """Posterior from which a recollection is a candidate."""
    gap: PositiveInt = 3
    """Frames from one candidate of a run to the next, at most."""
    agreement: PositiveFloat = 2.0
    """How far candidates of a run may differ from the odometry between them, cells (and a tenth of it)."""
    agreement_heading: PositiveFloat = 0.5
    """The same of heading, rad."""
    length: PositiveInt = 2
    """Candidates that an accepted run has at least."""
    score: PositiveFloat = 4.0
    """Evidence it has at least, after half its squared Mahalanobis distance from the map is taken off and
    the log of how many times more frames the map allows than stand around one place."""
    distance: PositiveFloat = 12.0
    """That squared distance is smaller than this."""
    gate_sd: PositiveFloat = 0.7
    """Standard deviation added to the map's own in that distance, cells."""
    gate_heading: PositiveFloat = 0.2
    """The same of heading, rad."""
    closure_sd: PositiveFloat = 0.8
    """Standard deviation of a closure, cells."""
    closure_heading: PositiveFloat = 0.12
    """The same of heading, rad."""
    robust: bool = True
    """Whether runs that disagree with the map lose weight."""
    robust_per_score: PositiveFloat = 0.5
    """Robust scale (mean squared deviation) for each unit of a run's evidence."""
    robust_least: PositiveFloat = 2.0
    """The least such scale."""
    robust_most: PositiveFloat = 20.0
    """The largest."""
    breaks: bool = True
    """Whether long runs that contradict the map cut the odometry."""
    break_length: PositiveInt = 32
    """Candidates in such a run."""
    break_score: PositiveFloat = 100.0
    """Evidence in it."""
    verify: bool = True
    """Whether runs are held against the map's covariance before they count."""
    iterations: PositiveInt = 4
    """Solver steps when a loop closes."""
    settling: PositiveInt = 15
    """Solver steps for the final map."""
    learn_every: PositiveInt = 40
    floor_least: float = 3.0
    floor_quantile: float = 0.2
    solve_every: PositiveInt = 20
    mass: float = 0.5
    whole_run: float = 0.0
    reconsider: int = 0
    reconsider_score: float = 8.0
    reconsider_length: int = 4
    penalty: float = 0.0
    stray: float = 6.0
    place_radius: PositiveFloat = 2.0
    """Reach of an experience, cells."""
    place_heading: PositiveFloat = 0.35
    """The same of heading, rad."""


class Travel(NamedTuple):
    """Odometry since the newest frame: motion [3], way m, turn rad."""

    motion: np.ndarray
    length: float
    turn: float


HALT = Travel(np.zeros(3), 0.0, 0.0)


class FrameMap:
    """Folds what the unified filter reports (`ratslam.backend.Map`).

    Args:
        cell: size of a pose cell, m. size: values of a view; 0 for recordings with given ids.
        fan: width of the views in rad, 0: to be found out; None: not a fan. guard: newest frames that are
            never recalled. closures: whether anything but odometry shapes the map. normalise: what recall
            does to a view before it compares it.
    """

    def __init__(
        self,
        config: FrameMapConfig,
        cell: float,
        size: int,
        fan: float | None,
        *,
        guard: int = 20,
        closures: bool = True,
        normalise: Callable[[np.ndarray], np.ndarray] = np.asarray,
        whiskers: Any = None,
    ) -> None:
        self.config, self.cell, self.bent = config, cell, closures
        self.guard, self._normalise = guard, normalise
        self._fan = None if fan is None or not size else Fan(size, fan / size)
        self._ledger = Ledger()
        self._grouping = Grouping(config.place_radius * cell, config.place_heading)
        self._pose = Growing((3,), np.float64)
        self._motion = Growing((3,), np.float64)  # into each frame, as odometry told it
        self._length = Growing((), np.float64)
        self._turn = Growing((), np.float64)
        self._cut = Growing((), np.int64)  # the run that says the odometry broke before a frame, -1: none
        self._view = Growing((size,), np.float64)
        self._label = Growing((), np.int64)
        self._background = Growing((), np.float64)
        self._step_frame = Growing((), np.int64)
        self._step_motion = Growing((4,), np.float64)  # since that frame, and its length
        self._travel = HALT
        self._bias = 0.0
        self._prior = Prior(0.0, config.bias_sd / cell)
        self._since = 0.0
        self._whiskers = whiskers
        self._level = Growing((size if whiskers else 0,), np.int32)
        self._table: np.ndarray | None = None
        self._floor = 0.0
        self._odd = None
        self._scale = (0, 0.0)  # errors it was taken from, and the scale
        self._settled: Fit | None = None

    # What it answers

    def guidance(self) -> Guidance:
        """What the filter may know of the map."""
        if self._whiskers:
            return Guidance(self._pose.rows, self._bias, self._since, self._angle(), self._floor, self._table)
        return Guidance(self._pose.rows, self._bias, self._since, self._angle(), self._scale[1])

    def pose(self, estimate: Estimate) -> np.ndarray:
        """[3] the newest frame's pose and the motion since."""
        del estimate
        return self._present()

    def trajectory(self) -> np.ndarray:
        """[T, 3] every folded step as the settled map sees it."""
        return self._steps(self._settle())

    def so_far(self) -> np.ndarray:
        """[T, 3] every folded step as the map sees it at this moment, unsettled: what the robot acts on."""
        return self._steps(Fit(self._pose.rows, self._bias, np.zeros(0)))

    def closures(self) -> np.ndarray:
        """[M, 2] the steps of the frames that accepted runs join."""
        first = np.searchsorted(self._step_frame.rows, np.arange(len(self._pose.rows)))
        return first[self._ledger.table()[self._ledger.accepted(), :2].astype(int)].reshape(-1, 2)

    def candidates(self) -> np.ndarray:
        """[n, 9] all that recall proposed and what became of it, see `Ledger.table`."""
        return self._ledger.table()

    def undo(self, run: int) -> None:
        """Takes a run's closures back and solves without them.

        Raises:
            ValueError: there is no such run, it is not accepted, or it joins parts that odometry does not.
        """
        if not 0 <= run < self._ledger.runs or self._ledger.verdict(run) != Verdict.ACCEPTED:
            raise ValueError(f"run {run} is not an accepted run of this map")
        if np.any(self._cut.rows == run):
            raise ValueError(f"run {run} joins what broken odometry left apart; nothing else would hold it")
        self._ledger.judge(run, Verdict.UNDONE)
        self._correct()

    def covariance(self) -> np.ndarray:
        """[3, 3] of the newest frame's pose seen from the first frame (m, m, rad), under the map."""
        if len(self._pose.rows) < 2:
            return np.zeros((3, 3))
        return self._relative(0, len(self._pose.rows) - 1, 0.0)

    def graph(self) -> networkx.DiGraph:
        """Experiences with x, y (m), heading (rad) and their first frame; links with their evidence."""
        return self._grouping.graph(self._settle().poses)

    def files(self) -> dict[str, Callable[[Path], None]]:
        """Experiences as node-link JSON, frames as a g2o graph, and the closures with their evidence."""
        return {
            "map.json": lambda path: write_json(path, self.graph()),
            "map.g2o": lambda path: write_g2o(path, self._settle().poses, self.edges()),
            "closures.csv": self._write_closures,
        }

    def edges(self) -> Edges:
        """Odometry freed of its bias, and the closures with what weight they were left."""
        fit, chain, closures = self._settle(), self._chain(), self._closures()
        steps = np.arange(len(chain.length))
        zero = np.zeros(len(closures.i))
        turned = np.stack([zero, zero, closures.turn], axis=1)
        trust = self._ledger.weights()[:, None] / closures.variance
        return Edges(
            np.concatenate([steps, closures.i]),
            np.concatenate([steps + 1, closures.j]),
            np.concatenate([corrected(chain.motion, chain.length, fit.bias), turned]),
            np.concatenate([1 / chain.variance, trust]),
        )

    # What changes it

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Moves along the odometry; a view that became a frame is added, judged and given an experience."""
        self._advance(observation.odometry)
        said = self._grouping.stay()
        if int(evidence.frame) >= 0:
            self._append(observation)
            self._calibrate(evidence)
            matched = self._consider(evidence)
            if self.config.reconsider and len(self._pose.rows) % self.config.reconsider == 0:
                self._reconsider()
            if matched >= 0 and self._whiskers and int(evidence.shift):
                matched = -1  # the same spot faced the other way is another place
            sure = self._since <= 5 * self.cell
            said = self._grouping.arrive(self._pose.rows, len(self._pose.rows) - 1, matched, sure)
        self._step_frame.append(len(self._pose.rows) - 1)
        self._step_motion.append([*self._travel.motion, self._travel.length])
        self._settled = None
        return estimate._replace(place=said.place, previous=said.previous, action=said.action)

    def _advance(self, odometry: Any) -> None:
        moved = np.array([float(odometry.dx), float(odometry.dy), float(odometry.dtheta)])
        if not np.isfinite(moved).all():
            return  # the kernel has named this outcome; a map of NaN would help nobody
        length, travel = float(np.hypot(moved[0], moved[1])), self._travel
        self._travel = Travel(
            compose(travel.motion, moved), travel.length + length, travel.turn + abs(moved[2])
        )

    def _append(self, observation: Observation) -> None:
        motion, length, turn = self._travel
        self._pose.append(self._present())
        self._motion.append(motion)
        self._length.append(length)
        self._turn.append(turn)
        self._cut.append(-1)
        self._label.append(int(observation.label))
        size = self._view.rows.shape[1]
        view = self._normalise(np.asarray(observation.view, float)) if size else np.zeros(0)
        self._view.append(np.asarray(view, float).reshape(-1)[:size])
        if self._whiskers:
            from ratslam.likeness import levels
            al = np.asarray(observation.alive)
            al = np.repeat(al, self._whiskers[2][2]) if al.size else True
            self._level.append(levels(self._view.rows[-1], al))
        self._since += length
        self._travel = HALT
        if self._fan:
            self._fan.append(self._view.rows[-1], motion[2], length)

    def _learn(self) -> None:
        """The likeness of whisker images, from what is known by now."""
        from ratslam import likeness
        images = self._level.rows
        count = len(images)
        if count < 40 or count % self.config.learn_every:
            return
        group, behind, _ = self._whiskers
        random = np.random.default_rng(count)
        pairs = random.integers(0, count, (4000, 2))
        pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 20]
        known = self._ledger.table()[self._ledger.accepted()]
        known = known[(known[:, 3] > 0.95) & (known[:, 8] > 0.5)]
        frame, match, shift = known[:, 0].astype(int), known[:, 1].astype(int), known[:, 2].astype(int)
        now, then = images[frame], images[match]
        then = np.where((shift != 0)[:, None], then[:, behind], then)
        common = likeness.background(images, group)
        visits = likeness.variation(now, then)
        self._table = likeness.table(common, visits)
        self.visits = visits
        same = self._table[group, now, then].sum(axis=1)
        floor = float(np.quantile(same, self.config.floor_quantile)) if len(same) >= 20 else 0.0
        self._floor = max(self.config.floor_least, floor)

    def _calibrate(self, evidence: Evidence) -> None:
        if self._whiskers:
            return self._learn()
        for error in np.asarray(evidence.background)[np.isfinite(evidence.background)]:
            self._background.append(error)
        self._rescale()
        count = len(self._pose.rows) - 1
        if not self.bent or self._fan is None or count % EVERY or count < EARLIEST:
            return
        before, told = self._fan.angle, self._fan.estimate()
        cell, config = self.cell, self.config
        if not before and self._fan.angle:
            # Errors are smaller now that views may shift: those known so far are of another kind.
            self._background.replace(self._background.rows[:0])
            self._scale = 0, 0.0
        if np.isfinite(told.error) and config.bias_from_views:
            kept = (
                told.value * max(0.0, 1 - (config.shrink * told.error / told.value) ** 2)
                if told.value
                else 0.0
            )
            sd = min(np.hypot(told.error, told.value - kept), 2 * config.bias_sd / cell)
            self._prior = Prior(kept, max(sd, config.bias_least / cell))
        if not len(self._ledger.accepted()) and self._bias != self._prior.mean:
            self._bias = self._prior.mean
            self._retrace()

    def _retrace(self) -> None:
        """Dead reckoning of all frames with the present bias."""
        motion = corrected(self._motion.rows, self._length.rows, self._bias)
        for k in range(1, len(motion)):
            self._pose.rows[k] = compose(self._pose.rows[k - 1], motion[k])

    def _consider(self, evidence: Evidence) -> int:
        """Files a candidate; the frame it was accepted as, or -1."""
        if int(evidence.match) < 0 or float(evidence.mass) <= self.config.certain:
            return -1
        candidate = Candidate(
            len(self._pose.rows) - 1,
            int(evidence.match),
            int(evidence.shift),
            float(evidence.mass),
            float(evidence.gain),
        )
        run = self._ledger.add(candidate, self._follows(candidate))
        if self._ledger.verdict(run) == Verdict.OPEN and self.bent:
            self._judge(run, candidate)
        if self._ledger.verdict(run) != Verdict.ACCEPTED:
            return -1
        fresh = run != getattr(self, "_lastrun", None) or candidate.frame - self._solved >= self.config.solve_every
        if fresh or not self._whiskers:
            self._correct()
            self._lastrun, self._solved = run, candidate.frame
        self._since = 0.0
        return candidate.match

    def _reconsider(self) -> None:
        """Weighs all runs against each other anew."""
        config, ledger = self.config, self._ledger
        score, size = ledger.scores(), ledger.sizes()
        user = np.array([ledger.verdict(run) == Verdict.UNDONE for run in range(ledger.runs)], bool)
        taken = (score >= config.reconsider_score) & (size >= config.reconsider_length) & ~user
        if not taken.any():
            return
        self._cut.rows[:] = -1
        chain, prior = self._chain(), self._belief()
        reckoned = integrate(corrected(chain.motion, chain.length, self._prior.mean), self._pose.rows[0])
        reckoned = np.concatenate([self._pose.rows[:1], reckoned])
        case = Case(chain, self._closures_of(taken), prior, score[taken], ledger.firsts()[taken], ledger.lasts()[taken])
        starts = [Fit(self._pose.rows, self._bias, np.zeros(0)), Fit(reckoned, self._prior.mean, np.zeros(0))]
        judged = arbitrate(case, starts, self._where_carried)
        kept = np.zeros(ledger.runs, bool)
        kept[np.flatnonzero(taken)] = judged.fit.weights > KEPT
        for run in np.flatnonzero(~user).tolist():
            ledger.judge(run, Verdict.ACCEPTED if kept[run] else Verdict.OPEN)
        for frame, run in judged.cuts:
            self._cut.rows[frame] = np.flatnonzero(taken)[run]
        before = self._pose.rows.copy()
        self._pose.rows[:], self._bias = judged.fit.poses, judged.fit.bias
        fit = self._solve(6) if kept.any() else judged.fit
        if kept.any():
            ledger.weigh(fit.weights)
        self._pose.rows[:] = compose(fitted(fit.poses, before), fit.poses)
        self._bias = fit.bias
        self._settled = None

    def _where_carried(self, poses: np.ndarray, onwards: np.ndarray, carried: np.ndarray, since: int) -> int:
        """See `arbitration.Where`: views before the cut fit better where odometry leads, those after it carried."""
        frames = np.arange(since + 1, since + 1 + len(onwards))[-FAR_BACK:]
        onwards = onwards[-FAR_BACK:]
        old = self._pose.rows.copy()
        self._pose.rows[:] = poses
        stays, goes = (
            np.array([self._misfit(int(frame), pose) for frame, pose in zip(frames, rows, strict=True)])
            for rows in (onwards, compose(carried, onwards))
        )
        self._pose.rows[:] = old
        cost = np.concatenate([[0], np.cumsum(stays)[:-1]]) + np.cumsum(goes[::-1])[::-1]
        return int(frames[len(cost) - 1 - np.argmin(cost[::-1])])

    def _follows(self, candidate: Candidate) -> bool:
        """Whether it continues the newest run: as far from its last candidate in memory as in odometry."""
        last, config = self._ledger.last(), self.config
        if last is None or candidate.frame - last.frame > config.gap:
            return False
        pose, angle = self._pose.rows, self._angle()
        remembered = between(_turned(pose[last.match], -last.shift * angle),
                             _turned(pose[candidate.match], -candidate.shift * angle))  # fmt: skip
        travelled = between(pose[last.frame], pose[candidate.frame])
        apart = np.hypot(*(remembered - travelled)[:2])
        allowed = config.agreement * self.cell + 0.1 * np.hypot(*travelled[:2])
        near = bool(apart < allowed and abs(wrap(remembered[2] - travelled[2])) < config.agreement_heading)
        if near and config.whole_run:
            frame, match, shift, run = self._ledger.members(self._ledger.runs - 1)[0]
            remembered = between(_turned(pose[match], -shift * angle), _turned(pose[candidate.match], -candidate.shift * angle))
            travelled = between(pose[frame], pose[candidate.frame])
            apart = np.hypot(*(remembered - travelled)[:2])
            allowed = config.agreement * self.cell + config.whole_run * np.hypot(*travelled[:2])
            return bool(apart < allowed and abs(wrap(remembered[2] - travelled[2])) < 2*config.agreement_heading)
        return near

    def _judge(self, run: int, candidate: Candidate) -> None:
        """Accepts a run with enough evidence where the map allows it; a long one that contradicts, cuts."""
        config, score, length = self.config, self._ledger.score(run), len(self._ledger.members(run))
        if length < config.length or score < config.score:
            return
        distance, room = self._distance(candidate) if config.verify else (0.0, 0.0)
        fits = distance < config.distance and score - distance / 2 - room >= config.score
        self._ledger.judge(run, Verdict.ACCEPTED if fits else Verdict.OPEN, distance)
        broken = config.breaks and length >= config.break_length and score >= config.break_score
        if not fits and broken and distance >= config.distance:
            self._break(run)

    def _distance(self, candidate: Candidate) -> tuple[float, float]:
        """How far off what a candidate claims is from what the map believes.

        Returns:
            the squared Mahalanobis distance, and the room that the map leaves for such a claim to come
            about by chance, see `_alternatives`.
        """
        turn = -candidate.shift * self._angle()
        error = between(_turned(self._pose.rows[candidate.match], turn), self._pose.rows[candidate.frame])
        gate = self.config.gate_sd * self.cell
        allowed = self._relative(candidate.match, candidate.frame, turn)
        least = np.diag([gate**2, gate**2, self.config.gate_heading**2])
        allowed = allowed + least
        room = self._alternatives(candidate, turn, allowed[:2, :2], gate)
        return float(error @ np.linalg.solve(allowed, error)), float(room)

    def _alternatives(self, candidate: Candidate, turn: float, allowed: np.ndarray, gate: float) -> float:
        """Log of how many more frames the map allows than there are around one place."""
        old = self._pose.rows[: candidate.frame - self.guard]
        origin = _turned(self._pose.rows[candidate.match], turn)
        centre = between(origin, self._pose.rows[candidate.frame])[:2]
        frames = between(origin, old)[:, :2]
        apart = frames - centre
        inside = np.exp(-np.einsum("na,ab,nb->n", apart, np.linalg.inv(allowed), apart) / 2).sum()
        around = np.exp(-(frames**2).sum(axis=1) / (2 * gate**2)).sum()
        return float(np.log(max(inside / max(around, 1.0), 1.0)))

    def _break(self, run: int) -> None:
        """Cuts the odometry where the views say that it broke, and joins the parts by the run."""
        members, pose, angle = self._ledger.members(run), self._pose.rows, self._angle()
        middle = members[len(members) // 2]
        found = _turned(pose[middle[1]], -middle[2] * angle)
        carried = compose(found, inverse(pose[middle[0]]))
        first = int(members[0, 0])
        at = self._first_carried(carried, first)
        self._cut.rows[at] = run
        self._pose.rows[at:] = compose(carried, pose[at:])
        self._ledger.strike(at, run)
        self._ledger.judge(run, Verdict.ACCEPTED)

    def _first_carried(self, carried: np.ndarray, first: int) -> int:
        """The frame from which on the views fit better at the poses moved by `carried` [3]."""
        known = self._ledger.accepted()
        anchored = self._ledger.table()[known, 0]
        since = int(anchored[anchored < first].max(initial=0)) - self.config.gap
        frames = np.arange(max(since, first - FAR_BACK, 1), first + 1)
        stays, goes = (
            np.array([self._misfit(int(frame), pose) for frame, pose in zip(frames, poses, strict=True)])
            for poses in (self._pose.rows[frames], compose(carried, self._pose.rows[frames]))
        )
        # The break lies before frames[k] if those before k stay where they are and the others are carried.
        cost = np.concatenate([[0], np.cumsum(stays)[:-1]]) + np.cumsum(goes[::-1])[::-1]
        return int(frames[len(cost) - 1 - np.argmin(cost[::-1])])

    def _misfit(self, frame: int, pose: np.ndarray) -> float:
        """How badly a frame's view fits at a pose, 0..1: against the best of the older frames near it."""
        old = self._pose.rows[: max(frame - self.guard, 0)]
        near = np.flatnonzero(np.hypot(*(old - pose)[:, :2].T) < 1.5 * self.cell)
        if not len(near):
            return 0.5
        if self._whiskers:
            if self._table is None:
                return 0.5
            group, behind, _ = self._whiskers
            now, turned = self._level.rows[frame], np.cos(old[near, 2] - pose[2]) < 0
            then = np.where(turned[:, None], self._level.rows[near][:, behind], self._level.rows[near])
            odds = self._table[group, now, then].sum(axis=1).max()
            return float(np.log1p(np.exp(-0.25 * odds)))
        if not self._view.rows.shape[1]:
            return float(not np.any(self._label.rows[near] == self._label.rows[frame]))
        apart = np.abs(self._view.rows[near] - self._view.rows[frame]).mean(axis=1).min()
        return float(min(apart / max(2 * self._scale[1], 1e-300), 1.0))

    def _correct(self) -> None:
        """Solves, and moves the map as a whole so that its frames move as little as possible."""
        before = self._pose.rows.copy()
        fit = self._solve(self.config.iterations)
        self._ledger.weigh(fit.weights)
        moved = compose(fitted(fit.poses, before), fit.poses)
        self._pose.rows[:] = moved
        self._bias = fit.bias
        self._settled = None

    def _solve(self, iterations: int) -> Fit:
        return solve(self._pose.rows, self._bias, self._chain(), self._closures(), self._belief(), iterations)

    def _settle(self) -> Fit:
        if self._settled is None:
            settled = Fit(self._pose.rows.copy(), self._bias, np.zeros(0))
            self._settled = self._solve(self.config.settling) if len(self._ledger.accepted()) else settled
        return self._settled

    def _relative(self, i: int, j: int, turn: float) -> np.ndarray:
        fit = Fit(self._pose.rows, self._bias, np.zeros(0))
        return relative_covariance(fit, self._chain(), self._closures(), self._belief(), i, j, turn)

    def _belief(self) -> Prior:
        """About the bias."""
        return self._prior if self.config.bias_in_map else Prior(self._bias, 1e-9)

    def _chain(self) -> Chain:
        noise, cell = self.config.noise, self.cell
        length, turn, cut = self._length.rows[1:], self._turn.rows[1:], self._cut.rows[1:]
        along = noise.per_cell**2 * length * cell + (noise.least * cell) ** 2
        heading = noise.heading_per_cell**2 * length / cell + noise.heading_per_radian**2 * turn
        heading = heading + noise.least_heading**2
        variance = np.stack([along, along, heading], axis=1)
        loose = np.array([LOOSE * cell, LOOSE * cell, LOOSE]) ** 2
        return Chain(self._motion.rows[1:], length, np.where(cut[:, None] >= 0, loose, variance))

    def _closures(self) -> Closures:
        config = self.config
        return self._closures_of(None)

    def _closures_of(self, which: np.ndarray | None) -> Closures:
        config = self.config
        spread = config.closure_sd * self.cell
        variance = np.array([spread**2, spread**2, config.closure_heading**2])
        scales = (config.robust_per_score, config.robust_least, config.robust_most)
        closures = self._ledger.closures(self._angle(), variance, scales, which)
        if config.penalty:
            closures = closures._replace(scale=2 * np.maximum(closures.score - config.penalty, 1.0) / np.bincount(closures.run), stray=config.stray)
        return closures if config.robust else closures._replace(scale=np.full_like(closures.scale, 1e12))

    def _steps(self, fit: Fit) -> np.ndarray:
        frame, motion = self._step_frame.rows, self._step_motion.rows
        moved = corrected(motion[:, :3], motion[:, 3], fit.bias)
        if not len(fit.poses):
            return moved
        origin = np.where(frame[:, None] >= 0, fit.poses[np.maximum(frame, 0)], 0.0)
        return compose(origin, moved)

    def _present(self) -> np.ndarray:
        origin = self._pose.rows[-1] if len(self._pose.rows) else np.zeros(3)
        return compose(origin, corrected(self._travel.motion, self._travel.length, self._bias))

    def _parts(self) -> dict[str, Ledger | Grouping | Fan]:
        parts: dict[str, Ledger | Grouping | Fan] = {"ledger": self._ledger, "grouping": self._grouping}
        return parts | {"fan": self._fan} if self._fan else parts

    def _angle(self) -> float:
        if self._whiskers:
            return np.pi / 3
        return self._fan.angle if self._fan else 0.0

    def _rescale(self) -> None:
        """The error below which different places seldom come; taken anew when a tenth more is known."""
        count = len(self._background.rows)
        if count >= max(ENOUGH, 1.1 * self._scale[0]):
            small = np.quantile(self._background.rows, BACKGROUND)
            # As shares of the largest, so that the sensor's unit drops out to the last bit.
            share = small / small[-1] if small[-1] > 0 else small
            scale = float(small[-1] * np.exp(np.log(np.maximum(share, ALIKE)).mean()))
            self._scale = count, scale

    def _write_closures(self, path: Path) -> None:
        names = "frame,match,step,match_step,shift,mass,gain,run,distance,verdict,weight"
        first = np.searchsorted(self._step_frame.rows, np.arange(len(self._pose.rows)))
        lines = [names]
        for frame, match, shift, mass, gain, run, distance, verdict, weight in self.candidates().tolist():
            frame, match, run = int(frame), int(match), int(run)
            lines.append(
                f"{frame},{match},{first[frame]},{first[match]},{int(shift)},{mass!r},{gain!r},{run},"
                f"{distance!r},{Verdict(int(verdict)).name.lower()},{weight!r}"
            )
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")

    # What a checkpoint keeps

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything, so that `restore` continues bit for bit."""
        travel = self._travel
        return (
            {name: rows.rows.copy() for name, rows in self._growing().items()}
            | {
                f"{part}/{name}": rows
                for part, whole in self._parts().items()
                for name, rows in whole.arrays().items()
            }
            | {
                "travel": np.array([*travel.motion, travel.length, travel.turn]),
                "drift": np.array([self._bias, *self._prior, self._since]),
                "scale": np.array(self._scale),
            }
        )

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Takes the place of everything folded so far."""
        for name, rows in self._growing().items():
            rows.replace(arrays[name])
        for part, whole in self._parts().items():
            prefix = f"{part}/"
            whole.restore({k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)})
        travel, drift = np.asarray(arrays["travel"]), np.asarray(arrays["drift"])
        self._travel = Travel(travel[:3].copy(), float(travel[3]), float(travel[4]))
        self._bias, self._since = float(drift[0]), float(drift[3])
        self._prior = Prior(float(drift[1]), float(drift[2]))
        count, scale = np.asarray(arrays["scale"])
        self._scale = int(count), float(scale)
        self._settled = None

    def _growing(self) -> dict[str, Growing]:
        return {name[1:]: value for name, value in vars(self).items() if isinstance(value, Growing)}


def _turned(pose: np.ndarray, angle: float) -> np.ndarray:
    """The pose [3] turned on the spot."""
    return compose(pose, np.array([0.0, 0.0, angle]))
