"""The keyframe map: every remembered view is a keyframe; closures are verified, the poses optimised.

Recall proposes candidates. Consecutive candidates that agree with the odometry form a closure sequence; it
is accepted if it has enough evidence and lies where the covariance of the map allows (`acceptance`). An
accepted sequence keeps a robust weight, so that other closures can still outvote it. Only for a robot that
may be carried (`may_be_carried`) can a long sequence that contradicts the map show a break of the odometry:
the odometry is cut where the views indicate it, and the sequence joins the parts.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ratslam.core.arrays import Checkpointed
from ratslam.core.backend import NO_CLOSURE, Evidence, Map
from ratslam.core.estimates import Action, Estimate
from ratslam.mapping.acceptance import Acceptance, FindTie, tie_newest_piece
from ratslam.mapping.appearance import Appearance
from ratslam.mapping.carried_solution import is_retraced, kept_part, retraced_solution
from ratslam.mapping.closure_judge import doubt_of_closures
from ratslam.mapping.config import FULL, Ablation, KeyframeMapConfig
from ratslam.mapping.experiences import Experiences
from ratslam.mapping.ground import LearnedOdds
from ratslam.mapping.keyframe_merger import KeyframeMerger
from ratslam.mapping.live_filter import LiveFilter
from ratslam.mapping.loop_closures import Candidate, Verdict, write_closures
from ratslam.mapping.map_solution import DOUBTED, selected_solution, undo, worse_than_odometry
from ratslam.mapping.map_state import MOST_SOLVED, MapState
from ratslam.mapping.odometry_calibration import calibration_from_views, write_calibration
from ratslam.mapping.pose_graph import Edges, write_g2o, write_json
from ratslam.mapping.selection_worker import SelectionWorker
from ratslam.mapping.step_record import NO_TRAVEL, leading_to
from ratslam.mapping.verification import continues_sequence, has_same_heading
from ratslam.recall.memory import MapFeedback, MergedRows
from tactile.base.types import Observation

if TYPE_CHECKING:
    import networkx

DOUBT_EVERY = 50
"""Keyframes between two judgements of the present map."""


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
        state: of the keyframes that are not merged. appearance: of all keyframes ever taken.
        travel: the motion since the newest keyframe.
        merger, selection: merge keyframes and select closures beside the session.
    """

    VALUES = ("travel", "_since", "_turned", "_begins", "_solved", "_doubt")
    PARTS = (
        "state", "merger", "_experiences", "appearance", "_acceptance", "_live", "selection", "_tie_odds",
    )  # fmt: skip
    FLAT = ("state",)

    def __init__(
        self,
        config: KeyframeMapConfig,
        cell: float,
        appearance: Appearance,
        acceptance: Callable[[MapState], Acceptance],
        *,
        guard: int = 20,
        closures: bool = True,
        ablation: Ablation = FULL,
        find_tie: FindTie | None = None,
    ) -> None:
        self.config, self.cell, self.closes_loops = config, cell, closures
        self.appearance = appearance
        self.state = MapState(config, cell, appearance, guard, ablation)
        self.merger, self.selection = KeyframeMerger(), SelectionWorker()
        self._acceptance, self._find_tie = acceptance(self.state), find_tie
        self._experiences = Experiences(config.place_radius * cell, config.place_heading)
        self._live, self._tie_odds = LiveFilter(), LearnedOdds()
        self.travel = NO_TRAVEL
        self._since, self._turned = 0.0, 0.0  # distance (m) and turns (rad) since the last closure
        self._begins = False  # the next keyframe begins a piece
        self._solved = (-1, -1)  # sequence and number of the keyframe of the last optimisation
        self._solution: MapState | None = None
        self._kept: MapState | None = None  # the same without merged keyframes
        self._worse: float | None = None  # of that solution
        self._doubt = np.nan  # of the map some keyframes ago

    def feedback(self) -> MapFeedback:
        """The poses, heading bias and view metric for the view cells."""
        state, metric = self.state, self.appearance.metric()
        start = state.next_start() if self._begins else None
        return MapFeedback(state.pose.rows, state.bias, state.turn_error, self._since, *metric, start)

    def pose(self, estimate: Estimate) -> np.ndarray:
        """[3] the newest keyframe's pose and the motion since; by odometry until a closure is accepted, as
        a bias that only views show may be wrong."""
        del estimate
        state, (motion, length, _) = self.state, self.travel
        confirmed = (state.log.verdicts() == Verdict.ACCEPTED).any()
        if confirmed:
            return state.pose_after(motion, length)
        reckoned = state.steps.odometry[-1:]
        if len(reckoned) and np.isfinite(reckoned).all() and not (self._begins or state.begins.rows.any()):
            return reckoned[0].copy()
        return state.reckoned_after(motion, length)

    def trajectory(self) -> np.ndarray:
        """[T, 3] every step in the final map, or by odometry where that is likely the better estimate."""
        given = self._given()
        return given.steps.poses(given.fit(), given.open_parts())

    def map_trajectory(self) -> np.ndarray:
        """[T, 3] every step in the final map."""
        found = self.solution()
        return found.steps.poses(found.fit(), found.open_parts())

    def unjudged(self) -> str:
        if len(self.solution().log.accepted_rows()):
            return ""
        start = self.state.start
        return NO_CLOSURE + ", as calibrated by the configuration" * bool(start.bias or start.turn_error)

    def doubt(self) -> float:
        return self._doubt

    def final_doubt(self) -> float:
        if self._worse is None:
            found = self.solution()
            if found.count > MOST_SOLVED:  # merged keyframes, which are not solved for, say nothing new
                found = self.kept_solution()
            self._worse = float(np.fmax(worse_than_odometry(found), doubt_of_closures(found)))
        return self._worse

    def online_trajectory(self) -> np.ndarray:
        """[T, 3] every step in the online map, before the final optimisation."""
        present, archive = self.state.by_odometry(), self.state.merged
        open_ = present.open_parts()
        open_ = open_[archive.row.rows] if archive else open_
        return present.steps.poses(present.fit()._replace(poses=present.unmerged_poses()), open_)

    def closures(self) -> np.ndarray:
        """[M, 2] steps of the keyframes joined by accepted loop closures; none where odometry is given."""
        return self.keyframe_steps()[self._given().log.accepted_pairs()]

    def judged_closures(self) -> np.ndarray:
        """[n, 3] see `Map`; candidates of merged keyframes are left out."""
        judged, step = self.state.log.judged(), self.keyframe_steps()[self.state.taken.rows]
        return np.column_stack([step[judged[:, :2]], judged[:, 2]])

    def pieces(self) -> np.ndarray:
        """[T] the piece of each step, see `ratslam.mapping.pieces`."""
        return self.state.steps.of_keyframes(self.keyframe_pieces())

    def keyframe_pieces(self) -> np.ndarray:
        """[N] the piece of each keyframe; those of odometry where that is given."""
        return self._given().parts()

    def candidates(self) -> np.ndarray:
        """[n, 10] all candidates, of recall and then along a retraced map, see `ClosureLog.table`; open
        where odometry is given."""
        return self._given().log.table()

    def covariance(self) -> np.ndarray:
        """[3, 3] covariance of the newest keyframe's pose in the frame of its piece's first (m, m, rad)."""
        return self.state.newest_covariance()

    def solution(self) -> MapState:
        """The final map of all keyframes, as it would be if the session ended now."""
        if self._solution is None:
            kept = self.kept_solution()
            self._solution = (self._solution or kept.unmerged_solution()).by_odometry()
        return self._solution

    def kept_solution(self) -> MapState:
        """The final map of the keyframes that are not merged."""
        if self._kept is None:
            state, kept = self.state, None
            if not self.closes_loops:
                kept = state.solved()
            elif self.config.select_every:
                kept = selected_solution(state, deepcopy(self.selection.hypotheses))
            kept = kept or self._acceptance.solution(state)
            kept.place_pieces()
            if self.closes_loops and is_retraced(state.unmerged):
                self._solution = retraced_solution(kept.unmerged_solution())
                kept = kept_part(self._solution, kept)
            self._kept = kept.by_odometry()
        return self._kept

    def graph(self) -> networkx.DiGraph:
        """See `Experiences.graph`."""
        taken = self.state.taken.rows
        return self._experiences.graph(self._given().pose.rows[taken], taken, self.keyframe_pieces()[taken])

    def edges(self) -> Edges:
        """Pose graph of the keyframes that are not merged: odometry without its bias, and closures with
        their robust weights."""
        return self.kept_solution().edges()

    def files(self) -> dict[str, Callable[[Path], None]]:
        """Functions that write files, by name: experiences as node-link JSON, keyframes as a g2o graph, the
        closures with their evidence, and, where the map is not doubted, the calibration of the odometry."""
        kept = self.kept_solution()
        # Of several pieces, the first keyframe of each is fixed: nothing else determines where it lies.
        pieces, first = np.unique(self.keyframe_pieces()[kept.taken.rows], return_index=True)
        fixed = first.tolist() if len(pieces) > 1 else ()
        noise = kept.heading_noise if self.config.select_every else None
        calibration: dict[str, Callable[[Path], None]] = {
            "calibration.yaml": lambda path: write_calibration(path, kept.calibration(), noise)
        }
        return (calibration if self.final_doubt() <= DOUBTED else {}) | {
            "map.json": lambda path: write_json(path, self.graph()),
            "map.g2o": lambda path: write_g2o(path, kept.pose.rows, kept.edges(), fixed=fixed),
            "closures.csv": lambda path: write_closures(path, self.candidates(), self.keyframe_steps()),
        }

    def keyframe_steps(self) -> np.ndarray:
        """[N] the step at which each keyframe was taken."""
        return self.state.steps.first_steps(self.state.total)

    def begin_piece(self) -> None:
        """The next keyframe begins a piece; steps until then lead to it."""
        self.state.steps.settle(self.state.total)
        self._begins = self.state.count > 0
        self.travel = NO_TRAVEL
        self._since = self._turned = 0.0

    def merge(self) -> MergedRows | None:
        """Merges keyframes of known ground (`ratslam.mapping.merging`)."""
        merged = self.merger.merge(self.state, self.selection, self._experiences)
        if merged is not None:
            self._forget_solution()
        return merged

    def update(self, observation: Observation, estimate: Estimate, evidence: Evidence) -> Estimate:
        """Moves by the odometry; a view that became a keyframe is added, judged and given an experience."""
        state, self.travel = self.state, self.travel.onwards(observation.odometry)
        place = previous = self._experiences.current
        action = Action.NONE
        if int(evidence.keyframe) >= 0:
            self._append(observation)
            shown = self.appearance.learn(evidence, state.confirmed_pairs)
            _, standard_error = shown
            if self.closes_loops and np.isfinite(standard_error) and self.config.bias_from_views:
                prior = calibration_from_views(self.config, self.cell, state.start, shown)
                self._acceptance.learn_bias(state, prior)
            matched = self._judge_candidate(evidence)
            if self.closes_loops:
                self._maintain()
            # The pose may find a known experience while the drift since the last closure is small.
            drift = state.heading_variance(self._since, self._turned)
            reliable = self._since <= 5 * self.cell and bool(drift <= self.config.place_heading**2)
            poses, begins = state.pose.rows, bool(state.begins.rows[-1])
            place, previous, action = self._experiences.arrive(
                poses, len(poses) - 1, matched, reliable, begins
            )
        count = state.total
        moved = np.array(observation.odometry[:3], float)
        moved = state.calibrated(moved, float(np.hypot(*moved[:2])))
        frame = leading_to(count) if self._begins or not count else count - 1
        state.steps.append(frame, self.travel, moved if np.isfinite(moved).all() else np.zeros(3))
        self._forget_solution()
        return estimate._replace(place=place, previous=previous, action=action)

    def undo(self, sequence: int) -> None:
        """Removes the closures of a sequence and optimises without them.

        Raises:
            ValueError: it has an `Obstacle`.
        """
        undo(self.solution(), sequence, self.state.log)
        self._optimise()

    def _append(self, observation: Observation) -> None:
        state, (motion, length, turn) = self.state, self.travel
        if self._begins or not state.count:
            state.steps.arrive(state.total, self.travel)
        if self._begins:
            state.begin_piece()
            motion, length, turn = NO_TRAVEL
        else:
            state.append(state.pose_after(motion, length), motion, length, turn)
        self._live.advance(state)
        self._since, self._turned = self._since + length, self._turned + turn
        self.travel, self._begins = NO_TRAVEL, False
        self.appearance.append(observation, motion[2], length)

    def _judge_candidate(self, evidence: Evidence) -> int:
        """Logs and judges a candidate; returns the keyframe that it confirms as the present place, or
        -1."""
        if int(evidence.match) < 0 or float(evidence.posterior) <= self.config.candidate_posterior:
            return -1
        state, log, config = self.state, self.state.log, self.config
        found = int(evidence.match), int(evidence.shift), float(evidence.posterior), float(evidence.log_ratio)
        candidate = Candidate(state.count - 1, *found)
        sequence = state.add(candidate, continues_sequence(state, candidate))
        changed = self.closes_loops and self._acceptance.judge(state, sequence, candidate)
        due = False  # whether the map is optimised for one more member of an accepted sequence
        if log.verdict(sequence) == Verdict.ACCEPTED:
            weight = log.sequence_weights()[sequence]
            state.pose.rows[-1] = self._live.correct(state, candidate, weight)
            strayed = not config.select_every and self._live.strayed > config.solve_strayed
            long_ago = state.total - self._solved[1] >= config.solve_every
            due = sequence != self._solved[0] or long_ago or strayed
        if changed or due:
            self._solved = sequence, state.total
            self._optimise()
            if changed and self._acceptance.review(state):
                self._optimise()
        if log.verdict(sequence) != Verdict.ACCEPTED:
            return -1
        self._since = self._turned = 0.0
        return candidate.match if has_same_heading(state, candidate) else -1

    def _maintain(self) -> None:
        """Takes up a finished selection and begins the next, ties the newest piece, judges the map."""
        state = self.state
        if self.selection.finish(state):
            self.merger.merge_due = self.config.merge_stood > 0
            self._forget_solution()
        self.selection.begin(state)
        self.merger.select(state)
        if self._find_tie and tie_newest_piece(state, self._find_tie, self._tie_odds):
            self._optimise()
        if state.total % DOUBT_EVERY == 0:
            self._doubt = worse_than_odometry(state)
            if not self.config.select_every:  # sequences are then confirmed by each judgement instead
                state.log.count_selection()
                self.merger.merge_due = self.config.merge_stood > 0

    def _given(self) -> MapState:
        """The final map, or odometry without closures where that is doubted."""
        found = self.solution()
        return found.without_closures().by_odometry() if self.final_doubt() > DOUBTED else found

    def _forget_solution(self) -> None:
        self._solution = self._kept = self._worse = None

    def _optimise(self) -> None:
        self.state.optimise()
        self._live.strayed = 0.0
        self._forget_solution()

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._forget_solution()
