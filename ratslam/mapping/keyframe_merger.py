"""Merging of keyframes during a session, with an archive that undoes merges on ground that was wrong."""

from __future__ import annotations

from ratslam.core.checkpoint import Checkpointed
from ratslam.mapping.archive import Archive
from ratslam.mapping.archive_selection import ArchiveSelection, UnmergedMap, is_due
from ratslam.mapping.experiences import Experiences
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import ClosureLog
from ratslam.mapping.map_solution import MapSolution
from ratslam.mapping.merged_odometry import merge_keyframes
from ratslam.mapping.merging import Merge, find_merge
from ratslam.mapping.selection_worker import SelectionWorker
from ratslam.recall.memory import MergedRows


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
        self.archive_selection = ArchiveSelection()
        self.merge_due = False

    def note_selection(self, graph: KeyframeGraph) -> None:
        """Takes note that a selection has changed the map; a merge is due."""
        self.merge_due = graph.config.merge_stood > 0

    def select(self, graph: KeyframeGraph, log: ClosureLog) -> None:
        """Begins a selection on the unmerged keyframes if it is due."""
        if self._archive.begun and graph.config.select_every and is_due(graph.ever):
            self._archive.follow(MapSolution(graph.fit(), log, graph.cut), graph)
            self.archive_selection.begin(self._archive)

    def merge(
        self, graph: KeyframeGraph, log: ClosureLog, selection: SelectionWorker, experiences: Experiences
    ) -> MergedRows | None:
        """Merges keyframes of confirmed ground if that is due, or replaces the map by the one selected on the
        unmerged keyframes, merged anew; returns what the kernel needs to follow."""
        if selection.busy:
            return None
        unmerged = self.archive_selection.take(graph.ever)
        if unmerged is not None:
            return self._replace(unmerged, graph, log, selection, experiences)
        if not self.merge_due or self.archive_selection.busy:
            return None
        self.merge_due = False
        merge = self.merge_all(graph, log, selection, graph.config.merge_newest)
        if merge is None:
            return None
        experiences.merge(merge.kept, merge.onto, merge.offset)
        views = graph.appearance.stored(graph.taken.rows)
        return MergedRows(merge.kept, *views, merge.onto, merge.offset)

    def merge_all(
        self, graph: KeyframeGraph, log: ClosureLog, selection: SelectionWorker, newest: int
    ) -> Merge | None:
        """Merges the keyframes of confirmed ground but the `newest`; None without any."""
        merge = find_merge(graph, log, newest)
        if merge is not None:
            self._archive.merge(merge, graph, log)
            _merge(merge, graph, log, selection)
        return merge

    def _replace(
        self,
        unmerged: UnmergedMap,
        graph: KeyframeGraph,
        log: ClosureLog,
        selection: SelectionWorker,
        experiences: Experiences,
    ) -> MergedRows:
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


def _merge(merge: Merge, graph: KeyframeGraph, log: ClosureLog, selection: SelectionWorker) -> None:
    log.merge(~merge.is_kept(), merge.onto, merge.turned())
    merge_keyframes(graph, merge)
    selection.hypotheses.merge(merge)
