"""Merging of keyframes during a session, and the archive of all keyframes and candidates as they were taken.

A merge takes for granted that its ground is right, and what the map solves for afterwards cannot show that
it was wrong, because merged keyframes move together. So each time the keyframes have doubled, all closure
sequences are selected anew on the unmerged keyframes, from the present map and from odometry; the result is
merged anew and replaces the map. It costs much more than a selection among the kept keyframes, so it stops
at `LARGEST` keyframes.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.mapping.closure_selection import MapHypotheses
from ratslam.mapping.experiences import Experiences
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import CONFIRMED_WEIGHT, Candidate, ClosureLog
from ratslam.mapping.map_solution import MapSolution
from ratslam.mapping.merging import Merge, find_merge, merge_keyframes
from ratslam.mapping.selection_worker import DelayedJob, SelectedMap, SelectionWorker
from ratslam.recall.memory import MergedRows
from tactile.base.se2 import compose, fit_rigid_motion, inverse

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
        row: [E] the keyframe of the map that each is or is merged with. offset: [E, 3] its pose in the
            frame of that one, m, m, rad.
        pairs: [P, 3] confirmed pairs of which a keyframe was merged, the newest ones.
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
            self.graph.restore(graph.arrays())
            self.log = log.copy()
            self.row.replace(np.arange(graph.count))
            self.offset.replace(np.zeros((graph.count, 3)))
        pairs = _confirmed_pairs(graph, log)
        gone = np.isin(pairs[:, 0], graph.taken.rows[~merge.is_kept()])
        self.pairs.replace(np.concatenate([self.pairs.rows, pairs[gone]])[-PAIRS:])
        row, offset = self.row.rows, self.offset.rows
        moved = ~merge.is_kept()[row]
        offset[moved] = compose(merge.offset[row[moved]], offset[moved])
        row[:] = merge.onto[row]

    def confirmed_pairs(self, graph: KeyframeGraph, log: ClosureLog) -> np.ndarray:
        """[P, 3] keyframe, match, and 1 where they face opposite ways, of closures with a high posterior
        that the map has accepted; of merged keyframes the newest ones."""
        return np.concatenate([self.pairs.rows, _confirmed_pairs(graph, log)])

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


def _confirmed_pairs(graph: KeyframeGraph, log: ClosureLog) -> np.ndarray:
    """[P, 3] numbers of keyframe and match, among all ever taken, of accepted closures with a high
    posterior, and 1 where they face opposite ways."""
    table = log.table()[log.accepted_rows()]
    sure = (table[:, 3] > CONFIRMED_MASS) & (table[:, 8] > CONFIRMED_WEIGHT)
    frame, match, shift = table[sure, :3].astype(int).T
    reversed = np.cos(shift * graph.sector_angle) < 0
    return np.column_stack([graph.taken.rows[frame], graph.taken.rows[match], reversed])


FIRST, LARGEST = 1600, 6400
"""Numbers of keyframes at the first and the last selection of unmerged keyframes."""
DELAY = 8
"""Such a selection is taken up when there are a `DELAY`-th more keyframes."""
THREAD = ThreadPoolExecutor(1, "selection of unmerged keyframes")
"""Of all maps of the process."""


class UnmergedMap(Checkpointed):
    """The result of a selection on E unmerged keyframes, and how they are merged anew."""

    VALUES = ("kept", "onto", "offset")
    PARTS = ("selected",)

    def __init__(self, selected: SelectedMap) -> None:
        self.selected = selected
        self.kept, self.onto, self.offset = Merge.of_none(0)

    def select(self, graph: KeyframeGraph) -> UnmergedMap:
        """Selects, and decides what to merge; changes `graph`."""
        selected = self.selected.select(graph)
        if selected.found:
            graph.pose.rows[:] = selected.poses
            graph.bias, graph.turn_error = selected.calibration
            selected.log.confirm(graph.config.merge_stood)
            merge = find_merge(graph, selected.log, graph.config.merge_newest)
            self.kept, self.onto, self.offset = merge or Merge.of_none(graph.count)
        return self

    def replace(self, graph: KeyframeGraph, log: ClosureLog, archive: Archive) -> Merge:
        """Replaces the map by the archive with this result, not merged yet, continued by the map since.

        Returns:
            how to merge it.
        """
        selected, size, count = self.selected, len(self.onto), archive.graph.count
        before, newer = archive.poses(graph.pose.rows), graph.taken.rows >= size
        moved = compose(selected.poses[-1], inverse(before[size - 1]))
        poses = np.concatenate([selected.poses, compose(moved, before[size:])])
        cut = np.full(count, -1)
        cut[:size] = selected.cut.rows
        cut[graph.taken.rows[newer]] = graph.cut.rows[newer]
        whole = archive.log.copy()
        whole.follow(log)
        selected.judge(whole)
        whole.confirm(graph.config.merge_stood)
        log.restore(whole.arrays())
        graph.replace(archive.graph, compose(fit_rigid_motion(poses, before), poses), cut)
        graph.place_pieces(log)
        graph.bias, graph.turn_error = selected.calibration
        graph.heading_noise = selected.noise
        rest = np.arange(size, count)
        number = np.arange(len(self.kept), len(self.kept) + len(rest))
        kept, onto = np.concatenate([self.kept, rest]), np.concatenate([self.onto, number])
        return Merge(kept, onto, np.concatenate([self.offset, np.zeros((len(rest), 3))]))


class _ArchiveSelection(Checkpointed):
    """The selection on the unmerged keyframes, begun each time they have doubled."""

    PARTS = ("job",)

    def __init__(self) -> None:
        self.job = DelayedJob(THREAD, lambda: UnmergedMap(SelectedMap(ClosureLog(), MapHypotheses())))


class KeyframeMerger(Checkpointed):
    """Merges keyframes after each closure selection; `archive` keeps them.

    Attributes:
        archive_selection: on the unmerged keyframes. merge_due: a selection has changed the map since the
            last merge.
    """

    VALUES = ("merge_due",)
    PARTS = ("archive_selection",)

    def __init__(self, archive: Archive) -> None:
        self._archive = archive
        self.archive_selection = _ArchiveSelection()
        self.merge_due = False

    def select(self, graph: KeyframeGraph, log: ClosureLog) -> None:
        """Begins a selection on the unmerged keyframes if it is due."""
        doublings, rest = divmod(graph.total, FIRST)
        due = rest == 0 and FIRST <= graph.total <= LARGEST and doublings & (doublings - 1) == 0
        if due and self._archive.begun and graph.config.select_every:
            self._archive.follow(MapSolution(graph.fit(), log, graph.cut), graph)
            archive, count = self._archive, self._archive.graph.count
            unmerged = UnmergedMap(SelectedMap(archive.log.copy(), MapHypotheses()))
            work = partial(unmerged.select, archive.graph.copy())
            self.archive_selection.job.begin(count + count // DELAY, work)

    def merge(
        self, graph: KeyframeGraph, log: ClosureLog, selection: SelectionWorker, experiences: Experiences
    ) -> MergedRows | None:
        """Merges keyframes of confirmed ground if that is due, or replaces the map by the one selected on
        the unmerged keyframes, merged anew; returns what the kernel needs to follow."""
        if selection.job.busy:
            return None
        unmerged = self.archive_selection.job.take(graph.total)
        if unmerged is not None and unmerged.selected.found:
            archive = self._archive
            taken, row = graph.taken.rows.copy(), archive.row.rows.copy()
            merge = unmerged.replace(graph, log, archive)
            archive.row.replace(merge.onto)
            archive.offset.replace(merge.offset)
            selection.hypotheses = unmerged.selected.hypotheses
            _merge(merge, graph, log, selection)
            graph.optimise(log)
            source, onto = row[merge.kept], merge.onto[taken]
            experiences.merge(source, onto, merge.offset[taken])
            return MergedRows(source, *graph.appearance.stored(merge.kept), onto, merge.offset[taken])
        if not self.merge_due or self.archive_selection.job.busy:
            return None
        self.merge_due = False
        found = self.merge_all(graph, log, selection, graph.config.merge_newest)
        if found is None:
            return None
        experiences.merge(*found)
        return MergedRows(found.kept, *graph.appearance.stored(graph.taken.rows), found.onto, found.offset)

    def merge_all(
        self, graph: KeyframeGraph, log: ClosureLog, selection: SelectionWorker, newest: int
    ) -> Merge | None:
        """Merges the keyframes of confirmed ground but the `newest`; None without any."""
        merge = find_merge(graph, log, newest)
        if merge is not None:
            self._archive.merge(merge, graph, log)
            _merge(merge, graph, log, selection)
        return merge


def _merge(merge: Merge, graph: KeyframeGraph, log: ClosureLog, selection: SelectionWorker) -> None:
    log.merge(~merge.is_kept(), merge.onto, merge.turned())
    merge_keyframes(graph, merge)
    selection.hypotheses.merge(merge)
