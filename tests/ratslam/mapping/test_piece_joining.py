"""Pieces of a map driven by hand: which sequences join them, and what undoes it."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.core.backend import NO_CLOSURE
from ratslam.mapping.acceptance import AcceptByEvidence, AcceptByOdds
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.keyframe_graph import APART
from ratslam.mapping.loop_closures import Candidate
from ratslam.mapping.map_solution import DOUBTED
from ratslam.mapping.optimizer import CalibrationPrior
from tactile.base.se2 import between, compose
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, STEP, drive, new_map, sequence

BEGIN = LAP
RULES = pytest.mark.parametrize(
    "rule", [lambda *_: AcceptByEvidence(), AcceptByOdds], ids=["evidence", "odds"]
)


TIE = [Candidate(LAP + k, k, 0, 1.0, 4.0) for k in range(2, 14)]


def tie_late(graph, log, archive, odds):
    """The tie of the second lap to the first, once the views that show it are there."""
    return (20.0, TIE) if graph.total > LAP + 14 else None


def driven(rule, *sequences, find_tie=None, last=LAP + 60):
    """A lap and a part of the next one, which begins a piece."""
    map = drive(new_map(rule, find_tie=find_tie), {}, last=BEGIN)
    map.begin_piece()
    return drive(map, {key: value for one in sequences for key, value in one.items()}, first=BEGIN, last=last)


@RULES
def test_a_tie_joins_two_pieces(rule):
    map = driven(rule, find_tie=tie_late)
    assert map.final_doubt() < DOUBTED
    assert not map.pieces().any()
    assert len(map.closures()) == len(TIE)
    pose = map.solution().fit.poses
    assert np.hypot(*(pose[LAP + 8] - pose[8])[:2]) < CELL
    assert np.hypot(*(pose[LAP + 50] - pose[50])[:2]) < 2 * CELL


@RULES
@pytest.mark.parametrize("stands", [False, True])
def test_a_tie_is_undone_below_half_the_log_odds_that_it_needs(rule, stands):
    later = 0.5 * KeyframeMapConfig().tie_log_odds + (0.1 if stands else -0.1)

    def tie_once(graph, log, archive, odds):
        return (20.0 if graph.total < LAP + 40 else later, TIE) if graph.total > LAP + 14 else None

    assert not driven(rule, find_tie=tie_once, last=LAP + 38).pieces().any()
    map = driven(rule, find_tie=tie_once)
    assert np.array_equal(map.pieces(), (np.arange(LAP + 60) >= BEGIN) & (not stands))
    assert (len(map.closures()) > 0) == stands


@RULES
def test_no_sequence_of_recall_joins_two_pieces(rule):
    strong = sequence(LAP + 2, 2, 40, 5.0)
    assert len(drive(new_map(rule), strong).closures()) == 40
    map = driven(rule, strong)
    assert len(map.closures()) == 0
    assert np.array_equal(map.pieces(), np.arange(LAP + 60) >= BEGIN)
    pose = map.solution().fit.poses
    assert np.hypot(*(pose[LAP + 8] - pose[8])[:2]) > APART / 2 * CELL


@RULES
def test_pieces_come_apart_when_their_tie_is_undone(rule):
    map = driven(rule, find_tie=tie_late)
    map.undo(0)
    assert np.array_equal(map.pieces(), np.arange(LAP + 60) >= BEGIN)
    pose = map.solution().fit.poses
    assert np.hypot(*(pose[LAP + 8] - pose[8])[:2]) > APART / 2 * CELL


@RULES
def test_odometry_of_a_piece_does_not_count_before_it(rule):
    map = driven(rule)
    reckoned = map.keyframes().dead_reckoned()
    assert np.allclose(reckoned[BEGIN], (APART * CELL, 0.0, 0.0))
    assert np.allclose(map.trajectory(), reckoned)
    assert map.covariance()[0, 0] < CELL**2 * 100  # of the newest keyframe from the first of its piece


@RULES
@pytest.mark.parametrize("begin", [40, None])
def test_a_piece_without_an_accepted_closure_is_its_odometry(rule, begin):
    """To the bit where the map begins with it; also where the views show another bias."""
    map = drive(new_map(rule), {}, last=40)
    if begin:
        map.begin_piece()
    map.kept_keyframes().adopt_prior(map.log, CalibrationPrior(0.3, 0.01))
    drive(map, {}, first=40, last=80)
    motion, path = np.array([STEP, 0.0, 2 * np.pi / LAP - BIAS * STEP]), [np.zeros(3)]
    for _ in range(79):
        path.append(compose(path[-1], motion))
    odometry = np.array(path)
    for found in (map.trajectory(), map.map_trajectory(), map.online_trajectory()):
        assert np.array_equal(found[:begin], odometry[:begin])
        assert np.allclose(between(found[40], found[40:]), between(odometry[40], odometry[40:]))
    assert np.isnan([map.doubt(), map.final_doubt()]).all()
    assert map.unjudged() == NO_CLOSURE
    assert "calibration.yaml" not in map.files()
    ends = map.edges()
    poses = map.kept_solution().fit.poses
    assert np.allclose(between(poses[ends.i], poses[ends.j]), ends.motion)


def test_a_map_without_keyframes_begins_with_its_first_one():
    map = new_map()
    map.begin_piece()
    assert not drive(map, {}, last=30).pieces().any()
    assert map.feedback().start is None


def test_the_kernel_is_told_where_the_next_piece_starts():
    map = drive(new_map(), {}, last=30)
    map.begin_piece()
    assert np.array_equal(map.feedback().start, (APART * CELL, 0.0, 0.0))
    drive(map, {}, first=30, last=31)
    assert map.feedback().start is None
    assert np.array_equal(map.feedback().poses[-1], (APART * CELL, 0.0, 0.0))
