"""Placements of a session on a ring of keyframes whose views are made up."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.ground import Ground, Motion, learn_gain_odds
from ratslam.places.placement import Comparison, Traverse, find_placements
from tactile.base.se2 import between, compose

COUNT, RADIUS = 200, 2.0
RIGHT, WRONG = 3.0, -2.0
"""Gains of a view at the place where it was taken, and elsewhere."""
MOVED = np.array([3.0, -1.0, 0.7])
"""Brings the ring from the map of the session to that of the ground."""
ODDS = learn_gain_odds(np.full(200, RIGHT), np.full(200, WRONG))


def ring() -> np.ndarray:
    angle = np.arange(COUNT) * 2 * np.pi / COUNT
    return np.column_stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), angle + np.pi / 2])


def ground_of(poses: np.ndarray) -> Ground:
    return Ground(poses, np.zeros(1), 0.1, 0.3, np.array([0.03, 0.03, 0.05]) ** 2)


def compared(place: np.ndarray, recalled: np.ndarray, count: int) -> Traverse:
    """A session whose k-th view was taken at keyframe `place` [n] of the ground, -1: elsewhere."""
    gain = np.full((len(place), 1, count), WRONG, np.float32)
    gain[np.flatnonzero(place >= 0), 0, place[place >= 0]] = RIGHT
    shows, shift = np.ones(len(place), bool), np.zeros(len(place), int)
    views = Comparison(gain, shows, recalled, shift, (recalled >= 0).astype(float))
    steps = between(np.roll(ring(), 1, axis=0), ring())[: len(place)]
    return Traverse(views, [Motion(step, np.full(3, 1e-6)) for step in steps], least=-60.0)


def test_a_session_on_known_ground_is_placed_where_it_was():
    place = np.arange(COUNT)
    found = find_placements(ground_of(compose(MOVED, ring())), ODDS, compared(place, place, COUNT))
    assert len(found) == 1
    assert np.abs((found[0].poses - compose(MOVED, ring()))[:, :2]).max() < 0.01
    assert found[0].odds.sum() > COUNT
    assert (found[0].odds > 0).sum() > 0.9 * COUNT


def test_a_wrong_placement_is_contradicted_by_the_rest_of_the_session():
    recalled = np.full(COUNT, -1)
    recalled[:12] = np.arange(50, 62)  # the beginning looks like a quarter of the ring further on
    place = np.full(COUNT, -1)
    place[:12] = recalled[:12]
    ground = ground_of(compose(MOVED, ring()))
    assert all(one.odds.sum() < 0 for one in find_placements(ground, ODDS, compared(place, recalled, COUNT)))


def test_ground_that_the_other_map_does_not_have_counts_neither_way():
    half = COUNT // 2
    place = np.where(np.arange(COUNT) < half, np.arange(COUNT), -1)
    ground = ground_of(compose(MOVED, ring())[:half])
    found = find_placements(ground, ODDS, compared(place, place, half))
    assert len(found) == 1
    assert (found[0].odds > 0)[: half - 2].sum() > 0.9 * half
    assert not found[0].odds[half + 8 : -8].any()
    assert np.abs((found[0].poses - compose(MOVED, ring()))[:, :2]).max() < 0.05


@pytest.mark.parametrize("agreeing", [1, 2])
def test_few_recalled_poses_propose_nothing(agreeing):
    place = np.arange(COUNT)
    recalled = np.full(COUNT, -1)
    recalled[20 : 20 + agreeing] = place[20 : 20 + agreeing]
    assert not find_placements(ground_of(ring()), ODDS, compared(place, recalled, COUNT))
