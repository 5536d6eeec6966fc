"""Surfaces of a finished grid map, and what whiskers would meet there."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.grid.config import GridConfig
from ratslam.grid.expectation import CROSSINGS, TIPS, UNEXPLORED, Expectation, Surfaces, draw_surfaces
from ratslam.grid.localiser import CONTACT, FREE, counted_agreement
from ratslam.grid.map import contact_log
from tactile.base.se2 import compose
from tactile.base.types import MotionKind
from tests.helpers.grid_world import LENGTH, create
from tests.helpers.grid_world import TIPS as POINTS

CONFIG, SIDE = GridConfig(), 40
FEELERS = create()
COUNT = 12


def drive(start):
    """The surfaces of a drive ahead from a pose [3] that ends at a wall, which the second whisker meets."""
    ahead = np.column_stack([0.03 * np.arange(COUNT), np.zeros((COUNT, 2))])
    contact = np.zeros((COUNT, len(POINTS)), bool)
    contact[-1, 1] = True
    wall = np.full((COUNT, 2), np.nan)
    wall[-1] = [POINTS[1, 0], 0.0]  # straight ahead
    point = np.where(contact[:, :, None], POINTS, 0.0)
    log = contact_log(np.full(COUNT, MotionKind.FORWARD), contact, np.ones_like(contact), point, wall)
    path = compose(np.asarray(start, float), ahead)
    return draw_surfaces(CONFIG, FEELERS, SIDE, path, log), path


def test_a_contact_is_a_surface_and_the_driven_way_is_free():
    made, path = drive([-0.5, 0.1, 0.4])
    met = compose(path[-1], np.array([*POINTS[1], 0.0]))[:2]
    assert made.at(made.evidence, met) > 2
    assert (made.at(made.evidence, path[:, :2]) < -2).all()
    cosine, sine = (made.at(layer, met) for layer in made.direction)
    assert np.arctan2(sine, cosine) / 2 == pytest.approx(0.4 + np.pi / 2 - np.pi, abs=1e-6)


@given(st.tuples(st.integers(-8, 8), st.integers(-8, 8)))
def test_surfaces_move_with_the_path(cells):
    one, _ = drive([0.0, 0.0, 0.0])
    off = np.array(cells) * one.cell
    other, _ = drive([*off, 0.0])
    points = one.centres()[20:60, 20:60]
    np.testing.assert_allclose(
        one.at(one.evidence, points), other.at(other.evidence, points + off), atol=0.71
    )  # a point at the limit of two cells may fall into either


def wall_at(x):
    """Free space up to a wall at x, m, and nothing known beyond it."""
    empty = Surfaces(np.zeros((80, 80)), np.zeros((2, 80, 80)), 0.025)
    across = empty.centres()[..., 0]
    return empty._replace(evidence=np.where(across < x - 0.02, -4.0, np.where(across < x + 0.02, 6.0, 0.0)))


def classes(surfaces, pose):
    return np.asarray(Expectation(surfaces, FEELERS, CONFIG.body).whisker_classes(jnp.asarray([pose])))[0]


def test_a_nearer_wall_is_met_earlier_along_the_whisker():
    crossing = [classes(wall_at(0.13 + share * LENGTH), np.zeros(3))[1] // TIPS for share in (0.3, 0.7, 1.1)]
    assert crossing == sorted(crossing)
    assert len(set(crossing)) == 3
    assert classes(wall_at(0.6), np.zeros(3))[1] // TIPS == CROSSINGS - 1


def test_classes_turn_with_the_map():
    wall = wall_at(0.2)
    turned = wall._replace(evidence=np.rot90(wall.evidence, -1).copy())  # rows are y: turned to the left
    pose = np.array([0.01, 0.02, 0.1])
    left = np.array([-pose[1], pose[0], pose[2] + np.pi / 2])
    assert classes(wall, pose).tolist() == classes(turned, left).tolist()


def test_nothing_is_known_outside_the_map():
    assert (classes(wall_at(0.2), np.array([5.0, 0.0, 0.0])) == UNEXPLORED).all()


def test_contradictions_count_most():
    """A contact in free space speaks against a pose more than any agreement speaks for it."""
    odds = counted_agreement()["odds"]
    nowhere = (CROSSINGS - 1) * TIPS
    assert odds[CONTACT, nowhere] < -3
    assert odds[:, TIPS:].max() < 3
    assert odds[CONTACT, TIPS + 2] > 0
    assert np.abs(odds[FREE]).max() < 1
