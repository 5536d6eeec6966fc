"""Merges on ground that was wrong: a corridor is merged with one that looks the same, until the selection on
the unmerged keyframes undoes it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ratslam.mapping import keyframe_merger, map_state
from ratslam.mapping.loop_closures import Verdict
from tests.ratslam.mapping.map_cases import CELL
from tests.ratslam.mapping.merging_cases import CORRIDOR, NORTH, SOUTH, Drive, corridors, off

ROUTE = corridors(3)
LAP = 168
MERGED = {"select_every": 20, "merge_stood": 1, "merge_newest": 40}
LAST = 440
BEGUN = 2 * LAP
"""Keyframes at the selection on the unmerged keyframes; it is taken up an eighth later."""
NEVER = 10**6
PLACES = np.arange(CORRIDOR)


@cache
def driven(first, merge_stood=1):
    """The drive with the first selection of unmerged keyframes at this number."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keyframe_merger, "FIRST", first)
        return Drive(ROUTE, **MERGED | {"merge_stood": merge_stood}).go(LAST)


def gap(path):
    """Mean distance between the corridors of the first lap in a trajectory, m."""
    return float(np.hypot(*(path[SOUTH + PLACES] - path[NORTH + PLACES])[:, :2].T).mean())


def false_closures(drive):
    """Number of accepted closures between the corridors."""
    later, earlier = ROUTE.place[drive.map.closures()].T
    return int(((later >= SOUTH) & (later < SOUTH + CORRIDOR) & (earlier < NORTH + CORRIDOR)).sum())


def test_merged_ground_stays_wrong_by_itself_and_without_merges_later_laps_refute_it(monkeypatch):
    assert gap(ROUTE.truth) > 2.5 * CELL
    begun = Drive(ROUTE, **MERGED | {"merge_stood": 0}).go(LAP)
    assert begun.map.candidates()[0, 7] == Verdict.ACCEPTED
    assert gap(begun.map.map_trajectory()) < CELL
    unmerged = driven(NEVER, merge_stood=0)
    assert false_closures(unmerged) == 0
    assert gap(unmerged.map.online_trajectory()) > 2 * CELL
    drive = driven(NEVER)
    second = drive.map.state.archive.row.rows[SOUTH + PLACES]
    assert (ROUTE.place[drive.rows[second]] < NORTH + CORRIDOR).all()  # merged with the first corridor
    assert false_closures(drive) > 0
    assert gap(drive.map.online_trajectory()) < CELL
    # A larger map is not solved with all keyframes.
    monkeypatch.setattr(map_state, "MOST_SOLVED", LAST - 1)
    assert gap(drive.restored().map.map_trajectory()) < CELL


def test_the_selection_on_the_unmerged_keyframes_restores_them_and_merges_anew(monkeypatch):
    drive = driven(BEGUN)
    second = drive.map.state.archive.row.rows[SOUTH + PLACES]
    assert (np.abs(ROUTE.place[drive.rows[second]] - SOUTH - PLACES) <= 2).all()
    assert false_closures(drive) == 0
    assert gap(drive.map.online_trajectory()) > 2 * CELL
    assert len(drive.rows) < LAST - LAP // 2
    assert drive.merged_apart().max() < 1.5 * CELL
    assert drive.experience_apart().max() < (drive.map.config.place_radius + 2) * CELL
    assert drive.error().mean() < 1.2 * driven(NEVER, merge_stood=0).error().mean() + 0.02 * CELL
    monkeypatch.setattr(map_state, "MOST_SOLVED", LAST - 1)
    assert gap(drive.restored().map.map_trajectory()) > 2 * CELL


def test_the_map_is_right_as_soon_as_it_is_restored(monkeypatch):
    monkeypatch.setattr(keyframe_merger, "FIRST", BEGUN)
    drive = Drive(ROUTE, **MERGED).go(BEGUN)
    assert drive.map.merger.archive_selection.job.busy
    while drive.map.merger.archive_selection.job.busy:
        assert drive.map.state.log.verdict(0) == Verdict.ACCEPTED
        assert gap(drive.map.online_trajectory()) < CELL
        rows = len(drive.rows)
        drive.go(drive.steps + 1)
        # Nothing is merged meanwhile.
        assert len(drive.rows) == rows + 1 or not drive.map.merger.archive_selection.job.busy
    assert drive.map.state.log.verdict(0) == Verdict.OPEN
    assert gap(drive.map.online_trajectory()) > 2 * CELL
    assert len(drive.map.online_trajectory()) == drive.steps
    for poses in drive.map.selection.hypotheses.poses:
        assert len(poses) <= len(drive.rows)
        assert off(poses, ROUTE.truth[drive.rows[: len(poses)]]).max() < 2 * CELL
