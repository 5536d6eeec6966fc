"""A solved piece is placed on another map as a rigid body that views correct."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.ground import Motion
from ratslam.places.placement import TOGETHER, Traverse, find_placements
from tactile.base.se2 import compose
from tests.ratslam.places.test_placement import COUNT, MOVED, ODDS, compared, ground_of, ring

GAP = range(70, 130)
"""Keyframes of the ring that the ground does not have."""
HELD = np.setdiff1d(np.arange(COUNT), GAP)
MIN_LOG_ODDS = -60.0


def half_known(recalled: np.ndarray, turn: float) -> Traverse:
    """The whole ring over ground without the gap; its motions lead astray in the gap.

    Args:
        turn: error of each motion there, rad.
    """
    place = np.full(COUNT, -1)
    place[HELD] = np.arange(len(HELD))
    session = compared(place, np.where(recalled >= 0, place, -1), len(HELD))
    for k in GAP:
        astray = session.motions[k].motion + np.array([0.0, 0.0, turn])
        session.motions[k] = Motion(astray, session.motions[k].variance)
    return Traverse(session.views, session.motions, MIN_LOG_ODDS, ring())


def error(poses: np.ndarray, rows: slice) -> float:
    return float(np.hypot(*(poses - compose(MOVED, ring()))[rows, :2].T).max())


@pytest.mark.parametrize("turn", [0.01, -0.01])
def test_a_piece_comes_back_to_the_ground_where_it_is_as_a_rigid_body(turn: float) -> None:
    ground, back = ground_of(compose(MOVED, ring()[HELD])), slice(GAP.stop, COUNT)
    piece = half_known(np.where(np.arange(COUNT) < 60, 0, -1), turn)
    (path,) = find_placements(ground, ODDS, piece)
    assert error(path.poses, back) < 0.01
    assert (path.odds[back] > 0).all()
    (astray,) = find_placements(ground, ODDS, Traverse(piece.views, piece.motions, -np.inf))
    assert error(astray.poses, back) > 0.1
    assert astray.odds.sum() < path.odds.sum() - COUNT / 4


def test_the_whole_piece_is_placed_from_any_keyframe_in_the_same_way() -> None:
    ground = ground_of(compose(MOVED, ring()[HELD]))
    piece = half_known(np.zeros(COUNT, int), 0.0)
    one, other = (piece.follow(ground, ODDS, k, compose(MOVED, ring()[k])) for k in (20, 180))
    np.testing.assert_allclose(one.poses, other.poses, atol=1e-3)
    np.testing.assert_array_equal(one.odds, other.odds)


def test_a_few_confirmed_places_do_not_make_a_rigid_body() -> None:
    place = np.where(np.arange(COUNT) < TOGETHER - 1, np.arange(COUNT), -1)
    session = compared(place, place, COUNT)
    ground = ground_of(compose(MOVED, ring()))
    piece = Traverse(session.views, session.motions, MIN_LOG_ODDS, ring())
    pose = compose(MOVED, ring()[0])
    way = Traverse(session.views, session.motions, MIN_LOG_ODDS).follow(ground, ODDS, 0, pose)
    found = piece.follow(ground, ODDS, 0, pose)
    assert found.first == way.first
    np.testing.assert_array_equal(found.odds, way.odds)
    assert len(found.poses) < COUNT
