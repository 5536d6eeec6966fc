"""Closure selection on the unmerged keyframes.

A merge takes for granted that its ground is right, and what the map solves for afterwards cannot show that it
was wrong, because merged keyframes move together. So each time the keyframes have doubled, all closure
sequences are selected anew on the unmerged keyframes, from the present map and from odometry; the result is
merged anew and replaces the map. It costs much more than a selection among the kept keyframes, so it stops at
`LARGEST` keyframes."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.mapping.archive import Archive
from ratslam.mapping.delayed_job import DelayedJob
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import ClosureLog
from ratslam.mapping.map_hypotheses import MapHypotheses
from ratslam.mapping.merging import Merge, find_merge, no_merge
from ratslam.mapping.selection_worker import SelectedMap
from tactile.base.se2 import compose, fit_rigid_motion, inverse

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
        self.kept, self.onto, self.offset = no_merge(0)

    def select(self, graph: KeyframeGraph) -> UnmergedMap:
        """Selects, and decides what to merge; changes `graph`."""
        selected = self.selected.select(graph)
        if selected.found:
            graph.pose.rows[:] = selected.poses
            graph.bias, graph.turn_error = selected.calibration
            selected.log.confirm(graph.config.merge_stood)
            merge = find_merge(graph, selected.log, graph.config.merge_newest)
            self.kept, self.onto, self.offset = merge or no_merge(graph.count)
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
        whole = archive.unmerged_log(log)
        selected.judge(whole)
        whole.confirm(graph.config.merge_stood)
        log.restore(whole.arrays())
        graph.replace(archive.graph, compose(fit_rigid_motion(poses, before), poses), cut)
        graph.place_pieces(log)
        graph.bias, graph.turn_error = selected.calibration
        graph.heading_noise = selected.noise
        rest = np.arange(size, count)
        number = np.arange(len(self.kept), len(self.kept) + len(rest))
        return Merge(
            np.concatenate([self.kept, rest]),
            np.concatenate([self.onto, number]),
            np.concatenate([self.offset, np.zeros((len(rest), 3))]),
        )


class ArchiveSelection(Checkpointed):
    """Selects on the unmerged keyframes each time they have doubled."""

    PARTS = ("_job",)

    def __init__(self) -> None:
        self._job = DelayedJob(THREAD, lambda: UnmergedMap(SelectedMap(ClosureLog(), MapHypotheses())))

    @property
    def busy(self) -> bool:
        """Whether a selection is in progress."""
        return self._job.busy

    def begin(self, archive: Archive) -> None:
        """Begins a selection if it is due; poses and verdicts of the archive are those of the present map."""
        count = archive.graph.count
        unmerged = UnmergedMap(SelectedMap(archive.log.copy(), MapHypotheses()))
        self._job.begin(count + count // DELAY, partial(unmerged.select, archive.graph.copy()))

    def take(self, count: int) -> UnmergedMap | None:
        """The result when it is due at `count` keyframes; None if it found no map."""
        unmerged = self._job.take(count)
        return unmerged if unmerged is not None and unmerged.selected.found else None


def is_due(count: int) -> bool:
    """Whether unmerged keyframes are selected on at this number of them."""
    doublings, rest = divmod(count, FIRST)
    return rest == 0 and FIRST <= count <= LARGEST and doublings & (doublings - 1) == 0
