"""Maps whose keyframes are merged while a robot drives a circle again and again."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ratslam.mapping import keyframe_merger
from ratslam.mapping.acceptance import AcceptByOdds
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map_solution import Obstacle, obstacle
from ratslam.mapping.merging import NEAR
from ratslam.mapping.odometry_scan import OdometryScan
from ratslam.mapping.optimizer import MapCovariance
from ratslam.mapping.verification import judge_by_map
from tactile.base.se2 import between, fit_rigid_motion
from tests.ratslam.mapping.map_cases import CELL, with_log
from tests.ratslam.mapping.map_cases import same as same_map
from tests.ratslam.mapping.merging_cases import CHUNK, GUARD, Drive, circles

LAP = 80
ROUTE = circles(6, size=LAP)
MERGED = {"select_every": 30, "merge_stood": 2, "merge_newest": 60}


def same(one, other):
    return np.array_equal(one.rows, other.rows) and same_map(one.map, other.map)


@cache
def driven(laps=5, merge_stood=MERGED["merge_stood"]):
    """Read only."""
    return Drive(ROUTE, **MERGED | {"merge_stood": merge_stood}).go(laps * LAP)


def test_the_number_of_keyframes_follows_the_ground():
    drive, counts = Drive(ROUTE, **MERGED), []
    for lap in range(1, 7):
        drive.go(lap * LAP)
        assert len(drive.rows) == len(drive.map.feedback().poses)
        counts.append(len(drive.rows))
    assert counts[0] == LAP
    newest = MERGED["merge_newest"] + MERGED["select_every"] + CHUNK
    assert max(counts) <= LAP + newest + 20
    assert counts[5] <= counts[3] + 10
    assert drive.map.state.unmerged.count == 6 * LAP


def test_the_map_is_as_good_as_without_merges():
    drive, whole = driven(), driven(merge_stood=0)
    assert np.array_equal(drive.rows, drive.map.state.taken.rows)
    assert drive.merged_apart().max() < 1.5 * CELL
    merged, unmerged = drive.error(), whole.error()
    assert len(whole.rows) == len(merged) == len(unmerged) == 5 * LAP
    assert unmerged.mean() < 0.2 * CELL
    assert merged.mean() < 1.2 * unmerged.mean() + 0.01 * CELL
    assert merged.max() < 1.2 * unmerged.max() + 0.05 * CELL
    online, final = drive.map.online_trajectory(), drive.map.map_trajectory()
    assert len(online) == 5 * LAP
    assert np.hypot(*(online - final)[:, :2].T).max() < 0.5 * CELL
    # Experiences are those of the first lap.
    assert max(drive.experiences) <= max(whole.experiences) + 2
    assert drive.experience_apart().max() < drive.map.config.place_radius * CELL
    assert (np.array(drive.experiences[:LAP]) == drive.experiences[-LAP:]).mean() > 0.9


def test_queries_speak_of_all_keyframes(tmp_path):
    drive = driven()
    whole, steps, map = driven(merge_stood=0).map, 5 * LAP, drive.map
    assert map.keyframe_steps().tolist() == list(range(steps))
    assert map.pieces().tolist() == [0] * steps
    assert len(map.trajectory()) == steps
    candidates = map.candidates()
    assert np.array_equal(candidates[:, 0], whole.candidates()[:, 0])
    assert np.allclose(candidates[:, 4], 4.0)
    assert map.state.unmerged.count == steps
    assert map.state.unmerged.least_misfit(steps - 1, np.array([steps - 1 - LAP]), np.array([False])) == 0.0
    later, earlier = map.closures().T
    accepted = candidates[:, 7] == Verdict.ACCEPTED
    assert later.tolist() == candidates[accepted, 0].astype(int).tolist()
    assert set(later) > set(range(2 * LAP, 2 * LAP + 15))  # keyframes that are merged
    assert np.abs(ROUTE.place[later] - ROUTE.place[earlier]).max() <= 1

    graph = map.graph()
    frames = [graph.nodes[place]["keyframe"] for place in graph]
    path = map.trajectory()
    for place, frame in zip(graph, frames, strict=True):
        node = graph.nodes[place]
        assert np.allclose([node["x"], node["y"], node["heading"]], path[frame])
    for name, write in map.files().items():
        write(tmp_path / name)
    lines = (tmp_path / "closures.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + len(candidates)
    assert (tmp_path / "map.g2o").read_text(encoding="utf-8").count("VERTEX") == len(drive.rows)


def test_a_sequence_can_be_undone_unless_it_is_merged():
    drive = driven().restored()
    log, last = drive.map.state.log, drive.map.state.log.sequences - 2
    merged = [k for k in range(log.sequences) if log.has_merged(k)]
    assert merged
    assert {log.verdict(k) for k in merged} == {Verdict.ACCEPTED}
    assert last not in merged
    assert obstacle(drive.map.solution(), merged[0], log) == Obstacle.MERGED
    with pytest.raises(ValueError, match="merged"):
        drive.map.undo(merged[0])
    assert obstacle(drive.map.solution(), last, log) is None
    drive.map.undo(last)
    assert log.verdict(last) == Verdict.UNDONE
    assert drive.go(6 * LAP).map.state.log.verdict(last) == Verdict.UNDONE


BEGUN, END = 240, 320
"""Keyframes at which the archive's selection begins, and the last ones of the drive; the selection is taken
up when there are an eighth more."""
STOPS = {
    "before any merge": 100,
    "merge due": 222,
    "between merges": 230,
    "selecting": BEGUN + 1,
    "due": BEGUN + 48,
}


@pytest.fixture
def early(monkeypatch):
    monkeypatch.setattr(keyframe_merger, "FIRST", BEGUN // 2)


@cache
def stopped():
    """Checkpoints at all stops, and the drive that went on from there."""
    drive, found = Drive(ROUTE, **MERGED), {}
    for name, at in STOPS.items():
        found[name] = drive.go(at).restored()
    return found, drive.go(END)


@pytest.mark.parametrize("stop", STOPS)
def test_a_checkpoint_continues_to_the_same_bits_and_changes_nothing(stop, early):
    found, whole = stopped()
    drive, merger = found[stop], found[stop].map.merger
    assert (len(drive.rows) < drive.steps == STOPS[stop]) == (stop != "before any merge")
    assert merger.archive_selection.job.busy == (stop in ("selecting", "due"))
    assert merger.merge_due or stop != "merge due"
    assert same(drive.restored().go(END), whole)
    assert stop != "due" or same(Drive(ROUTE, **MERGED).go(END), whole)


def test_the_archive_replaces_the_map_once_it_is_selected(monkeypatch, early):
    taken = []
    real = keyframe_merger.UnmergedMap.replace

    def replace(self, graph, archive):
        before, rows = graph.unmerged_poses().copy(), graph.count
        merge = real(self, graph, archive)
        size = len(self.onto)
        assert size == BEGUN
        assert BEGUN * 9 // 8 <= graph.count == archive.state.count < BEGUN * 9 // 8 + 2 * CHUNK
        assert abs(len(merge.source) - rows) < 40  # right ground is merged anew
        assert (graph.bias, graph.turn_error) == self.selected.calibration
        assert graph.heading_noise == self.selected.noise
        # The selected map, continued by the motions since, lies where the map did.
        poses = graph.pose.rows
        for part, expected in (
            (slice(0, size), self.selected.poses),
            (slice(size - 1, None), before[size - 1 :]),
        ):
            motion, wanted = (between(rows[:-1], rows[1:]) for rows in (poses[part], expected))
            assert np.allclose(motion, wanted, atol=1e-9)
        assert np.allclose(fit_rigid_motion(poses, before), 0.0, atol=1e-6)
        taken.append(size)
        return merge

    monkeypatch.setattr(keyframe_merger.UnmergedMap, "replace", replace)
    drive = Drive(ROUTE, **MERGED).go(4 * LAP)
    assert len(taken) == 1
    assert len(drive.rows) == drive.map.state.count
    assert drive.merged_apart().max() < 1.5 * CELL
    assert drive.experience_apart().max() < drive.map.config.place_radius * CELL
    offset = drive.map.state.archive.offset.rows
    assert not offset[drive.rows].any()
    assert 0 < np.hypot(*offset[:, :2].T).max() <= 2 * NEAR * CELL
    expected = driven(merge_stood=0, laps=4).error()
    assert drive.error().mean() < 1.2 * expected.mean() + 0.01 * CELL


# Sequences that are accepted by odds and not selected anew

LAPS, JUDGED_EVERY = 5, 50
BY_ODDS = {"merge_stood": 2, "merge_newest": 60}


@cache
def driven_by_odds():
    """Read only."""
    return Drive(ROUTE, AcceptByOdds, **BY_ODDS).go(LAPS * LAP)


def test_of_views_or_ids_the_merged_map_is_good():
    merged = driven_by_odds()
    assert len(merged.rows) <= LAP + BY_ODDS["merge_newest"] + JUDGED_EVERY + CHUNK + 20
    assert merged.map.state.unmerged.count == LAPS * LAP
    assert merged.error().mean() < 0.2 * CELL
    assert merged.merged_apart().max() < 1.5 * CELL
    found = merged.map.closures()
    assert len(found) > 0.6 * (ROUTE.recalled[: LAPS * LAP] >= 0).sum()
    assert np.abs(ROUTE.place[found[:, 0]] - ROUTE.place[found[:, 1]]).max() <= 1


def test_a_sequence_is_compared_with_the_odometry_of_all_keyframes():
    """As without merges: the odometry over merged keyframes is that of each, not of their sum."""
    whole = driven_by_odds().map
    ratios = whole.arrays()["acceptance/log_ratio"]
    graph, log = whole.state.unmerged, whole.state.unmerged.log
    sequence = int(np.flatnonzero(np.isfinite(ratios).any(axis=1))[-1])
    near = np.flatnonzero(np.isfinite(ratios[sequence]))
    start = Drive(ROUTE, AcceptByOdds, **BY_ODDS).map.state  # of which the grid is
    scan = OdometryScan(start)
    found = [scan.log_ratios(graph, member, near)[near] for member in log.members(sequence)]
    apart = [np.abs(row - ratios[sequence][near]).max() for row in found]
    assert min(apart) < 1e-9
    assert np.ptp(ratios[sequence][near]) > 0.1


def test_by_odds_a_checkpoint_continues_to_the_same_bits_and_a_question_changes_nothing_that_follows():
    whole = Drive(ROUTE, AcceptByOdds, **BY_ODDS).go(230)
    again = whole.restored()
    assert same(again.go(5 * LAP), whole.go(5 * LAP))
    again.map.trajectory()
    for drive in again, whole:
        drive.go(5 * LAP + 30)
    assert np.array_equal(again.map.trajectory(), whole.map.trajectory())
    assert np.array_equal(again.map.candidates(), whole.map.candidates(), equal_nan=True)


def test_a_match_that_merging_has_brought_near_is_judged_too():
    """Between a keyframe and its match fewer than `GUARD` keyframes may remain."""
    graph, log = driven_by_odds().map.state, driven_by_odds().map.state.log
    covariance: MapCovariance = with_log(graph, log).covariance()
    last = graph.count - 1
    log_ratio, distance, *_ = judge_by_map(graph, covariance, np.array([last, last - GUARD // 2, 0]))
    assert np.isfinite([log_ratio, distance]).all()
