"""Maps whose keyframes are merged while a robot drives a circle, or on ground that is wrong at first."""

from functools import cache

import numpy as np
import pytest

from ratslam.mapping import keyframe_merger, map_state
from ratslam.mapping.acceptance import AcceptByOdds
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map_solution import Obstacle, obstacle
from ratslam.mapping.merging import NEAR
from ratslam.mapping.odometry_scan import OdometryScan
from ratslam.mapping.verification import judge_by_map
from tactile.base.se2 import between, fit_rigid_motion
from tests.ratslam.mapping import merging_cases as cases
from tests.ratslam.mapping.map_cases import CELL, with_log
from tests.ratslam.mapping.map_cases import same as same_map
from tests.ratslam.mapping.merging_cases import CHUNK, CORRIDOR, GUARD, NORTH, SOUTH, Drive, circles, off

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
    newest = MERGED["merge_newest"] + MERGED["select_every"] + CHUNK
    for lap in range(1, 7):
        drive.go(lap * LAP)
        assert len(drive.rows) == len(drive.map.feedback().poses)
        counts.append(len(drive.rows))
    assert counts[0] == LAP
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
    steps, map = 5 * LAP, drive.map
    assert map.keyframe_steps().tolist() == list(range(steps))
    assert map.pieces().tolist() == [0] * steps
    assert len(map.trajectory()) == steps
    candidates = map.candidates()
    assert np.array_equal(candidates[:, 0], driven(merge_stood=0).map.candidates()[:, 0])
    assert np.allclose(candidates[:, 4], 4.0)
    assert map.state.unmerged.count == steps
    assert map.state.unmerged.least_misfit(steps - 1, np.array([steps - 1 - LAP]), np.array([False])) == 0.0
    later, earlier = map.closures().T
    accepted = candidates[:, 7] == Verdict.ACCEPTED
    assert later.tolist() == candidates[accepted, 0].astype(int).tolist()
    assert set(later) > set(range(2 * LAP, 2 * LAP + 15))  # keyframes that are merged
    assert np.abs(ROUTE.place[later] - ROUTE.place[earlier]).max() <= 1

    path = map.trajectory()
    for node in map.graph().nodes.values():
        assert np.allclose([node["x"], node["y"], node["heading"]], path[node["keyframe"]])
    for name, write in map.files().items():
        write(tmp_path / name)
    lines = (tmp_path / "closures.csv").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 1 + len(candidates)
    assert (tmp_path / "map.g2o").read_text(encoding="utf-8").count("VERTEX") == len(drive.rows)


def test_a_sequence_can_be_undone_unless_it_is_merged():
    drive = driven().restored()
    log, last = drive.map.state.log, drive.map.state.log.sequences - 2
    merged = [k for k in range(log.sequences) if log.has_merged(k)]
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
STOPS = {"before any merge": 100, "merge due": 222, "between merges": 230}
STOPS |= {"selecting": BEGUN + 1, "due": BEGUN + 48}


