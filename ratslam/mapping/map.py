"""The keyframe map: every remembered view is a keyframe; closures are verified, the poses optimised.

Recall proposes candidates. Consecutive candidates that agree with the odometry form a closure sequence; it
is accepted if it has enough evidence and lies where the covariance of the map allows (`acceptance`). An
accepted sequence keeps a robust weight, so that other closures can still outvote it. Only for a robot that
may be carried (`may_be_carried`) can a long sequence that contradicts the map show a break of the odometry:
the odometry is cut where the views indicate it, and the sequence joins the parts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ratslam.core.arrays import Checkpointed
from ratslam.core.backend import NO_CLOSURE, Evidence, Map
from ratslam.core.estimates import Action, Estimate
from ratslam.mapping.acceptance import Acceptance
from ratslam.mapping.appearance import Appearance
from ratslam.mapping.archive import MOST_SOLVED, Archive, KeyframeMerger
from ratslam.mapping.carried_solution import is_retraced, kept_part, retraced_solution
from ratslam.mapping.closure_judge import doubt_of_closures
from ratslam.mapping.config import FULL, Ablation, KeyframeMapConfig
from ratslam.mapping.experiences import Experiences
from ratslam.mapping.ground import LearnedOdds
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict, write_closures
from ratslam.mapping.map_solution import DOUBTED, MapSolution, selected_solution, worse_than_odometry
from ratslam.mapping.odometry_calibration import calibration_from_views, write_calibration
from ratslam.mapping.pose_graph import Edges, write_g2o, write_json
from ratslam.mapping.selection_worker import SelectionWorker
from ratslam.mapping.step_record import NO_TRAVEL, LiveFilter, StepRecord, leading_to
from ratslam.mapping.verification import continues_sequence, has_same_heading, spans
from ratslam.recall.memory import MapFeedback, MergedRows
from tactile.base.types import Observation

if TYPE_CHECKING:
    import networkx

DOUBT_EVERY = 50
"""Keyframes between two judgements of the present map."""
TIE_EVERY = 4
"""Keyframes between two trials of a tie of the newest piece to older keyframes."""
YOUNG = 400
"""Number of keyframes of a piece up to which its tie is tried: one that later views contradict is undone."""

Tie = tuple[float, Sequence[Candidate]]
"""A placement of the newest piece: its log-odds less the logarithm of the number of places (where those of
another placement are within half of `tie_log_odds`, the difference to the largest of these), and the closures
that it implies."""
FindTie = Callable[[KeyframeGraph, ClosureLog, Archive, LearnedOdds], Tie | None]
"""Finds the best placement of the keyframes since the newest beginning among those before, and keeps the
odds that it learns for these; None without any."""


class KeyframeMap(Checkpointed, Map):
    """The map of the recall backend: a pose graph of keyframes, as in graph SLAM (Grisetti et al. 2010).

    Each step `update` adds the odometry to the motion since the newest keyframe. If recall has stored the
    view, that is a new keyframe: it is placed by odometry, a recalled match is logged as a candidate and
    judged, the map is optimised where that is due, and the keyframe gets an experience. `solution` is the
    map as it would be if the session ended now; it is solved when it is asked for, and changes nothing.

    Args:
        config: settings; lengths in pose cells.
        cell: size of a pose cell, m.
        appearance: the views of the keyframes, empty.
        acceptance: makes the rule for closure sequences.
        guard: number of newest keyframes, never recalled.
        closures: False for a map of odometry alone.
        ablation: parts turned off by a study.
        find_tie: places the newest piece of the map on the others; None: pieces stay apart.

    Attributes:
        log: candidates and sequences of the keyframes that are not merged.
        archive, appearance: of all keyframes ever taken.
        travel: the motion since the newest keyframe.
        merger, selection: merge keyframes and select closures beside the session.
    """

    VALUES = ("travel", "_since", "_turned", "_begins", "_solved", "_doubt")
    PARTS = (
        "_graph", "log", "_steps", "archive", "merger", "_experiences", "appearance", "_acceptance",
        "_live", "selection", "_tie_odds",
    )  # fmt: skip

    def __init__(
        self,
        config: KeyframeMapConfig,
        cell: float,
        appearance: Appearance,
        acceptance: Callable[[KeyframeGraph, Archive], Acceptance],
        *,
        guard: int = 20,
        closures: bool = True,
        ablation: Ablation = FULL,
        find_tie: FindTie | None = None,
    ) -> None:
        self.config, self.cell, self.closes_loops = config, cell, closures
        self.appearance = appearance
        self._graph = KeyframeGraph(config, cell, appearance, guard, ablation)
        self.log = ClosureLog()
        self.archive = Archive(KeyframeGraph(config, cell, appearance, guard, ablation))
        self.merger = KeyframeMerger(self.archive)
        self.selection = SelectionWorker()
        self._acceptance, self._find_tie = acceptance(self._graph, self.archive), find_tie
        self._experiences = Experiences(config.place_radius * cell, config.place_heading)
        self._live, self._steps, self._tie_odds = LiveFilter(), StepRecord(), LearnedOdds()
        self.travel = NO_TRAVEL
        self._since, self._turned = 0.0, 0.0  # distance (m) and turns (rad) since the last closure
        self._begins = False  # the next keyframe begins a piece
        self._solved = (-1, -1)  # sequence and number of the keyframe of the last optimisation
        self._solution: MapSolution | None = None
        self._kept: MapSolution | None = None  # the same without merged keyframes
        self._worse: float | None = None  # of that solution
        self._doubt = np.nan  # of the map some keyframes ago

    def feedback(self) -> MapFeedback:
        """The poses, heading bias and view metric for the view cells."""
        graph, metric = self._graph, self.appearance.metric()
        start = graph.next_start() if self._begins else None
        return MapFeedback(graph.pose.rows, graph.bias, graph.turn_error, self._since, *metric, start)

    def pose(self, estimate: Estimate) -> np.ndarray:
        """[3] the newest keyframe's pose and the motion since; by odometry until a closure is accepted, as
        a bias that only views show may be wrong."""
        del estimate
        confirmed = (self.log.verdicts() == Verdict.ACCEPTED).any()
        graph, (motion, length, _) = self._graph, self.travel
        if confirmed:
            return graph.pose_after(motion, length)
        reckoned = self._steps.odometry[-1:]
        if len(reckoned) and np.isfinite(reckoned).all() and not (self._begins or graph.begins.rows.any()):
            return reckoned[0].copy()
        return graph.reckoned_after(motion, length)

    def trajectory(self) -> np.ndarray:
        """[T, 3] every step in the final map, or by odometry where that is likely the better estimate."""
        given = self._given()
        return self._steps.poses(given.fit, given.open_pieces(self.keyframes()))

    def map_trajectory(self) -> np.ndarray:
        """[T, 3] every step in the final map."""
        return self._steps.poses(self.solution().fit, self.solution().open_pieces(self.keyframes()))

    def unjudged(self) -> str:
        if len(self.solution().log.accepted_rows()):
            return ""
        start = self._graph.start
        return NO_CLOSURE + ", as calibrated by the configuration" * bool(start.bias or start.turn_error)

    def doubt(self) -> float:
        return self._doubt

    def final_doubt(self) -> float:
        if self._worse is None:
            graph, found = self.keyframes(), self.solution()
            if graph.count > MOST_SOLVED:  # merged keyframes, which are not solved for, say nothing new
                graph, found = self._graph, self.kept_solution()
            self._worse = float(np.fmax(worse_than_odometry(graph, found), doubt_of_closures(graph, *found)))
        return self._worse

    def online_trajectory(self) -> np.ndarray:
        """[T, 3] every step in the online map, before the final optimisation."""
        graph = self._graph
        fit, _, _ = present = self._by_odometry(MapSolution(graph.fit(), self.log, graph.cut), graph)
        open_ = present.open_pieces(graph)
        open_ = open_[self.archive.row.rows] if self.archive.begun else open_
        return self._steps.poses(fit._replace(poses=self.archive.poses(fit.poses)), open_)

    def closures(self) -> np.ndarray:
        """[M, 2] steps of the keyframes joined by accepted loop closures; none where odometry is given."""
        return self.keyframe_steps()[self._given().log.accepted_pairs()]

    def judged_closures(self) -> np.ndarray:
        """[n, 3] see `Map`; candidates of merged keyframes are left out."""
        judged, step = self.log.judged(), self.keyframe_steps()[self._graph.taken.rows]
        return np.column_stack([step[judged[:, :2]], judged[:, 2]])

    def pieces(self) -> np.ndarray:
        """[T] the piece of each step, see `ratslam.mapping.keyframe_graph`."""
        return self._steps.of_keyframes(self.keyframe_pieces())

    def keyframe_pieces(self) -> np.ndarray:
        """[N] the piece of each keyframe; those of odometry where that is given."""
        return self._given().pieces(self.keyframes())

    def candidates(self) -> np.ndarray:
        """[n, 10] all candidates, of recall and then along a retraced map, see `ClosureLog.table`; open
        where odometry is given."""
        return self._given().log.table()

    def covariance(self) -> np.ndarray:
        """[3, 3] covariance of the newest keyframe's pose in the frame of its piece's first (m, m, rad)."""
        return self._graph.newest_covariance(self.log)

    def solution(self) -> MapSolution:
        """The final map of all keyframes, as it would be if the session ended now."""
        if self._solution is None:
            kept = self.kept_solution()
            whole = self._solution or self.archive.solve(kept, self._graph)
            self._solution = self._by_odometry(whole, self.keyframes())
        return self._solution

    def kept_solution(self) -> MapSolution:
        """The final map of the keyframes that are not merged."""
        if self._kept is None:
            graph, log, selected = self._graph, self.log, None
            if not self.closes_loops:
                found = MapSolution.solved(graph, log)
            else:
                if self.config.select_every:
                    selected = selected_solution(graph, log, deepcopy(self.selection.hypotheses))
                found = selected or self._acceptance.solution(graph, log)
            kept = found.placed(graph)
            if self.closes_loops and is_retraced(self.keyframes()):
                whole = self.archive.solve(kept, self._graph)
                self._solution = retraced_solution(self.keyframes(), whole)
                kept = kept_part(self._solution, kept, self._graph.taken.rows)
            self._kept = self._by_odometry(kept, self._graph)
        return self._kept

    def graph(self) -> networkx.DiGraph:
        """See `Experiences.graph`."""
        taken = self._graph.taken.rows
        return self._experiences.graph(self._given().fit.poses[taken], taken, self.keyframe_pieces()[taken])

    def edges(self) -> Edges:
        """Pose graph of the keyframes that are not merged: odometry without its bias, and closures with
        their robust weights."""
        return self._graph.edges(*self.kept_solution())

    def files(self) -> dict[str, Callable[[Path], None]]:
        """Functions that write files, by name: experiences as node-link JSON, keyframes as a g2o graph, the
        closures with their evidence, and, where the map is not doubted, the calibration of the odometry."""
        graph, kept = self._graph, self.kept_solution()
        # Of several pieces, the first keyframe of each is fixed: nothing else determines where it lies.
        pieces, first = np.unique(self.keyframe_pieces()[graph.taken.rows], return_index=True)
        fixed = first.tolist() if len(pieces) > 1 else ()
        noise = graph.heading_noise if self.config.select_every else None
        calibration: dict[str, Callable[[Path], None]] = {
            "calibration.yaml": lambda path: write_calibration(path, graph.calibration(*kept), noise)
        }
        return (calibration if self.final_doubt() <= DOUBTED else {}) | {
            "map.json": lambda path: write_json(path, self.graph()),
            "map.g2o": lambda path: write_g2o(path, kept.fit.poses, graph.edges(*kept), fixed=fixed),
            "closures.csv": lambda path: write_closures(path, self.candidates(), self.keyframe_steps()),
        }

    def keyframes(self) -> KeyframeGraph:
        """All keyframes, merged ones included, with their views; poses are those of the last solution."""
        return self.archive.graph if self.archive.begun else self._graph

    def kept_keyframes(self) -> KeyframeGraph:
        """The keyframes that are not merged, with the present map."""
        return self._graph

    def keyframe_steps(self) -> np.ndarray:
        """[N] the step at which each keyframe was taken."""
        return self._steps.first_steps(self._graph.total)

    def begin_piece(self) -> None:
        """The next keyframe begins a piece; steps until then lead to it."""
        self._steps.settle(self._graph.total)
        self._begins = self._graph.count > 0
        self.travel = NO_TRAVEL
        self._since = self._turned = 0.0

    def merge(self) -> MergedRows | None:
        """Merges keyframes of known ground (`ratslam.mapping.merging`)."""
        merged = self.merger.merge(self._graph, self.log, self.selection, self._experiences)
        if merged is not None:
            self._forget_solution()
        return merged

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Moves by the odometry; a view that became a keyframe is added, judged and given an experience."""
        graph, self.travel = self._graph, self.travel.onwards(observation.odometry)
        place = previous = self._experiences.current
        action = Action.NONE
        if int(evidence.keyframe) >= 0:
            self._append(observation)
            shown = self.appearance.learn(evidence, lambda: self.archive.confirmed_pairs(graph, self.log))
            _, standard_error = shown
            if self.closes_loops and np.isfinite(standard_error) and self.config.bias_from_views:
                prior = calibration_from_views(self.config, self.cell, graph.start, shown)
                self._acceptance.learn_bias(graph, self.log, prior)
            matched = self._judge_candidate(evidence)
            if self.closes_loops:
                self._maintain()
            # The pose may find a known experience while the drift since the last closure is small.
            drift = graph.heading_variance(self._since, self._turned)
            reliable = self._since <= 5 * self.cell and bool(drift <= self.config.place_heading**2)
            poses, begins = graph.pose.rows, bool(graph.begins.rows[-1])
            place, previous, action = self._experiences.arrive(
                poses, len(poses) - 1, matched, reliable, begins
            )
        count = graph.total
        moved = np.array(observation.odometry[:3], float)
        moved = graph.calibrated(moved, float(np.hypot(*moved[:2])))
        frame = leading_to(count) if self._begins or not count else count - 1
        self._steps.append(frame, self.travel, moved if np.isfinite(moved).all() else np.zeros(3))
        self._forget_solution()
        return estimate._replace(place=place, previous=previous, action=action)

    def add_accepted(self, candidates: Sequence[Candidate]) -> None:
        """Adds the candidates of one sequence, which is accepted; the map is not optimised."""
        self.log.add_accepted(candidates)
        for k, candidate in enumerate(candidates):
            self.archive.add(candidate, k > 0, self._graph)

    def undo(self, sequence: int) -> None:
        """Removes the closures of a sequence and optimises without them.

        Raises:
            ValueError: it has an `Obstacle`.
        """
        obstacle = self.solution().obstacle(sequence, self.log)
        if obstacle is not None:
            raise ValueError(f"sequence {sequence} {obstacle}")
        self.log.judge(sequence, Verdict.UNDONE)
        self._optimise()

    def _append(self, observation: Observation) -> None:
        motion, length, turn = self.travel
        if self._begins or not self._graph.count:
            self._steps.arrive(self._graph.total, self.travel)
        if self._begins:
            self._graph.begin_piece()
            motion, length, turn = NO_TRAVEL
        else:
            self._graph.append(self._graph.pose_after(motion, length), motion, length, turn)
        self.archive.append(self._graph)
        self._live.advance(self._graph)
        self._since, self._turned = self._since + length, self._turned + turn
        self.travel, self._begins = NO_TRAVEL, False
        self.appearance.append(observation, motion[2], length)

    def _judge_candidate(self, evidence: Evidence) -> int:
        """Logs and judges a candidate; returns the keyframe that it confirms as the present place, or
        -1."""
        if int(evidence.match) < 0 or float(evidence.posterior) <= self.config.candidate_posterior:
            return -1
        graph, log, config = self._graph, self.log, self.config
        found = int(evidence.match), int(evidence.shift), float(evidence.posterior), float(evidence.log_ratio)
        candidate = Candidate(graph.count - 1, *found)
        follows = continues_sequence(graph, log, candidate)
        sequence = log.add(candidate, follows)
        self.archive.add(candidate, follows, graph)
        changed = self.closes_loops and self._acceptance.judge(graph, log, sequence, candidate)
        due = False  # whether the map is optimised for one more member of an accepted sequence
        if log.verdict(sequence) == Verdict.ACCEPTED:
            weight = log.sequence_weights()[sequence]
            graph.pose.rows[-1] = self._live.correct(graph, candidate, weight)
            strayed = not config.select_every and self._live.strayed > config.solve_strayed
            long_ago = graph.total - self._solved[1] >= config.solve_every
            due = sequence != self._solved[0] or long_ago or strayed
        if changed or due:
            self._solved = sequence, graph.total
            self._optimise()
            if changed and self._acceptance.review(graph, log):
                self._optimise()
        if log.verdict(sequence) != Verdict.ACCEPTED:
            return -1
        self._since = self._turned = 0.0
        return candidate.match if has_same_heading(graph, candidate) else -1

    def _maintain(self) -> None:
        """Takes up a finished selection and begins the next, ties the newest piece, judges the map."""
        graph, log = self._graph, self.log
        if self.selection.finish(graph, log):
            self.merger.merge_due = self.config.merge_stood > 0
            self._forget_solution()
        self.selection.begin(graph, log)
        self.merger.select(graph, log)
        if self._find_tie and self._tie_newest_piece(self._find_tie):
            self._optimise()
        if graph.total % DOUBT_EVERY == 0:
            self._doubt = worse_than_odometry(graph, MapSolution(graph.fit(), log, graph.cut))
            if not self.config.select_every:  # sequences are then confirmed by each judgement instead
                log.count_selection()
                self.merger.merge_due = self.config.merge_stood > 0

    def _tie_newest_piece(self, find: FindTie) -> bool:
        """If a trial is due: ties the newest piece where the evidence suffices, or undoes its tie where the
        views contradict it; whether the map has changed."""
        graph, log = self._graph, self.log
        starts = np.flatnonzero(graph.begins.rows)
        if graph.total % TIE_EVERY or not len(starts) or graph.count - starts[-1] > YOUNG:
            return False
        log_odds, closures = find(graph, log, self.archive, self._tie_odds) or (-np.inf, ())
        # Accepted sequences between keyframes before the newest beginning and since.
        newest = np.arange(graph.count) >= starts[-1]
        across = np.flatnonzero(spans(newest, log) & (log.verdicts() == Verdict.ACCEPTED))
        if not len(across):
            if log_odds < self.config.tie_log_odds:
                return False
            self.add_accepted(closures)
        elif log_odds >= self.config.tie_log_odds / 2:
            return False
        for sequence in across.tolist():
            log.judge(sequence, Verdict.UNDONE)
        graph.place_pieces(log)
        return True

    def _given(self) -> MapSolution:
        """The final map, or odometry without closures where that is doubted."""
        graph, found = self.keyframes(), self.solution()
        if not self.final_doubt() > DOUBTED:
            return found
        return self._by_odometry(found.without_closures(graph), graph)

    def _by_odometry(self, solution: MapSolution, graph: KeyframeGraph) -> MapSolution:
        """See `MapSolution.by_odometry`; graph: the keyframes of the solution."""
        return solution.by_odometry(graph, self._steps.odometry[self.keyframe_steps()[graph.taken.rows]])

    def _forget_solution(self) -> None:
        self._solution = self._kept = self._worse = None

    def _optimise(self) -> None:
        self._graph.optimise(self.log)
        self._live.strayed = 0.0
        self._forget_solution()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._forget_solution()
