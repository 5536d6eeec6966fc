"""Signs stand at walls: at contacts that are new, and where contacts were."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.ground import Ground
from ratslam.places.change import ContactMap, contact_points, contact_signs
from ratslam.recall.whisker_likelihood import PRIOR, estimate_background, log_odds_table, pixel_layout
from tactile.whisker_geometry import HeadConfig, ur10_head

HEAD = ur10_head(HeadConfig())
LAYOUT = pixel_layout((3, 6, 1))
TALLEST = 0.05
TOUCHED = [1, 7, 13]
"""Whiskers on the left."""


def images(random: np.random.Generator, count: int) -> np.ndarray:
    """[count, 18] levels of a corridor with a wall on the left."""
    levels = np.zeros((count, 18), int)
    levels[:, TOUCHED] = random.integers(14, 18, (count, len(TOUCHED)))
    return levels


def corridor(reversed: bool = False) -> ContactMap:
    """The map of a corridor along x."""
    random = np.random.default_rng(0)
    poses = np.column_stack([np.arange(0.0, 1.0, 0.02), np.zeros(50), np.zeros(50)])
    levels = images(random, 50)
    if reversed:
        poses[:, 2], levels = np.pi, levels[:, LAYOUT.opposite]
    varied = np.concatenate([levels, np.roll(levels, 1, axis=1), np.zeros_like(levels)])
    table = log_odds_table(estimate_background(varied, LAYOUT.group), PRIOR)
    ground = Ground(poses, np.array([0.0, -np.pi]), 0.06, 0.3, np.full(3, 1e-4))
    return ContactMap(ground, levels, LAYOUT, table, HEAD, TALLEST)


def drive(count: int = 20) -> np.ndarray:
    return np.column_stack([np.linspace(0.2, 0.6, count), np.zeros(count), np.zeros(count)])


@pytest.mark.parametrize("reversed", [False, True])
def test_the_same_wall_speaks_against_a_change(reversed: bool) -> None:
    made, poses = corridor(reversed), drive()
    signs = contact_signs(made, poses, images(np.random.default_rng(1), 20), np.full(20, 50))
    assert len(signs.evidence) == 60
    assert signs.evidence.mean() < 0
    assert not signs.appears.any()


@pytest.mark.parametrize("reversed", [False, True])
def test_a_wall_that_is_gone_is_missed_where_it_was(reversed: bool) -> None:
    made, poses = corridor(reversed), drive()
    signs = contact_signs(made, poses, np.zeros((20, 18), int), np.full(20, 50))
    assert (signs.evidence > 0).all()
    assert (signs.appears == -1).all()
    assert (signs.points[:, 1] > 0.03).all()  # on the left of the robot


def test_a_new_wall_stands_where_the_whiskers_touch_it() -> None:
    made, poses = corridor(), drive()
    levels = images(np.random.default_rng(2), 20)
    right = np.arange(18).reshape(3, 6)[:, -np.arange(6) % 6].ravel()[TOUCHED]  # opposite sides
    levels[:, right] = 16
    signs = contact_signs(made, poses, levels, np.full(20, 50))
    new = signs.appears == 1
    assert new.sum() == 60
    assert (signs.points[new, 1] < -0.03).all()
    assert (signs.evidence[new] > 0).all()
    points, touched = contact_points(poses, levels, HEAD, TALLEST)
    assert touched.sum() == 120
    np.testing.assert_allclose(np.sort(signs.points[new, 0]), np.sort(points[:, right, 0].ravel()))


def test_only_known_keyframes_are_compared() -> None:
    made, poses = corridor(), drive()
    levels = images(np.random.default_rng(3), 20)
    assert not len(contact_signs(made, poses, levels, np.zeros(20, int)).evidence)
    behind = contact_signs(made, poses, levels, np.full(20, 9))
    assert set(behind.keyframe.tolist()) == {0}
