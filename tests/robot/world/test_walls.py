"""Contact in closed form, compared with a search over all angles and points of the shaft."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.world.maze import random_loop, random_maze, wall_boxes
from robot.world.walls import NO_CONTACT, Surroundings, Walls
from tactile.base.random_streams import stream
from tactile.whisker_geometry import Head, HeadConfig, RingConfig, shaft_points, ur10_head

STEP = 1 / 600
"""Step of the search, as a fraction of the sweep."""
SHARES = np.arange(1, 161) / 160
"""Checked points of the shaft, as fractions of its length."""
WIDE = (RingConfig(length=0.05, radius=0.09, height=0.09), RingConfig(length=0.16, radius=0.12, height=0.17))
FIVE = (RingConfig(length=0.16, radius=0.05, height=0.16),)
HEADS = {
    "ur10": (HeadConfig(), 65.0),
    "steep": (HeadConfig(rest_deg=60.0, first_deg=17.0), 70.0),
    "past the vertical": (HeadConfig(rest_deg=45.0, limit_deg=100.0, rings=WIDE), 95.0),
    "one ring of five": (HeadConfig(rings=FIVE, whiskers=5), 70.0),
}


def maze_of(seed: int, heights: tuple[float, ...] = (0.05,)) -> Walls:
    loop = random_loop(3, 3, 8, stream(seed, "maze.loop"))
    maze = random_maze(3, 3, loop, 0.6, stream(seed, "maze.walls"))
    return wall_boxes(maze, stream(seed, "heights"), heights)


def search_contact(head: Head, boxes: Walls, pose: np.ndarray, sweep: float) -> tuple[np.ndarray, np.ndarray]:
    """First protraction [W] with a point of the shaft inside a box; the points [S, W] inside then."""
    angle = np.arange(0, sweep, sweep * STEP)
    shape = (len(angle), len(SHARES), len(head.length))
    along = SHARES[:, None] * head.length + np.zeros(shape)
    point = shaft_points(head, np.broadcast_to(angle[:, None, None], shape), along)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    low = point[..., 2] < boxes.height.max()
    u, v, z = point[low].T
    x, y = pose[0] + c * u - s * v, pose[1] + s * u + c * v
    within = np.zeros(len(z), bool)
    for (west, south, east, north), height in zip(boxes.box, boxes.height, strict=True):
        within |= (west < x) & (x < east) & (south < y) & (y < north) & (z < height)
    inside = np.zeros(shape, bool)
    inside[low] = within
    hit = inside.any(axis=1)
    first = np.argmax(hit, axis=0)
    return np.where(hit.any(axis=0), angle[first], NO_CONTACT), inside[first, :, np.arange(shape[2])].T


@pytest.mark.parametrize("name", HEADS)
def test_contact_agrees_with_the_search(name: str) -> None:
    config, degrees = HEADS[name]
    head, sweep = ur10_head(config), np.radians(degrees)
    random = np.random.default_rng(0)
    late, beside, missed = [], [], []
    for seed in range(3):
        boxes = maze_of(seed, (0.05, 0.03))
        poses = np.column_stack([random.uniform(0, 0.54, (2, 2)), random.uniform(-9, 9, 2)])
        contact = Surroundings(boxes, head).contact(poses)
        for pose, angle, reach in zip(poses, contact.angle, contact.reach, strict=True):
            brute, inside = search_contact(head, boxes, pose, sweep)
            there, met = angle <= sweep, np.isfinite(brute)
            assert (there | ~met).all()  # every contact of the search is found
            late += (brute[met] - angle[met]).tolist()
            missed += (there & ~met)[there].tolist()
            nearest = np.where(inside, np.abs(SHARES[:, None] - reach), 1.0).min(axis=0)
            beside += nearest[met & (angle > 0)].tolist()
    assert len(late) > 4
    # The search may miss a corner touched for less than a step.
    assert min(late) > -1e-9
    assert np.quantile(late, 0.95) < 0.006
    assert np.mean(missed) < 0.05
    assert np.quantile(beside, 0.95) < 0.01


def test_the_tip_touches_the_top_of_a_wall_and_the_shaft_its_far_edge() -> None:
    """By hand: a 100 mm whisker, horizontal at rest, with its base 100 mm above the floor on the axis."""
    ring = RingConfig(length=0.1, radius=1e-9, height=0.1)
    head = ur10_head(HeadConfig(rings=(ring,), whiskers=1, rest_deg=90.0, limit_deg=90.0))

    def first_contact(west: float, east: float, height: float) -> tuple[float, float]:
        boxes = Walls(np.array([[west, -0.5, east, 0.5]]), np.array([height]))
        contact = Surroundings(boxes, head).contact(np.zeros((1, 3)))
        return float(contact.angle[0, 0]), float(contact.reach[0, 0])

    angle, reach = first_contact(0.05, 0.2, 0.04)  # the tip descends to 4 cm: cos = 0.6
    assert (angle, reach) == pytest.approx((np.pi / 2 - np.arccos(0.6), 1.0))
    angle, reach = first_contact(0.02, 0.03, 0.06)  # the edge 3 cm out and 4 cm below the base
    assert (angle, reach) == pytest.approx((np.pi / 2 - np.arctan2(0.03, 0.04), 0.5))
    assert first_contact(0.09, 0.2, 0.04)[0] == NO_CONTACT  # beyond the tip's range
    assert first_contact(-0.2, -0.1, 0.04)[0] == NO_CONTACT  # behind


@settings(max_examples=15)
@given(st.integers(0, 50), st.integers(1, 12))
def test_a_query_of_many_poses_equals_queries_of_each(seed: int, count: int) -> None:
    random, walls, head = np.random.default_rng(seed), maze_of(seed), ur10_head(HeadConfig())
    pose = np.column_stack([random.uniform(-0.1, 0.64, (count, 2)), random.uniform(-9, 9, count)])
    pose[0] = 30.0, -20.0, 1.0  # far from walls
    whole = Surroundings(walls, head).contact(pose)
    for row in range(count):
        alone = Surroundings(walls, head).contact(pose[row : row + 1])
        for column, other in zip(whole, alone, strict=True):
            assert (column[row] == other[0]).all()
    assert (whole.angle[0] == NO_CONTACT).all()
    assert ((whole.wall >= 0) == np.isfinite(whole.angle)).all()
    assert (whole.reach[~np.isfinite(whole.angle)] == 0).all()
