"""Maps of views or ids, whose sequences are accepted by odds and not selected anew: merged like those of
whiskers."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ratslam.mapping.acceptance import AcceptByOdds
from ratslam.mapping.odometry_scan import OdometryScan
from ratslam.mapping.optimizer import MapCovariance
from ratslam.mapping.verification import judge_by_map
from tests.ratslam.mapping.map_cases import CELL
from tests.ratslam.mapping.merging_cases import CHUNK, GUARD, Drive, circles
from tests.ratslam.mapping.test_keyframe_merger import same

LAP, LAPS = 80, 7
ROUTE = circles(LAPS, size=LAP)
MERGED = {"merge_stood": 2, "merge_newest": 60}
JUDGED_EVERY = 50


@cache
def driven(laps=LAPS, merge_stood=2):
    """Read only."""
    return Drive(ROUTE, AcceptByOdds, **MERGED | {"merge_stood": merge_stood}).go(laps * LAP)


def test_the_number_of_keyframes_follows_the_ground():
    counts = [len(driven(laps).rows) for laps in (1, 5, 6, LAPS)]
    assert counts[0] == LAP
    assert max(counts) <= LAP + MERGED["merge_newest"] + JUDGED_EVERY + CHUNK + 20
    assert counts[-1] <= counts[1] + 10
    assert driven().map.keyframes().count == LAPS * LAP
    assert len(driven(merge_stood=0).rows) == LAPS * LAP


def test_the_map_is_as_good_as_without_merges():
    merged, unmerged = driven(), driven(merge_stood=0)
    assert merged.error().mean() < 1.2 * unmerged.error().mean() + 0.05 * CELL
    assert merged.merged_apart().max() < 1.5 * CELL
    found, expected = merged.map.closures(), unmerged.map.closures()
    assert len(found) > 0.9 * len(expected)
    assert np.abs(ROUTE.place[found[:, 0]] - ROUTE.place[found[:, 1]]).max() <= 1


def test_a_sequence_is_compared_with_the_odometry_of_all_keyframes():
    """As without merges: the odometry over merged keyframes is that of each, not of their sum."""
    whole = driven().map
    ratios = whole.arrays()["acceptance/log_ratio"]
    graph, log = whole.keyframes(), whole.archive.log
    sequence = int(np.flatnonzero(np.isfinite(ratios).any(axis=1))[-1])
    near = np.flatnonzero(np.isfinite(ratios[sequence]))
    scan = OdometryScan(
        Drive(ROUTE, AcceptByOdds, **MERGED).map.kept_keyframes()
    )  # its grid is that of the start
    found = [scan.log_ratios(graph, member, near)[near] for member in log.members(sequence)]
    apart = [np.abs(row - ratios[sequence][near]).max() for row in found]
    assert min(apart) < 1e-9
    assert np.ptp(ratios[sequence][near]) > 0.1


@pytest.mark.parametrize("stop", [90, 222, 230, 401])
def test_a_checkpoint_continues_to_the_same_bits(stop):
    drive = Drive(ROUTE, AcceptByOdds, **MERGED).go(stop)
    assert same(drive.restored().go(LAPS * LAP), drive.go(LAPS * LAP))


def test_queries_change_nothing_that_follows():
    asked = Drive(ROUTE, AcceptByOdds, **MERGED).go(300)
    whole = asked.restored()
    asked.map.trajectory()
    for drive in asked, whole:
        drive.go(LAPS * LAP)
    assert np.array_equal(asked.map.trajectory(), whole.map.trajectory())
    assert np.array_equal(asked.map.candidates(), whole.map.candidates(), equal_nan=True)


def test_a_match_that_merging_has_brought_near_is_judged_too():
    """Between a keyframe and its match fewer than `GUARD` keyframes may remain."""
    graph, log = driven().map.kept_keyframes(), driven().map.log
    covariance: MapCovariance = graph.map_covariance(log)
    last = graph.count - 1
    log_ratio, distance, *_ = judge_by_map(graph, covariance, np.array([last, last - GUARD // 2, 0]))
    assert np.isfinite([log_ratio, distance]).all()
