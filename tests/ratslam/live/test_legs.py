"""Straight legs of a way."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.live.goal_drive import SCATTER, leg_heading, legs_of
from tactile.base.se2 import line_distances


def test_a_corner_has_two_legs_that_pass_all_poses():
    scatter = 0.4 * SCATTER * np.random.default_rng(1).uniform(-1, 1, (20, 2))
    straight = np.linspace(0, 0.5, 10)
    place = np.vstack(
        [np.column_stack([straight, 0 * straight]), np.column_stack([0 * straight + 0.5, straight])]
    )
    way = np.column_stack([place + scatter, np.repeat([0.0, np.pi / 2], 10)])
    legs = legs_of(way)
    assert len(legs) == 2
    assert [leg.heading for leg in legs] == pytest.approx([0.0, np.pi / 2], abs=0.1)
    line = np.array([legs[0].start, *(leg.end for leg in legs)])
    assert line_distances(way[:, :2], line).max() <= SCATTER


def test_a_way_driven_backwards_or_sideways_keeps_its_heading():
    place = np.column_stack([np.linspace(0, 1, 5), np.zeros(5)])
    for heading, expected in ((np.pi - 0.1, np.pi), (0.1, 0.0), (1.2, 1.2)):
        found = leg_heading(np.column_stack([place, np.full(5, heading)]))
        assert np.cos(found - expected) == pytest.approx(1.0)


def test_one_place_is_a_leg_without_length():
    (leg,) = legs_of(np.array([[1.0, 2.0, 0.5]]))
    assert np.array_equal(leg.start, leg.end)
    assert leg.heading == 0.5
