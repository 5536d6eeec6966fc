"""All keyframes and closure candidates of a map whose keyframes are merged, as they were taken."""

from __future__ import annotations

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.core.growable_array import GrowableArray
from ratslam.mapping.appearance import ConfirmedPairs
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import CONFIRMED_WEIGHT, Candidate, ClosureLog
from ratslam.mapping.map_solution import MapSolution
from ratslam.mapping.merging import Merge
from tactile.base.se2 import compose

CONFIRMED_MASS = 0.95
"""Least posterior mass of a closure for the likelihoods to learn from it."""
MOST_SOLVED = 4000
"""Largest number of keyframes, merged ones included, whose poses are solved for in the final map."""
PAIRS = 400
"""Number of confirmed pairs kept of merged keyframes."""


class Archive(Checkpointed):
    """The unmerged map; empty before the first merge.

    Attributes:
        graph: its keyframes, [E]. log: its candidates. Poses and verdicts are those of the last `follow`.
        row: [E] the keyframe of the map that each is or is merged with. offset: [E, 3] its pose in the frame
            of that one, m, m, rad.
        pairs: [P, 3] confirmed pairs of which a keyframe was merged, the newest (see `confirmed_pairs`).
    """

    PARTS = ("graph", "log")

    def __init__(self, graph: KeyframeGraph) -> None:
        self.graph, self.log = graph, ClosureLog()
        self.row = GrowableArray((), np.int64)
        self.offset = GrowableArray((3,), np.float64)
        self.pairs = GrowableArray((3,), np.int64)

    @property
    def begun(self) -> bool:
        """Whether keyframes were merged."""
        return len(self.row.rows) > 0

    def append(self, graph: KeyframeGraph) -> None:
        """Takes over the newest keyframe of the map."""
        if self.begun:
            self.graph.append_newest(graph)
            self.row.append(graph.count - 1)
            self.offset.append(np.zeros(3))

    def add(self, candidate: Candidate, follows: bool, graph: KeyframeGraph) -> None:
        """Takes over a candidate of the map."""
        if self.begun:
            frame, match = graph.taken.rows[[candidate.keyframe, candidate.match]].tolist()
            self.log.add(candidate._replace(keyframe=frame, match=match), follows)

    def merge(self, merge: Merge, graph: KeyframeGraph, log: ClosureLog) -> None:
        """Follows a merge of keyframes of the map, which has not changed yet."""
        if not self.begun:
            self._begin(graph, log)
        pairs = confirmed_pairs(graph, log)
        gone = np.isin(pairs[:, 0], graph.taken.rows[~merge.is_kept()])
        self.pairs.replace(np.concatenate([self.pairs.rows, pairs[gone]])[-PAIRS:])
        row, offset = self.row.rows, self.offset.rows
        moved = ~merge.is_kept()[row]
        offset[moved] = compose(merge.offset[row[moved]], offset[moved])
        row[:] = merge.onto[row]

    def unmerged_log(self, log: ClosureLog) -> ClosureLog:
        """A log of all candidates with the verdicts of the map's."""
        whole = self.log.copy()
        whole.follow(log)
        return whole

    def confirmed_pairs(self, graph: KeyframeGraph, log: ClosureLog) -> ConfirmedPairs:
        """Closures with a high posterior that the map has accepted, of merged keyframes the newest."""
        pairs = np.concatenate([self.pairs.rows, confirmed_pairs(graph, log)])
        return ConfirmedPairs(pairs[:, 0], pairs[:, 1], pairs[:, 2] > 0)

    def poses(self, poses: np.ndarray) -> np.ndarray:
        """[E, 3] poses of all keyframes by those of the map's keyframes [N, 3]; the same before any merge."""
        return compose(poses[self.row.rows], self.offset.rows) if self.begun else poses

    def follow(self, solution: MapSolution, graph: KeyframeGraph) -> MapSolution:
        """A solution of the map as one of all keyframes, which the archive takes over."""
        poses, cut = self.poses(solution.fit.poses), GrowableArray((), np.int64)
        self.graph.pose.rows[:] = poses
        self.graph.bias, self.graph.turn_error = solution.fit.bias, solution.fit.turn_error
        self.graph.prior, self.graph.heading_noise = graph.prior, graph.heading_noise
        self.log.follow(solution.log)
        cut.replace(np.full(len(poses), -1))
        cut.rows[graph.taken.rows] = solution.cut.rows
        self.graph.cut = cut
        return MapSolution(solution.fit._replace(poses=poses), self.log, cut)

    def solve(self, solution: MapSolution, graph: KeyframeGraph) -> MapSolution:
        """A solution of the map as one of all keyframes, solved for if these are not too many; the same
        before any merge."""
        if not self.begun:
            return solution
        fit, _, cut = self.follow(solution, graph)
        log = self.log.copy()
        if self.graph.count <= MOST_SOLVED:
            fit = self.graph.solve(log, self.graph.config.settling)
            log.weigh(fit.weights)
        return MapSolution(fit, log, cut).placed(self.graph)

    def _begin(self, graph: KeyframeGraph, log: ClosureLog) -> None:
        self.graph.restore(graph.arrays())
        self.log = log.copy()
        self.row.replace(np.arange(graph.count))
        self.offset.replace(np.zeros((graph.count, 3)))


def confirmed_pairs(graph: KeyframeGraph, log: ClosureLog) -> np.ndarray:
    """[P, 3] numbers of keyframe and match, among all ever taken, of accepted closures with a high posterior,
    and 1 where they face opposite ways."""
    table = log.table()[log.accepted_rows()]
    sure = (table[:, 3] > CONFIRMED_MASS) & (table[:, 8] > CONFIRMED_WEIGHT)
    frame, match, shift = table[sure, :3].astype(int).T
    reversed = np.cos(shift * graph.sector_angle) < 0
    return np.column_stack([graph.taken.rows[frame], graph.taken.rows[match], reversed])
