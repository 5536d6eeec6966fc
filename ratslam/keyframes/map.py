"""The frame map: every remembered view a node, closures verified before they count, drift solved for.

The filter proposes, the map disposes: a run of candidates becomes closures only if there is enough evidence
in it and if it lies where the map's own covariance allows. Accepted runs keep a robust weight, so that the
rest of the map may outvote them later. Long runs that contradict the map tell broken odometry: then the
odometry is cut where the views say, and the run joins the parts. The rules are ours.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import networkx
import numpy as np

from ratslam.core.backend import Evidence
from ratslam.core.growable_array import GrowableArray
from ratslam.core.types import Estimate
from ratslam.keyframes.ablation import FULL, Ablation
from ratslam.keyframes.appearance import Appearance, Match
from ratslam.keyframes.closure_selection import FINE, KEPT, STEPS, Case, select_closures
from ratslam.keyframes.config import KeyframeMapConfig
from ratslam.keyframes.experiences import Experiences
from ratslam.keyframes.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.keyframes.optimizer import (
    Chain,
    Closures,
    Fit,
    Prior,
    relative_covariance,
    solve,
)
from ratslam.pose_graph import Edges
from ratslam.pose_graph.io import write_g2o, write_json
from ratslam.recall.filter import MapFeedback
from tactile.base.se2 import (
    between,
    compose,
    correct_heading_bias,
    fit_rigid_motion,
    integrate,
    inverse,
    wrap,
)
from tactile.base.types import Observation

LOOSE = 1e4
"""Standard deviation of a cut odometry edge, cells."""
SURE, FIRM = 0.95, 0.5
"""Posterior mass, and weight of its run, of a closure by which one learns what a place looks like again."""
FAR_BACK = 400
"""Frames among which a break is looked for."""


class Travel(NamedTuple):
    """Odometry since the newest frame: motion [3], way m, turn rad."""

    motion: np.ndarray
    length: float
    turn: float


class Settled(NamedTuple):
    """A map brought to an end: its fit, which runs it believes, and before which frames odometry is cut."""

    fit: Fit
    ledger: ClosureLog
    cut: GrowableArray


HALT = Travel(np.zeros(3), 0.0, 0.0)


class KeyframeMap:
    """Folds what the unified filter reports (`ratslam.core.backend.Map`).

    Args:
        cell: size of a pose cell, m. looks: empty appearances of frames. guard: newest frames that are never
            recalled. closures: whether anything but odometry shapes the map.
    """

    def __init__(
        self,
        config: KeyframeMapConfig,
        cell: float,
        looks: Appearance,
        *,
        guard: int = 20,
        closures: bool = True,
        ablation: Ablation = FULL,
    ) -> None:
        self.config, self.cell, self.bent = config, cell, closures
        self.guard, self.ablation = guard, ablation
        self._looks = looks
        self._ledger = ClosureLog()
        self._grouping = Experiences(config.place_radius * cell, config.place_heading)
        self._pose = GrowableArray((3,), np.float64)
        self._motion = GrowableArray((3,), np.float64)  # into each frame, as odometry told it
        self._length = GrowableArray((), np.float64)
        self._turn = GrowableArray((), np.float64)
        self._cut = GrowableArray(
            (), np.int64
        )  # the run that says the odometry broke before a frame, -1: none
        self._step_frame = GrowableArray((), np.int64)
        self._step_motion = GrowableArray((4,), np.float64)  # since that frame, and its length
        self._travel = HALT
        self._bias = 0.0
        self._prior = Prior(0.0, config.bias_sd / cell)
        self._since, self._turned = 0.0, 0.0  # way (m) and turn (rad) since the last closure
        self._solved = (-1, -1)  # the run and the frame of the last solution
        self._settled: Settled | None = None

    # What it answers

    def feedback(self) -> MapFeedback:
        """What the filter may know of the map."""
        return MapFeedback(self._pose.rows, self._bias, self._since, *self._looks.measure())

    def pose(self, estimate: Estimate) -> np.ndarray:
        """[3] the newest frame's pose and the motion since."""
        del estimate
        return self._present()

    def trajectory(self) -> np.ndarray:
        """[T, 3] every folded step as the settled map sees it."""
        return self._steps(self._settle().fit)

    def online_trajectory(self) -> np.ndarray:
        """[T, 3] every folded step as the map sees it at this moment, unsettled: what the robot acts on."""
        return self._steps(Fit(self._pose.rows, self._bias, np.zeros(0)))

    def closures(self) -> np.ndarray:
        """[M, 2] the steps of the frames that accepted runs join."""
        first = np.searchsorted(self._step_frame.rows, np.arange(len(self._pose.rows)))
        ledger = self._settle().ledger
        return first[ledger.table()[ledger.accepted(), :2].astype(int)].reshape(-1, 2)

    def candidates(self) -> np.ndarray:
        """[n, 9] all that recall proposed and what became of it, see `ClosureLog.table`."""
        return self._settle().ledger.table()

    def undo(self, run: int) -> None:
        """Takes a run's closures back and solves without them.

        Raises:
            ValueError: there is no such run, it is not accepted, or it joins parts that odometry does not.
        """
        settled = self._settle()
        if not 0 <= run < self._ledger.runs or settled.ledger.verdict(run) != Verdict.ACCEPTED:
            raise ValueError(f"run {run} is not an accepted run of this map")
        if np.any(settled.cut.rows == run):
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
        return self._grouping.graph(self._settle().fit.poses)

    def files(self) -> dict[str, Callable[[Path], None]]:
        """Experiences as node-link JSON, frames as a g2o graph, and the closures with their evidence."""
        return {
            "map.json": lambda path: write_json(path, self.graph()),
            "map.g2o": lambda path: write_g2o(path, self._settle().fit.poses, self.edges()),
            "closures.csv": self._write_closures,
        }

    def edges(self) -> Edges:
        """Odometry freed of its bias, and the closures with what weight they were left."""
        settled = self._settle()
        fit, chain, closures = settled.fit, self._chain(settled.cut), self._closures(settled.ledger)
        steps = np.arange(len(chain.length))
        zero = np.zeros(len(closures.i))
        turned = np.stack([zero, zero, closures.turn], axis=1)
        trust = settled.ledger.weights()[:, None] / closures.variance
        return Edges(
            np.concatenate([steps, closures.i]),
            np.concatenate([steps + 1, closures.j]),
            np.concatenate([correct_heading_bias(chain.motion, chain.length, fit.bias), turned]),
            np.concatenate([1 / chain.variance, trust]),
        )

    # What changes it

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Moves along the odometry; a view that became a frame is added, judged and given an experience."""
        self._advance(observation.odometry)
        said = self._grouping.stay()
        if int(evidence.frame) >= 0:
            self._append(observation)
            self._learn(evidence)
            matched = self._consider(evidence)
            self._weigh()
            frame = len(self._pose.rows) - 1
            said = self._grouping.arrive(self._pose.rows, frame, matched, self._sure())
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
        self._since += length
        self._turned += turn
        self._travel = HALT
        self._looks.append(observation, motion[2], length)

    def _learn(self, evidence: Evidence) -> None:
        told = self._looks.learn(evidence, self._known)
        config, cell = self.config, self.cell
        if not self.bent or not np.isfinite(told.error) or not config.bias_from_views:
            return
        kept = (
            told.value * max(0.0, 1 - (config.shrink * told.error / told.value) ** 2) if told.value else 0.0
        )
        sd = min(np.hypot(told.error, told.value - kept), 2 * config.bias_sd / cell)
        self._prior = Prior(kept, max(sd, config.bias_least / cell))
        if not len(self._ledger.accepted()) and self._bias != self._prior.mean:
            self._bias = self._prior.mean
            self._retrace()

    def _known(self) -> Match:
        """The closures that recall was sure of and the map has kept."""
        table = self._ledger.table()[self._ledger.accepted()]
        frame, match, shift = table[(table[:, 3] > SURE) & (table[:, 8] > FIRM), :3].astype(int).T
        return Match(frame, match, np.cos(shift * self._angle()) < 0)

    def _retrace(self) -> None:
        """Dead reckoning of all frames with the present bias."""
        motion = correct_heading_bias(self._motion.rows, self._length.rows, self._bias)
        for k in range(1, len(motion)):
            self._pose.rows[k] = compose(self._pose.rows[k - 1], motion[k])

    def _consider(self, evidence: Evidence) -> int:
        """Files a candidate; the frame it was accepted as, or -1."""
        if int(evidence.match) < 0 or float(evidence.mass) <= self.config.candidate_posterior:
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
        if run != self._solved[0] or candidate.frame - self._solved[1] >= self.config.solve_every:
            self._solved = run, candidate.frame
            self._correct()
        self._since = self._turned = 0.0
        return candidate.match if self._faces(candidate) else -1

    def _faces(self, candidate: Candidate) -> bool:
        """Whether the robot looks where it looked then, as far as odometry knows. A robot that has turned is
        elsewhere, even where a view that hardly changes with heading says otherwise."""
        pose, turn = self._pose.rows, -candidate.shift * self._angle()
        turned = wrap(pose[candidate.frame, 2] - pose[candidate.match, 2])
        drift = abs(wrap(turned - turn))
        return bool(np.cos(turn) > 0 and drift < self.config.agreement_heading * self.config.max_turn)

    def _sure(self) -> bool:
        """Whether little enough has been driven and turned since the last closure to know the experience."""
        noise = self.config.noise
        driven = noise.heading_per_cell**2 * self._since / self.cell
        variance = driven + noise.heading_per_radian**2 * self._turned
        return self._since <= 5 * self.cell and variance <= self.config.place_heading**2

    def _weigh(self) -> None:
        """Now and then, weighs all runs against each other anew and takes up the map that comes of it."""
        every = self.config.select_every
        if not every or not self.bent or len(self._pose.rows) % every:
            return
        settled = self._weighed()
        if settled is None:
            return
        before = self._pose.rows.copy()
        self._ledger, self._cut = settled.ledger, settled.cut
        self._pose.rows[:] = compose(fit_rigid_motion(settled.fit.poses, before), settled.fit.poses)
        self._bias, self._settled = settled.fit.bias, None

    def _weighed(self) -> Settled | None:
        """The map with the runs that are best believed together; None where none is worth it."""
        config, ledger, cut = self.config, deepcopy(self._ledger), deepcopy(self._cut)
        weighed = (ledger.scores() >= config.select_score) & (ledger.sizes() >= config.select_length)
        weighed &= ledger.verdicts() != Verdict.UNDONE
        if not weighed.any():
            return None
        runs = np.flatnonzero(weighed)
        broken = np.flatnonzero(np.isin(cut.rows, runs))
        earlier = tuple((frame, int(np.searchsorted(runs, cut.rows[frame]))) for frame in broken.tolist())
        cut.rows[:] = -1
        for run in np.flatnonzero(ledger.verdicts() != Verdict.UNDONE).tolist():
            ledger.judge(run, Verdict.ACCEPTED if weighed[run] else Verdict.OPEN)
        chain, closures = self._chain(cut), self._closures(ledger)
        path = integrate(
            correct_heading_bias(chain.motion, chain.length, self._prior.mean), self._pose.rows[0]
        )
        reckoned = Fit(np.concatenate([self._pose.rows[:1], path]), self._prior.mean, np.zeros(0))
        present = Fit(self._pose.rows.copy(), self._bias, np.zeros(0))
        case = Case(chain, closures, self._belief(), ledger.scores()[runs], *ledger.spans()[runs].T)
        judged = select_closures(case, [present, reckoned], self._where_broken, earlier)
        for run, weight in zip(runs.tolist(), judged.fit.weights.tolist(), strict=True):
            ledger.judge(run, Verdict.ACCEPTED if weight > KEPT else Verdict.OPEN)
        for frame, run in judged.cuts:
            cut.rows[frame] = runs[run]
        # Once more without those that are not believed: their last pull goes.
        fit = solve(*judged.fit[:2], self._chain(cut), self._closures(ledger), self._belief(), STEPS, FINE)
        ledger.weigh(fit.weights)
        return Settled(fit, ledger, cut)

    def _where_broken(self, poses: np.ndarray, onwards: np.ndarray, carried: np.ndarray, since: int) -> int:
        """See `arbitration.Where`."""
        frames = np.arange(since + 1, since + 1 + len(onwards))[-FAR_BACK:]
        return self._turning_point(frames, poses, onwards[-FAR_BACK:], carried)

    def _follows(self, candidate: Candidate) -> bool:
        """Whether it continues the newest run: as far from its last candidate in memory as in odometry."""
        last, config = self._ledger.last(), self.config
        if last is None or candidate.frame - last.frame > config.max_gap:
            return False
        pose, angle = self._pose.rows, self._angle()
        remembered = between(_turned(pose[last.match], -last.shift * angle),
                             _turned(pose[candidate.match], -candidate.shift * angle))  # fmt: skip
        travelled = between(pose[last.frame], pose[candidate.frame])
        apart = np.hypot(*(remembered - travelled)[:2])
        allowed = config.agreement * self.cell + 0.1 * np.hypot(*travelled[:2])
        near = bool(apart < allowed and abs(wrap(remembered[2] - travelled[2])) < config.agreement_heading)
        return near and self._agrees(candidate)

    def _agrees(self, candidate: Candidate) -> bool:
        """Whether it lies as far from the first candidate of the newest run as odometry says."""
        if not self.config.sequence_agreement:
            return True
        pose, angle = self._pose.rows, self._angle()
        frame, match, shift, _ = self._ledger.members(self._ledger.runs - 1)[0]
        remembered = between(_turned(pose[match], -shift * angle),
                             _turned(pose[candidate.match], -candidate.shift * angle))  # fmt: skip
        travelled = between(pose[frame], pose[candidate.frame])
        allowed = self.config.agreement * self.cell + self.config.sequence_agreement * np.hypot(
            *travelled[:2]
        )
        turned = abs(wrap(remembered[2] - travelled[2]))
        return bool(
            np.hypot(*(remembered - travelled)[:2]) < allowed and turned < 2 * self.config.agreement_heading
        )

    def _judge(self, run: int, candidate: Candidate) -> None:
        """Accepts a run with enough evidence where the map allows it; a long one that contradicts, cuts."""
        config, score, length = self.config, self._ledger.score(run), len(self._ledger.members(run))
        if length < config.min_length or score < config.min_score:
            return
        distance, room = self._distance(candidate) if self.ablation.verify else (0.0, 0.0)
        fits = distance < config.max_distance and score - distance / 2 - room >= config.min_score
        self._ledger.judge(run, Verdict.ACCEPTED if fits else Verdict.OPEN, distance)
        broken = config.breaks and length >= config.break_length and score >= config.break_score
        if not fits and broken and distance >= config.max_distance:
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
        since = int(anchored[anchored < first].max(initial=0)) - self.config.max_gap
        frames = np.arange(max(since, first - FAR_BACK, 1), first + 1)
        onwards = self._pose.rows[frames]
        return self._turning_point(frames, self._pose.rows, onwards, carried)

    def _turning_point(
        self, frames: np.ndarray, poses: np.ndarray, onwards: np.ndarray, carried: np.ndarray
    ) -> int:
        """The frame of `frames` [n] from which on views fit better carried than where odometry leads, at
        `onwards` [n, 3]; against older frames at `poses` [N, 3]."""
        stays, goes = (
            np.array(
                [self._misfit(frame, pose, poses) for frame, pose in zip(frames.tolist(), rows, strict=True)]
            )
            for rows in (onwards, compose(carried, onwards))
        )
        # The break lies before frames[k] if those before k stay where they are and the others are carried.
        cost = np.concatenate([[0], np.cumsum(stays)[:-1]]) + np.cumsum(goes[::-1])[::-1]
        return int(frames[len(cost) - 1 - np.argmin(cost[::-1])])

    def _misfit(self, frame: int, pose: np.ndarray, poses: np.ndarray) -> float:
        """How badly a frame's view fits at a pose: against the older frames near it, at poses [N, 3]."""
        old = poses[: max(frame - self.guard, 0)]
        near = np.flatnonzero(np.hypot(*(old - pose)[:, :2].T) < 1.5 * self.cell)
        return self._looks.misfit(frame, near, np.cos(old[near, 2] - pose[2]) < 0)

    def _correct(self) -> None:
        """Solves, and moves the map as a whole so that its frames move as little as possible."""
        before = self._pose.rows.copy()
        fit = self._solve(self.config.iterations)
        self._ledger.weigh(fit.weights)
        moved = compose(fit_rigid_motion(fit.poses, before), fit.poses)
        self._pose.rows[:] = moved
        self._bias = fit.bias
        self._settled = None

    def _solve(self, iterations: int) -> Fit:
        chain, closures = self._chain(self._cut), self._closures(self._ledger)
        return solve(self._pose.rows, self._bias, chain, closures, self._belief(), iterations)

    def _settle(self) -> Settled:
        """The final map, as it would be if the recording ended here."""
        if self._settled is None:
            settled = self._weighed() if self.config.select_every and self.bent else None
            if settled is None:
                fit = Fit(self._pose.rows.copy(), self._bias, np.zeros(0))
                fit = self._solve(self.config.settling) if len(self._ledger.accepted()) else fit
                settled = Settled(fit, self._ledger, self._cut)
            self._settled = settled
        return self._settled

    def _relative(self, i: int, j: int, turn: float) -> np.ndarray:
        fit = Fit(self._pose.rows, self._bias, np.zeros(0))
        return relative_covariance(
            fit, self._chain(self._cut), self._closures(self._ledger), self._belief(), i, j, turn
        )

    def _belief(self) -> Prior:
        """About the bias."""
        return self._prior if self.ablation.heading_bias else Prior(self._bias, 1e-9)

    def _chain(self, cut: GrowableArray) -> Chain:
        noise, cell = self.config.noise, self.cell
        length, turn, severed = self._length.rows[1:], self._turn.rows[1:], cut.rows[1:] >= 0
        along = noise.per_cell**2 * length * cell + (noise.least * cell) ** 2
        heading = noise.heading_per_cell**2 * length / cell + noise.heading_per_radian**2 * turn
        heading = heading + noise.least_heading**2
        variance = np.stack([along, along, heading], axis=1)
        loose = np.array([LOOSE * cell, LOOSE * cell, LOOSE]) ** 2
        return Chain(self._motion.rows[1:], length, np.where(severed[:, None], loose, variance))

    def _closures(self, ledger: ClosureLog) -> Closures:
        config = self.config
        spread = config.closure_sd * self.cell
        variance = np.array([spread**2, spread**2, config.closure_heading**2])
        scales = (config.robust_per_score, config.robust_least, config.robust_most)
        closures = ledger.closures(self._angle(), variance, scales)
        if config.select_every:
            worth = 2 * np.maximum(closures.score - config.sequence_cost, 1.0) / np.bincount(closures.run)
            # A run must be able to cost more than it is worth, else it can never be refused.
            return closures._replace(scale=worth, stray=np.maximum(config.closure_cost_limit, 1.5 * worth))
        return (
            closures if self.ablation.robust else closures._replace(scale=np.full_like(closures.scale, 1e12))
        )

    def _steps(self, fit: Fit) -> np.ndarray:
        frame, motion = self._step_frame.rows, self._step_motion.rows
        moved = correct_heading_bias(motion[:, :3], motion[:, 3], fit.bias)
        if not len(fit.poses):
            return moved
        origin = np.where(frame[:, None] >= 0, fit.poses[np.maximum(frame, 0)], 0.0)
        return compose(origin, moved)

    def _present(self) -> np.ndarray:
        origin = self._pose.rows[-1] if len(self._pose.rows) else np.zeros(3)
        return compose(origin, correct_heading_bias(self._travel.motion, self._travel.length, self._bias))

    def _parts(self) -> dict[str, ClosureLog | Experiences | Appearance]:
        return {"ledger": self._ledger, "grouping": self._grouping, "looks": self._looks}

    def _angle(self) -> float:
        return self._looks.measure().angle

    def _write_closures(self, path: Path) -> None:
        names = "keyframe,match,step,match_step,shift,mass,gain,sequence,distance,verdict,weight"
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
                "drift": np.array([self._bias, *self._prior, self._since, self._turned]),
                "solved": np.array(self._solved),
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
        self._bias, self._since, self._turned = float(drift[0]), float(drift[3]), float(drift[4])
        self._prior = Prior(float(drift[1]), float(drift[2]))
        run, frame = np.asarray(arrays["solved"])
        self._solved = int(run), int(frame)
        self._settled = None

    def _growing(self) -> dict[str, GrowableArray]:
        return {name[1:]: value for name, value in vars(self).items() if isinstance(value, GrowableArray)}


def _turned(pose: np.ndarray, angle: float) -> np.ndarray:
    """The pose [3] turned on the spot."""
    return compose(pose, np.array([0.0, 0.0, angle]))
