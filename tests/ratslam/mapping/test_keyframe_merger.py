"""Maps whose keyframes are merged while a robot drives a circle again and again."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ratslam.mapping import archive
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map_solution import Obstacle
from ratslam.mapping.merging import NEAR
from tactile.base.se2 import between, fit_rigid_motion
from tests.ratslam.mapping.map_cases import CELL
from tests.ratslam.mapping.merging_cases import CHUNK, Drive, circles

LAP = 80
ROUTE = circles(6, size=LAP)
MERGED = {"select_every": 30, "merge_stood": 2, "merge_newest": 60}
UNMERGED = MERGED | {"merge_stood": 0}


def same(a, b):
    first, second = a.map.arrays(), b.map.arrays()
    assert first.keys() == second.keys()
    assert np.array_equal(a.rows, b.rows)
    return all(np.array_equal(first[name], second[name], equal_nan=True) for name in first)


@cache
def driven(laps=5, merge_stood=MERGED["merge_stood"]):
    """Read only."""
    return Drive(ROUTE, **MERGED | {"merge_stood": merge_stood}).go(laps * LAP)


def merged_sequences(drive):
    log = drive.map.log
    return [k for k in range(log.sequences) if log.has_merged(k)]


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
    assert drive.map.keyframes().count == 6 * LAP


def test_rows_are_the_keyframes_of_the_map():
    drive = driven()
    assert np.array_equal(drive.rows, drive.map.kept_keyframes().taken.rows)
    assert drive.merged_apart().max() < 1.5 * CELL


def test_experiences_are_those_of_the_first_lap():
    drive, unmerged = driven(), driven(merge_stood=0)
    radius = drive.map.config.place_radius * CELL
    assert max(drive.experiences) <= max(unmerged.experiences) + 2
    assert drive.experience_apart().max() < radius
    first, last = np.array(drive.experiences[:LAP]), np.array(drive.experiences[-LAP:])
    assert (first == last).mean() > 0.9


def test_the_trajectory_is_as_good_as_without_merges():
    merged, unmerged = driven().error(), driven(merge_stood=0).error()
    assert len(driven(merge_stood=0).rows) == 5 * LAP
    assert len(merged) == len(unmerged) == 5 * LAP
    assert unmerged.mean() < 0.2 * CELL
    assert merged.mean() < 1.2 * unmerged.mean() + 0.01 * CELL
    assert merged.max() < 1.2 * unmerged.max() + 0.05 * CELL


def test_the_online_map_is_good_too():
    drive = driven()
    online, final = drive.map.online_trajectory(), drive.map.map_trajectory()
    assert len(online) == 5 * LAP
    assert np.hypot(*(online - final)[:, :2].T).max() < 0.5 * CELL


def test_queries_speak_of_all_keyframes(tmp_path):
    drive = driven()
    whole, steps, map = driven(merge_stood=0).map, 5 * LAP, drive.map
    assert map.keyframe_steps().tolist() == list(range(steps))
    assert map.pieces().tolist() == [0] * steps
    assert len(map.trajectory()) == steps
    candidates = map.candidates()
    assert np.array_equal(candidates[:, 0], whole.candidates()[:, 0])
    assert np.allclose(candidates[:, 4], 4.0)
    assert map.keyframes().count == steps
    assert map.keyframes().least_misfit(steps - 1, np.array([steps - 1 - LAP]), np.array([False])) == 0.0
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


def test_a_merged_sequence_cannot_be_undone():
    drive = driven()
    merged = merged_sequences(drive)
    accepted = set(drive.map.candidates()[drive.map.candidates()[:, 7] == Verdict.ACCEPTED, 5].astype(int))
    assert merged
    assert set(merged) < accepted
    assert drive.map.solution().obstacle(merged[0], drive.map.log) == Obstacle.MERGED
    with pytest.raises(ValueError, match="merged"):
        drive.map.undo(merged[0])


def test_a_sequence_that_is_not_merged_can_be_undone():
    drive = driven().restored()
    last = drive.map.log.sequences - 2
    assert last not in merged_sequences(drive)
    assert drive.map.solution().obstacle(last, drive.map.log) is None
    drive.map.undo(last)
    candidates = drive.map.candidates()
    assert set(candidates[candidates[:, 5] == last, 7]) == {Verdict.UNDONE}
    drive.go(6 * LAP)
    candidates = drive.map.candidates()
    assert set(candidates[candidates[:, 5] == last, 7]) == {Verdict.UNDONE}


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
    monkeypatch.setattr(archive, "FIRST", BEGUN // 2)


@cache
def stopped():
    """Checkpoints at all stops, and the drive that went on from there."""
    drive, found = Drive(ROUTE, **MERGED), {}
    for name, at in STOPS.items():
        found[name] = drive.go(at).restored()
    return found, drive.go(END)


def test_the_stops_are_what_they_are_named(early):
    found, whole = stopped()
    merged = {name: len(drive.rows) < STOPS[name] for name, drive in found.items()}
    assert merged == {name: name != "before any merge" for name in STOPS}
    selecting = {name for name, drive in found.items() if drive.map.merger.archive_selection.job.busy}
    assert selecting == {"selecting", "due"}
    assert not whole.map.merger.archive_selection.job.busy
    assert found["merge due"].map.merger.merge_due
    assert not found["between merges"].map.merger.merge_due


@pytest.mark.parametrize("stop", STOPS)
def test_a_checkpoint_continues_to_the_same_bits(stop, early):
    found, whole = stopped()
    assert found[stop].steps == STOPS[stop]
    assert same(found[stop].restored().go(END), whole)


def test_checkpoints_change_nothing(early):
    _, whole = stopped()
    assert same(Drive(ROUTE, **MERGED).go(END), whole)


def test_the_archive_replaces_the_map_once_it_is_selected(monkeypatch, early):
    taken = []
    real = archive.UnmergedMap.replace

    def replace(self, graph, log, archive):
        before, rows = archive.poses(graph.pose.rows).copy(), graph.count
        merge = real(self, graph, log, archive)
        size = len(self.onto)
        assert size == BEGUN
        assert BEGUN * 9 // 8 <= graph.count == archive.graph.count < BEGUN * 9 // 8 + 2 * CHUNK
        assert abs(len(merge.kept) - rows) < 40  # right ground is merged anew
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

    monkeypatch.setattr(archive.UnmergedMap, "replace", replace)
    drive = Drive(ROUTE, **MERGED).go(4 * LAP)
    assert len(taken) == 1
    assert len(drive.rows) == drive.map.kept_keyframes().count
    assert drive.merged_apart().max() < 1.5 * CELL
    assert drive.experience_apart().max() < drive.map.config.place_radius * CELL
    offset = drive.map.archive.offset.rows
    assert not offset[drive.rows].any()
    assert 0 < np.hypot(*offset[:, :2].T).max() <= 2 * NEAR * CELL
    expected = driven(merge_stood=0, laps=4).error()
    assert drive.error().mean() < 1.2 * expected.mean() + 0.01 * CELL