@pytest.fixture
def early(monkeypatch):
    monkeypatch.setattr(keyframe_merger, "FIRST", BEGUN // 2)


@cache
def stopped():
    """Checkpoints at all stops, and the drive that went on from there."""
    drive = Drive(ROUTE, **MERGED)
    return {name: drive.go(at).restored() for name, at in STOPS.items()}, drive.go(END)


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
        for found, expected in ((poses[:size], self.selected.poses), (poses[size - 1 :], before[size - 1 :])):
            motion, wanted = (between(rows[:-1], rows[1:]) for rows in (found, expected))
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


LAPS, JUDGED_EVERY = 5, 50
BY_ODDS = {"merge_stood": 2, "merge_newest": 60}


def test_by_odds_the_merged_map_is_good_and_a_sequence_is_compared_with_the_odometry_of_all_keyframes():
    merged = Drive(ROUTE, AcceptByOdds, **BY_ODDS).go(LAPS * LAP)
    assert len(merged.rows) <= LAP + BY_ODDS["merge_newest"] + JUDGED_EVERY + CHUNK + 20
    assert merged.map.state.unmerged.count == LAPS * LAP
    assert merged.error().mean() < 0.2 * CELL
    assert merged.merged_apart().max() < 1.5 * CELL
    found = merged.map.closures()
    assert len(found) > 0.6 * (ROUTE.recalled[: LAPS * LAP] >= 0).sum()
    assert np.abs(ROUTE.place[found[:, 0]] - ROUTE.place[found[:, 1]]).max() <= 1
    # As without merges: the odometry over merged keyframes is that of each, not of their sum.
    ratios = merged.map.arrays()["acceptance/log_ratio"]
    graph, log = merged.map.state.unmerged, merged.map.state.unmerged.log
    sequence = int(np.flatnonzero(np.isfinite(ratios).any(axis=1))[-1])
    near = np.flatnonzero(np.isfinite(ratios[sequence]))
    start = Drive(ROUTE, AcceptByOdds, **BY_ODDS).map.state  # of which the grid is
    scan = OdometryScan(start)
    found = [scan.log_ratios(graph, member, near)[near] for member in log.members(sequence)]
    assert min(np.abs(row - ratios[sequence][near]).max() for row in found) < 1e-9
    assert np.ptp(ratios[sequence][near]) > 0.1
    # Between a keyframe and its match fewer than `GUARD` keyframes may remain.
    graph = merged.map.state
    member = np.array([graph.count - 1, graph.count - 1 - GUARD // 2, 0])
    judged = judge_by_map(graph, with_log(graph, graph.log).covariance(), member)
    assert np.isfinite(judged[:2]).all()


def test_by_odds_a_checkpoint_continues_to_the_same_bits_and_a_question_changes_nothing_that_follows():
    whole = Drive(ROUTE, AcceptByOdds, **BY_ODDS).go(230)
    again = whole.restored()
    assert same(again.go(5 * LAP), whole.go(5 * LAP))
    again.map.trajectory()
    for drive in again, whole:
        drive.go(5 * LAP + 30)
    assert np.array_equal(again.map.trajectory(), whole.map.trajectory())
    assert np.array_equal(again.map.candidates(), whole.map.candidates(), equal_nan=True)


CORRIDORS, PLACES = cases.corridors(3), np.arange(CORRIDOR)
ANEW = {"select_every": 20, "merge_stood": 1, "merge_newest": 40}
AROUND, SELECTED, LAST_DRIVEN, NEVER = 168, 336, 440, 10**6
"""Keyframes of a lap, and at the selection on the unmerged ones, which is taken up an eighth later."""


@cache
def driven_anew(first, merge_stood=1):
    """The drive with the first selection of unmerged keyframes at this number."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keyframe_merger, "FIRST", first)
        return Drive(CORRIDORS, **ANEW | {"merge_stood": merge_stood}).go(LAST_DRIVEN)


def gap(path):
    """Mean distance between the corridors of the first lap in a trajectory, m."""
    return float(np.hypot(*(path[SOUTH + PLACES] - path[NORTH + PLACES])[:, :2].T).mean())


def merged_places(drive):
    """Those of the keyframes that those of the second corridor are merged with."""
    return CORRIDORS.place[drive.rows[drive.map.state.archive.row.rows[SOUTH + PLACES]]]


def false_closures(drive):
    """Number of accepted closures between the corridors."""
    later, earlier = CORRIDORS.place[drive.map.closures()].T
    return int((np.isin(later, SOUTH + PLACES) & (earlier < NORTH + CORRIDOR)).sum())


def test_merged_ground_stays_wrong_until_the_selection_on_unmerged_keyframes_merges_it_anew(monkeypatch):
    assert gap(CORRIDORS.truth) > 2.5 * CELL
    begun = Drive(CORRIDORS, **ANEW | {"merge_stood": 0}).go(AROUND)
    assert begun.map.candidates()[0, 7] == Verdict.ACCEPTED
    assert gap(begun.map.map_trajectory()) < CELL
    unmerged = driven_anew(NEVER, merge_stood=0)
    assert false_closures(unmerged) == 0
    assert gap(unmerged.map.online_trajectory()) > 2 * CELL
    drive = driven_anew(NEVER)
    assert (merged_places(drive) < NORTH + CORRIDOR).all()  # merged with the first corridor
    assert false_closures(drive) > 0
    assert gap(drive.map.online_trajectory()) < CELL
    # A larger map is not solved with all keyframes.
    monkeypatch.setattr(map_state, "MOST_SOLVED", LAST_DRIVEN - 1)
    assert gap(drive.restored().map.map_trajectory()) < CELL
    drive, unmerged = driven_anew(SELECTED), driven_anew(NEVER, merge_stood=0)
    assert (np.abs(merged_places(drive) - SOUTH - PLACES) <= 2).all()
    assert false_closures(drive) == 0
    assert gap(drive.map.online_trajectory()) > 2 * CELL
    assert len(drive.rows) < LAST_DRIVEN - AROUND // 2
    assert drive.merged_apart().max() < 1.5 * CELL
    assert drive.experience_apart().max() < (drive.map.config.place_radius + 2) * CELL
    assert drive.error().mean() < 1.2 * unmerged.error().mean() + 0.02 * CELL
    assert gap(drive.restored().map.map_trajectory()) > 2 * CELL


def test_the_map_is_right_as_soon_as_it_is_restored(monkeypatch):
    monkeypatch.setattr(keyframe_merger, "FIRST", SELECTED)
    drive = Drive(CORRIDORS, **ANEW).go(SELECTED)
    job, rows = drive.map.merger.archive_selection.job, len(drive.rows)
    assert job.busy
    while job.busy:
        assert len(drive.rows) - rows == drive.steps - SELECTED  # nothing is merged meanwhile
        assert drive.map.state.log.verdict(0) == Verdict.ACCEPTED
        assert gap(drive.map.online_trajectory()) < CELL
        drive.go(drive.steps + 1)
    assert drive.map.state.log.verdict(0) == Verdict.OPEN
    assert gap(drive.map.online_trajectory()) > 2 * CELL
    assert len(drive.map.online_trajectory()) == drive.steps
    for poses in drive.map.selection.hypotheses.poses:
        assert len(poses) <= len(drive.rows)
        assert off(poses, CORRIDORS.truth[drive.rows[: len(poses)]]).max() < 2 * CELL
