"""The keyframe map: every remembered view is a keyframe, loop closures are verified, the pose graph is
optimised.

Recall proposes candidates. Consecutive candidates that agree with the odometry form a closure sequence; it is
accepted if it has enough evidence and lies where the map's covariance allows. Accepted sequences keep a
robust weight, so that other closures can still outvote them. Only for a robot that may be carried
(`may_be_carried`), a long sequence that contradicts the map shows a break of the odometry: the odometry is
cut where the views indicate it, and the sequence joins the parts. The rules are ours."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ratslam.core.backend import NO_CLOSURE, Evidence, Map
from ratslam.core.checkpoint import Checkpointed
from ratslam.core.estimates import Estimate
from ratslam.mapping.acceptance import Acceptance
from ratslam.mapping.appearance import Appearance
from ratslam.mapping.archive import MOST_SOLVED, Archive, KeyframeMerger
from ratslam.mapping.carried_solution import is_retraced, kept_part, retraced_solution
from ratslam.mapping.closure_judge import doubt_of_closures
from ratslam.mapping.config import FULL, Ablation, KeyframeMapConfig
from ratslam.mapping.experiences import ExperienceChange, Experiences
from ratslam.mapping.ground import LearnedOdds
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import ClosureLog, Verdict, recalled_candidate, write_closures
from ratslam.mapping.map_solution import (
    DOUBTED,
    MapSolution,
    selected_solution,
    solved_map,
    worse_than_odometry,
)
from ratslam.mapping.odometry_calibration import calibration_from_views, write_calibration
from ratslam.mapping.piece_ties import FindTie, no_tie, tie_newest_piece
from ratslam.mapping.pose_graph import Edges, write_g2o, write_json
from ratslam.mapping.selection_worker import SelectionWorker
from ratslam.mapping.step_record import HALT, LiveFilter, StepRecord, Travel, leading_to
from ratslam.mapping.verification import continues_sequence, has_same_heading
from ratslam.recall.memory import MapFeedback, MergedRows
from tactile.base.types import Observation

if TYPE_CHECKING:
    import networkx

DOUBT_EVERY = 50
"""Keyframes between two judgements of the present map."""


class KeyframeMap(Checkpointed, Map):
    """The map of the recall backend.

    Args:
        cell: size of a pose cell, m. appearance: of the keyframes, empty. guard: number of newest keyframes,
            never recalled. closures: False for a map of odometry alone. ablation: parts turned off by a
            study. acceptance: makes the rule for closure sequences. find_tie: see `FindTie`.

    Attributes:
        log: of the kept keyframes. archive, appearance: of all. merger, selection: at work.
    """

    VALUES = ("_travel", "_since", "_turned", "_begins", "_solved", "_doubt")
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
        find_tie: FindTie = no_tie,
    ) -> None:
        self.config, self.cell, self.closes_loops = config, cell, closures
        self.appearance = appearance
        self._graph = KeyframeGraph(config, cell, appearance, guard, ablation)
        self.log = ClosureLog()
        self.archive = Archive(KeyframeGraph(config, cell, appearance, guard, ablation))
        self.merger = KeyframeMerger(self.archive)
        self.selection = SelectionWorker(config.select_every)
        self._acceptance, self._find_tie = acceptance(self._graph, self.archive), find_tie
        self._experiences = Experiences(config.place_radius * cell, config.place_heading)
        self._live, self._steps, self._tie_odds = LiveFilter(), StepRecord(), LearnedOdds()
        self._travel = HALT
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
        graph, (motion, length, _) = self._graph, self._travel
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
        """[n, 10] all candidates, of recall and then along a retraced map, see `ClosureLog.table`; open where
        odometry is given."""
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
            kept = self._solve_finally().placed(self._graph)
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
        """Pose graph of the keyframes that are not merged: odometry without its bias, and closures with their
        robust weights."""
        return self._graph.edges(*self.kept_solution())

    def files(self) -> dict[str, Callable[[Path], None]]:
        """Functions that write files, by name: experiences as node-link JSON, keyframes as a g2o graph, the
        closures with their evidence, and, where the map is not doubted, the calibration of the odometry."""
        calibrated = self.final_doubt() <= DOUBTED
        calibration = {"calibration.yaml": self._write_calibration} if calibrated else {}
        return calibration | {
            "map.json": lambda path: write_json(path, self.graph()),
            "map.g2o": self._write_g2o,
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
        return self._steps.first_steps(self._graph.ever)

    @property
    def travel(self) -> Travel:
        """The motion since the newest keyframe."""
        return self._travel

    def begin_piece(self) -> None:
        """The next keyframe begins a piece; steps until then lead to it."""
        self._steps.settle(self._graph.ever)
        self._begins = self._graph.count > 0
        self._travel = HALT
        self._since = self._turned = 0.0

    def merge(self) -> MergedRows | None:
        """Merges keyframes of known ground (`ratslam.mapping.merging`)."""
        merged = self.merger.merge(self._graph, self.log, self.selection, self._experiences)
        if merged is not None:
            self._forget_solution()
        return merged

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Moves by the odometry; a view that became a keyframe is added, judged and given an experience."""
        self._travel = self._travel.onwards(observation.odometry)
        change = self._experiences.stay()
        if int(evidence.keyframe) >= 0:
            self._append(observation)
            self._learn(evidence)
            matched = self._consider(evidence)
            self._select()
            map = self._graph, self.log, self.archive, self._tie_odds
            if self.closes_loops and tie_newest_piece(*map, self._find_tie):
                self._optimise()
            self._judge()
            change = self._arrive(matched)
        ever = self._graph.ever
        moved = np.array(observation.odometry[:3], float)
        moved = self._graph.calibrated(moved, float(np.hypot(*moved[:2])))
        frame = leading_to(ever) if self._begins or not ever else ever - 1
        self._steps.append(frame, self._travel, moved if np.isfinite(moved).all() else np.zeros(3))
        self._forget_solution()
        return estimate._replace(place=change.place, previous=change.previous, action=change.action)

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

    def _solve_finally(self) -> MapSolution:
        graph, log, selected = self._graph, self.log, None
        if not self.closes_loops:
            return solved_map(graph, log)
        if self.config.select_every:
            selected = selected_solution(graph, log, deepcopy(self.selection.hypotheses))
        return selected or self._acceptance.solution(graph, log)

    def _append(self, observation: Observation) -> None:
        motion, length, turn = self._travel
        if self._begins or not self._graph.count:
            self._steps.arrive(self._graph.ever, self._travel)
        if self._begins:
            self._graph.begin_piece()
            motion, length, turn = HALT
        else:
            self._graph.append(self._graph.pose_after(motion, length), motion, length, turn)
        self.archive.append(self._graph)
        self._live.advance(self._graph)
        self._since, self._turned = self._since + length, self._turned + turn
        self._travel, self._begins = HALT, False
        self.appearance.append(observation, motion[2], length)

    def _arrive(self, matched: int) -> ExperienceChange:
        poses, begins = self._graph.pose.rows, bool(self._graph.begins.rows[-1])
        return self._experiences.arrive(poses, len(poses) - 1, matched, self._is_pose_reliable(), begins)

    def _learn(self, evidence: Evidence) -> None:
        """Updates the view metric, and the prior of the heading bias from ordered views."""
        shown = self.appearance.learn(evidence, lambda: self.archive.confirmed_pairs(self._graph, self.log))
        if self.closes_loops and np.isfinite(shown.error) and self.config.bias_from_views:
            prior = calibration_from_views(self.config, self.cell, self._graph.start, shown)
            self._acceptance.learn_bias(self._graph, self.log, prior)

    def _consider(self, evidence: Evidence) -> int:
        """Logs and judges a candidate; returns the keyframe that it confirms as the present place, or -1."""
        if int(evidence.match) < 0 or float(evidence.posterior) <= self.config.candidate_posterior:
            return -1
        candidate = recalled_candidate(self._graph.count - 1, evidence)
        follows = continues_sequence(self._graph, self.log, candidate)
        sequence = self.log.add(candidate, follows)
        self.archive.add(candidate, follows, self._graph)
        changed = self.closes_loops and self._acceptance.judge(self._graph, self.log, sequence, candidate)
        if self.log.verdict(sequence) == Verdict.ACCEPTED:
            weight = self.log.sequence_weights()[sequence]
            self._graph.pose.rows[-1] = self._live.correct(self._graph, candidate, weight)
        if changed or self._is_solution_due(sequence):
            self._solved = sequence, self._graph.ever
            self._optimise()
            if changed and self._acceptance.review(self._graph, self.log):
                self._optimise()
        if self.log.verdict(sequence) != Verdict.ACCEPTED:
            return -1
        self._since = self._turned = 0.0
        return candidate.match if has_same_heading(self._graph, candidate) else -1

    def _is_solution_due(self, sequence: int) -> bool:
        """Whether the map is optimised for one more member of an accepted sequence."""
        if self.log.verdict(sequence) != Verdict.ACCEPTED:
            return False
        config = self.config
        strayed = not config.select_every and self._live.strayed > config.solve_strayed
        long_ago = self._graph.ever - self._solved[1] >= config.solve_every
        return sequence != self._solved[0] or long_ago or strayed

    def _is_pose_reliable(self) -> bool:
        """Whether the drift since the last closure is small enough to find a known experience by pose."""
        variance = self._graph.heading_variance(self._since, self._turned)
        return self._since <= 5 * self.cell and bool(variance <= self.config.place_heading**2)

    def _select(self) -> None:
        """Takes over the map with the closures selected meanwhile, and begins the next selection."""
        if not self.closes_loops:
            return
        if self.selection.finish(self._graph, self.log):
            self.merger.note_selection(self._graph)
            self._forget_solution()
        self.selection.begin(self._graph, self.log)
        self.merger.select(self._graph, self.log)

    def _judge(self) -> None:
        """Every `DOUBT_EVERY` keyframes, judges the present map. Without selections, sequences stand this."""
        graph = self._graph
        if self.closes_loops and graph.ever % DOUBT_EVERY == 0:
            self._doubt = worse_than_odometry(graph, MapSolution(graph.fit(), self.log, graph.cut))
            if not self.config.select_every:
                self.log.count_selection()
                self.merger.note_selection(graph)

    def _given(self) -> MapSolution:
        """The final map, or odometry without closures where that is doubted."""
        graph, found = self.keyframes(), self.solution()
        if not self.final_doubt() > DOUBTED:
            return found
        return self._by_odometry(found.without_closures(graph), graph)

    def _by_odometry(self, solution: MapSolution, graph: KeyframeGraph) -> MapSolution:
        """See `MapSolution.by_odometry`; graph: the keyframes of the solution."""
        return solution.by_odometry(graph, self._steps.odometry[self.keyframe_steps()[graph.taken.rows]])

    def _write_g2o(self, path: Path) -> None:
        """Of several pieces, the first keyframe of each is fixed: nothing else determines where it lies."""
        taken, fit = self._graph.taken.rows, self.kept_solution().fit
        pieces, first = np.unique(self.keyframe_pieces()[taken], return_index=True)
        write_g2o(path, fit.poses, self.edges(), fixed=first.tolist() if len(pieces) > 1 else ())

    def _write_calibration(self, path: Path) -> None:
        noise = self._graph.heading_noise if self.config.select_every else None
        write_calibration(path, self._graph.calibration(*self.kept_solution()), noise)

    def _forget_solution(self) -> None:
        self._solution = self._kept = self._worse = None

    def _optimise(self) -> None:
        self._graph.optimise(self.log)
        self._live.strayed = 0.0
        self._forget_solution()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._forget_solution()
