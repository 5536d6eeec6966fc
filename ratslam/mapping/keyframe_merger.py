"""Merging of keyframes during a session, and the selection on the unmerged keyframes that can undo it.

A merge takes for granted that its ground is right, and what the map solves for afterwards cannot show that
it was wrong, because merged keyframes move together. So each time the keyframes have doubled, all closure
sequences are selected anew on the unmerged keyframes, from the present map and from odometry; the result is
merged anew and replaces the map. It costs much more than a selection among the kept keyframes, so it stops
at `LARGEST` keyframes.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from ratslam.core.arrays import Checkpointed
from ratslam.mapping.closure_selection import MapHypotheses
from ratslam.mapping.experiences import Experiences
from ratslam.mapping.loop_closures import ClosureLog
from ratslam.mapping.map_state import Archive, MapState
from ratslam.mapping.merging import find_merge, merge_keyframes
from ratslam.mapping.selection_worker import DelayedJob, SelectedMap, SelectionWorker
from ratslam.recall.memory import MergedRows
from tactile.base.se2 import compose, fit_rigid_motion, inverse

PAIRS = 400
"""Number of confirmed pairs kept of merged keyframes."""
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
        self.kept, self.onto, self.offset = MergedRows.of_none(0)[:3]

    def select(self, state: MapState) -> UnmergedMap:
        """Selects, and decides what to merge."""
        found = self.selected.select(state)
        if found is not None:
            found.log.confirm(state.config.merge_stood)
            merge = find_merge(found, state.config.merge_newest)
            self.kept, self.onto, self.offset = (merge or MergedRows.of_none(state.count))[:3]
        return self

    def replace(self, state: MapState, archive: Archive) -> MergedRows:
        """Replaces the map by the archive with this result, not merged yet, continued by the map since.

        Returns:
            how to merge it.
        """
        selected, size, count = self.selected, len(self.onto), archive.state.count
        before, newer = state.unmerged_poses(), state.taken.rows >= size
        moved = compose(selected.poses[-1], inverse(before[size - 1]))
        poses = np.concatenate([selected.poses, compose(moved, before[size:])])
        cut = np.full(count, -1)
        cut[:size] = selected.cut.rows
        cut[state.taken.rows[newer]] = state.cut.rows[newer]
        whole = archive.state.log.copy()
        whole.follow(state.log)
        selected.judge(whole)
        whole.confirm(state.config.merge_stood)
        state.log.restore(whole.arrays())
        state.replace(archive.state, compose(fit_rigid_motion(poses, before), poses), cut)
        state.place_pieces()
        state.bias, state.turn_error = selected.calibration
        state.heading_noise = selected.noise
        rest = np.arange(size, count)
        number = np.arange(len(self.kept), len(self.kept) + len(rest))
        kept, onto = np.concatenate([self.kept, rest]), np.concatenate([self.onto, number])
        return MergedRows(kept, onto, np.concatenate([self.offset, np.zeros((len(rest), 3))]))


class _ArchiveSelection(Checkpointed):
    """The selection on the unmerged keyframes, begun each time they have doubled."""

    PARTS = ("job",)

    def __init__(self) -> None:
        self.job = DelayedJob(THREAD, lambda: UnmergedMap(SelectedMap(ClosureLog(), MapHypotheses())))


class KeyframeMerger(Checkpointed):
    """Merges keyframes after each closure selection.

    Attributes:
        archive_selection: on the unmerged keyframes. merge_due: a selection has changed the map since the
            last merge.
    """

    VALUES = ("merge_due",)
    PARTS = ("archive_selection",)

    def __init__(self) -> None:
        self.archive_selection = _ArchiveSelection()
        self.merge_due = False

    def select(self, state: MapState) -> None:
        """Begins a selection on the unmerged keyframes if it is due."""
        doublings, rest = divmod(state.total, FIRST)
        due = rest == 0 and FIRST <= state.total <= LARGEST and doublings & (doublings - 1) == 0
        archive = state.merged
        if due and archive and state.config.select_every:
            archive.follow(state)
            whole = archive.state.copy()
            unmerged = UnmergedMap(SelectedMap(whole.log, MapHypotheses()))
            due_at = whole.count + whole.count // DELAY
            self.archive_selection.job.begin(due_at, lambda: unmerged.select(whole))

    def merge(
        self, state: MapState, selection: SelectionWorker, experiences: Experiences
    ) -> MergedRows | None:
        """Merges keyframes of confirmed ground if that is due, or replaces the map by the one selected on
        the unmerged keyframes, merged anew; returns what the kernel needs to follow."""
        if selection.job.busy:
            return None
        unmerged = self.archive_selection.job.take(state.total)
        archive = state.archive
        if unmerged is not None and unmerged.selected.found and archive is not None:
            taken, row = state.taken.rows.copy(), archive.row.rows.copy()
            merge = unmerged.replace(state, archive)
            archive.row.replace(merge.onto)
            archive.offset.replace(merge.offset)
            selection.hypotheses = unmerged.selected.hypotheses
            _merge(merge, state, selection)
            state.optimise()
            views = state.appearance.stored(merge.source)
            source, onto = row[merge.source], merge.onto[taken]
            experiences.merge(source, onto, merge.offset[taken])
            return MergedRows(source, onto, merge.offset[taken], *views)
        if not self.merge_due or self.archive_selection.job.busy:
            return None
        self.merge_due = False
        found = self.merge_all(state, selection, state.config.merge_newest)
        if found is None:
            return None
        experiences.merge(*found[:3])
        view, label = state.appearance.stored(state.taken.rows)
        return found._replace(view=view, label=label)

    def merge_all(self, state: MapState, selection: SelectionWorker, newest: int) -> MergedRows | None:
        """Merges the keyframes of confirmed ground but the `newest`; None without any."""
        merge = find_merge(state, newest)
        if merge is not None and state.archive is not None:
            archive_merge(merge, state, state.archive)
            _merge(merge, state, selection)
        return merge


def archive_merge(merge: MergedRows, state: MapState, archive: Archive) -> None:
    """The archive follows a merge of keyframes of the map, which has not changed yet."""
    pairs = state.confirmed_pairs()[len(archive.pairs.rows) :]
    if not archive.begun:
        archive.begin(state)
    gone = np.isin(pairs[:, 0], state.taken.rows[~merge.is_kept()])
    archive.pairs.replace(np.concatenate([archive.pairs.rows, pairs[gone]])[-PAIRS:])
    row, offset = archive.row.rows, archive.offset.rows
    moved = ~merge.is_kept()[row]
    offset[moved] = compose(merge.offset[row[moved]], offset[moved])
    row[:] = merge.onto[row]


def _merge(merge: MergedRows, state: MapState, selection: SelectionWorker) -> None:
    state.log.merge(~merge.is_kept(), merge.onto, merge.turned())
    merge_keyframes(state, merge)
    selection.hypotheses.merge(merge)
