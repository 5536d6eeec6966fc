"""Pieces of a map: connected components of its keyframes, where they lie, what joins and what parts them."""

from __future__ import annotations

import networkx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.core.backend import NO_CLOSURE
from ratslam.mapping.acceptance import AcceptByEvidence, AcceptByOdds
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.loop_closures import Candidate
from ratslam.mapping.map_solution import DOUBTED
from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.mapping.pieces import APART, number_pieces, piece_start, placed_pieces
from tactile.base.se2 import between, compose, wrap
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, STEP, drive, new_map, sequence, with_log


@st.composite
def cuts_and_closures(draw):
    """Cuts [N] and closures [M, 2]."""
    count = draw(st.integers(1, 30))
    frame = st.integers(0, count - 1)
    cut = np.array([False, *draw(st.lists(st.booleans(), min_size=count - 1, max_size=count - 1))])
    closures = draw(st.lists(st.tuples(frame, frame), max_size=12))
    return cut, np.array(closures, int).reshape(-1, 2)


@given(cuts_and_closures())
def test_pieces_are_the_connected_components_in_order(found):
    cut, closures = found
    assert number_pieces(cut[:0], closures[:0]).tolist() == []
    graph = networkx.Graph()
    graph.add_nodes_from(range(len(cut)))
    graph.add_edges_from((k - 1, k) for k in np.flatnonzero(~cut).tolist() if k)
    graph.add_edges_from(closures.tolist())
    piece = number_pieces(cut, closures)
    components = sorted(networkx.connected_components(graph), key=min)
    assert [set(np.flatnonzero(piece == k).tolist()) for k in range(len(components))] == components


SMALL = 0.2


