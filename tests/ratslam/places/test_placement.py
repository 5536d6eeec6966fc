"""Placements of a session on a ring of keyframes whose views are made up; a solved piece is a rigid body."""

import numpy as np
import pytest

from ratslam.mapping.ground import Ground, Motion, learn_gain_odds
from ratslam.places.placement import TOGETHER, Comparison, Traverse, find_placements
from tactile.base.se2 import between, compose

COUNT, RADIUS = 200, 2.0
RIGHT, WRONG = 3.0, -2.0
"""Gains of a view at the place where it was taken, and elsewhere."""
MOVED = np.array([3.0, -1.0, 0.7])
"""Brings the ring from the map of the session to that of the ground."""
ODDS = learn_gain_odds(np.full(200, RIGHT), np.full(200, WRONG))


TIME = np.arange(COUNT)
ANGLE = TIME * 2 * np.pi / COUNT
RING = np.column_stack([RADIUS * np.cos(ANGLE), RADIUS * np.sin(ANGLE), ANGLE + np.pi / 2])
THERE = compose(MOVED, RING)


def ground_of(poses: np.ndarray) -> Ground:
    return Ground(poses, np.zeros(1), 0.1, 0.3, np.array([0.03, 0.03, 0.05]) ** 2)


def compared(place: np.ndarray, recalled: np.ndarray, count: int) -> Traverse:
    """A session whose k-th view was taken at keyframe `place` [n] of the ground, -1: elsewhere."""
    gain = np.full((len(place), 1, count), WRONG, np.float32)
    gain[np.flatnonzero(place >= 0), 0, place[place >= 0]] = RIGHT
    shows, shift = np.ones(len(place), bool), np.zeros(len(place), int)
    views = Comparison(gain, shows, recalled, shift, (recalled >= 0).astype(float))
    steps = between(np.roll(RING, 1, axis=0), RING)[: len(place)]
    return Traverse(views, [Motion(step, np.full(3, 1e-6)) for step in steps], least=-60.0)


def test_a_session_is_placed_where_it_was_and_ground_that_the_other_map_does_not_have_counts_neither_way():
    (path,) = find_placements(ground_of(THERE), ODDS, compared(TIME, TIME, COUNT))
    assert np.abs((path.poses - THERE)[:, :2]).max() < 0.01
    assert path.odds.sum() > COUNT
    assert (path.odds > 0).sum() > 0.9 * COUNT
    half = COUNT // 2
    place = np.where(half > TIME, TIME, -1)
    (path,) = find_placements(ground_of(THERE[:half]), ODDS, compared(place, place, half))
    assert (path.odds > 0)[: half - 2].sum() > 0.9 * half
    assert not path.odds[half + 8 : -8].any()
    assert np.abs((path.poses - THERE)[:, :2]).max() < 0.05


def test_a_wrong_placement_is_contradicted_by_the_rest_and_few_recalled_poses_propose_nothing():
    looks = np.where(TIME < 12, TIME + 50, -1)  # the beginning looks like a quarter of the ring further on
    found = find_placements(ground_of(THERE), ODDS, compared(looks, looks, COUNT))
    assert all(one.odds.sum() < 0 for one in found)
    for agreeing in (1, 2):
        few = np.where((TIME >= 20) & (20 + agreeing > TIME), TIME, -1)
        assert not find_placements(ground_of(RING), ODDS, compared(TIME, few, COUNT))


GAP = range(70, 130)
"""Keyframes of the ring that the ground does not have."""
HELD = np.setdiff1d(np.arange(COUNT), GAP)
MIN_LOG_ODDS = -60.0


def half_known(recalled: np.ndarray, turn: float) -> Traverse:
    """The whole ring over ground without the gap; each motion in the gap leads astray by a turn, rad."""
    place = np.full(COUNT, -1)
    place[HELD] = np.arange(len(HELD))
    session = compared(place, np.where(recalled >= 0, place, -1), len(HELD))
    for k in GAP:
        motion, variance = session.motions[k]
        session.motions[k] = Motion(motion + np.array([0.0, 0.0, turn]), variance)
    return Traverse(session.views, session.motions, MIN_LOG_ODDS, RING)


def error(poses: np.ndarray, rows: slice) -> float:
    return float(np.hypot(*(poses - THERE)[rows, :2].T).max())


@pytest.mark.parametrize("turn", [0.01, -0.01])
def test_a_piece_comes_back_to_the_ground_where_it_is_as_a_rigid_body(turn: float) -> None:
    ground, back = ground_of(THERE[HELD]), slice(GAP.stop, COUNT)
    piece = half_known(np.where(TIME < 60, 0, -1), turn)
    (path,) = find_placements(ground, ODDS, piece)
    assert error(path.poses, back) < 0.01
    assert (path.odds[back] > 0).all()
    (astray,) = find_placements(ground, ODDS, Traverse(piece.views, piece.motions, -np.inf))
    assert error(astray.poses, back) > 0.1
    assert astray.odds.sum() < path.odds.sum() - COUNT / 4


def test_the_whole_piece_is_placed_from_any_keyframe_in_the_same_way() -> None:
    ground = ground_of(THERE[HELD])
    piece = half_known(np.zeros(COUNT, int), 0.0)
    one, other = (piece.follow(ground, ODDS, k, THERE[k]) for k in (20, 180))
    np.testing.assert_allclose(one.poses, other.poses, atol=1e-3)
    np.testing.assert_array_equal(one.odds, other.odds)


def test_a_few_confirmed_places_do_not_make_a_rigid_body() -> None:
    place = np.where(TIME < TOGETHER - 1, TIME, -1)
    session, start = compared(place, place, COUNT), (ground_of(THERE), ODDS, 0, THERE[0])
    way = Traverse(session.views, session.motions, MIN_LOG_ODDS).follow(*start)
    found = Traverse(session.views, session.motions, MIN_LOG_ODDS, RING).follow(*start)
    assert found.first == way.first
    np.testing.assert_array_equal(found.odds, way.odds)
    assert len(found.poses) < COUNT