@st.composite
def maps(draw):
    """Poses [N, 3] of stretches that lie apart, and the closures between them, each true at one place."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lengths = draw(st.lists(st.integers(1, 6), min_size=1, max_size=6))
    count = sum(lengths)
    begins = np.zeros(count, bool)
    begins[np.cumsum(lengths)[:-1]] = True
    stretch = np.cumsum(begins)
    truth = random.normal(0, 2, (count, 3))
    starts = np.array([piece_start(k, SMALL) for k in range(len(lengths))])
    first = np.searchsorted(stretch, stretch)
    poses = compose(starts[stretch], between(truth[first], truth))
    pairs = draw(st.lists(st.tuples(st.integers(0, count - 1), st.integers(0, count - 1)), max_size=5))
    i, j = np.array(pairs, int).reshape(-1, 2).T
    # A closure claims a position, so the two keyframes of each are put at one place of the truth.
    turn = random.uniform(-np.pi, np.pi, len(i))
    return poses, (begins, i, j, turn)


def between_first(poses, stretch):
    """Poses of keyframes in the frame of the first one of their stretch."""
    return between(poses[np.searchsorted(stretch, stretch)], poses)


@given(maps())
def test_pieces_keep_their_shape_and_lie_apart_unless_they_are_joined_once_and_for_all(found):
    poses, joints = found
    placed = placed_pieces(poses, *joints, SMALL)
    stretch = np.cumsum(joints[0])
    shape = between_first(placed, stretch) - between_first(poses, stretch)
    shape[:, 2] = wrap(shape[:, 2])
    assert np.abs(shape).max() < 1e-9
    piece = number_pieces(joints[0], np.column_stack([joints[2], joints[1]]))
    for number in np.unique(piece):
        at = np.flatnonzero(piece == number)[0]
        assert np.allclose(placed[at], piece_start(int(stretch[at]), SMALL) if number else poses[0])
    apart = np.hypot(*(placed[:, None, :2] - placed[None, :, :2]).transpose(2, 0, 1))
    assert (apart[piece[:, None] != piece] > APART / 2 * SMALL).all()
    assert np.abs(placed_pieces(placed, *joints, SMALL) - placed).max() < 1e-9


@given(maps(), st.integers(0, 2**32 - 1))
def test_one_closure_brings_two_pieces_to_where_it_claims(found, seed):
    poses, joints = found
    stretch = np.cumsum(joints[0])
    random = np.random.default_rng(seed)
    i, j = (int(random.integers(len(stretch))) for _ in range(2))
    turn = float(random.uniform(-3, 3))
    placed = placed_pieces(poses, joints[0], np.array([i]), np.array([j]), np.array([turn]), SMALL)
    if stretch[i] != stretch[j]:
        error = placed[j] - placed[i] - (0.0, 0.0, turn)
        assert np.abs([*error[:2], wrap(error[2])]).max() < 1e-9


def test_a_map_without_beginnings_is_left_as_it_is():
    poses = np.random.default_rng(0).normal(0, 1, (5, 3))
    none = np.zeros(0, int)
    assert placed_pieces(poses, np.zeros(5, bool), none, none, np.zeros(0), SMALL) is poses


BEGIN = LAP
RULES = pytest.mark.parametrize(
    "rule", [lambda *_: AcceptByEvidence(), AcceptByOdds], ids=["evidence", "odds"]
)

TIE = [Candidate(LAP + k, k, 0, 1.0, 4.0) for k in range(2, 14)]


def tie_late(graph, odds):
    """The tie of the second lap to the first, once the views that show it are there."""
    return (20.0, TIE) if graph.total > LAP + 14 else None


def driven(rule, *sequences, find_tie=None, last=LAP + 60):
    """A lap and a part of the next one, which begins a piece."""
    map = drive(new_map(rule, find_tie=find_tie), {}, last=BEGIN)
    map.begin_piece()
    return drive(map, {key: value for one in sequences for key, value in one.items()}, first=BEGIN, last=last)


def assert_apart(map):
    assert np.array_equal(map.pieces(), np.arange(LAP + 60) >= BEGIN)
    pose = map.solution().pose.rows
    assert np.hypot(*(pose[LAP + 8] - pose[8])[:2]) > APART / 2 * CELL


@RULES
def test_a_tie_joins_two_pieces_until_it_is_undone(rule):
    map = driven(rule, find_tie=tie_late)
    assert map.final_doubt() < DOUBTED
    assert not map.pieces().any()
    assert len(map.closures()) == len(TIE)
    pose = map.solution().pose.rows
    assert np.hypot(*(pose[LAP + 8] - pose[8])[:2]) < CELL
    assert np.hypot(*(pose[LAP + 50] - pose[50])[:2]) < 2 * CELL
    map.undo(0)
    assert_apart(map)


@RULES
def test_no_sequence_of_recall_joins_two_pieces(rule):
    strong = sequence(LAP + 2, 2, 40, 5.0)
    assert len(drive(new_map(rule), strong).closures()) == 40
    map = driven(rule, strong)
    assert len(map.closures()) == 0
    assert_apart(map)


@RULES
@pytest.mark.parametrize("stands", [False, True])
def test_a_tie_is_undone_below_half_the_log_odds_that_it_needs(rule, stands):
    later = 0.5 * KeyframeMapConfig().tie_log_odds + (0.1 if stands else -0.1)

    def tie_once(graph, odds):
        return (20.0 if graph.total < LAP + 40 else later, TIE) if graph.total > LAP + 14 else None

    assert not driven(rule, find_tie=tie_once, last=LAP + 38).pieces().any()
    map = driven(rule, find_tie=tie_once)
    assert np.array_equal(map.pieces(), (np.arange(LAP + 60) >= BEGIN) & (not stands))
    assert (len(map.closures()) > 0) == stands


@RULES
def test_odometry_of_a_piece_does_not_count_before_it(rule):
    map = driven(rule)
    reckoned = map.state.unmerged.dead_reckoned()
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
    with_log(map.state, map.state.log).adopt_prior(CalibrationPrior(0.3, 0.01))
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
    poses = map.kept_solution().pose.rows
    assert np.allclose(between(poses[ends.i], poses[ends.j]), ends.motion)


def test_the_kernel_is_told_where_the_next_piece_starts():
    map = new_map()
    map.begin_piece()  # a map without keyframes begins with its first one
    assert map.feedback().start is None
    assert not drive(map, {}, last=30).pieces().any()
    map.begin_piece()
    assert np.array_equal(map.feedback().start, (APART * CELL, 0.0, 0.0))
    drive(map, {}, first=30, last=31)
    assert map.feedback().start is None
    assert np.array_equal(map.feedback().poses[-1], (APART * CELL, 0.0, 0.0))
