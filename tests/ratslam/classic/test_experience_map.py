"""Laws of the experience map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.classic.experience_map import ExperienceConfig, ExperienceMap
from ratslam.core.estimates import Action, Estimate
from tactile.base.se2 import compose, integrate, inverse
from tactile.base.types import Odometry, observation


class Evidence(NamedTuple):
    """The fields of `ClassicEvidence` that the map reads."""

    template: int = 0
    relative: float = 0.0


def fold(world: ExperienceMap, moved, action=Action.NONE, place=-1, relative=0.0, dt=1.0):
    estimate = Estimate(np.zeros(3), np.zeros(3), place, -1, action, False)
    world.update(observation(Odometry(*moved, dt)), estimate, Evidence(place, relative))
    return world.pose(estimate)


motions = st.lists(
    st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3), st.integers(0, 3), st.integers(0, 5)),
    min_size=1,
    max_size=40,
)


@given(motions)
def test_without_closures_the_map_is_raw_odometry(steps):
    world = ExperienceMap(ExperienceConfig(closures=False))
    made, poses = 0, []
    for *moved, action, place in steps:
        if action == Action.CREATE:
            place, made = made, made + 1
        poses.append(fold(world, moved, Action(action), place, relative=0.3))
    expected = integrate(np.array([step[:3] for step in steps]))
    gaps = compose(inverse(expected), np.array(poses))
    assert np.abs(gaps).max() < 1e-9
    assert np.abs(compose(inverse(expected), world.trajectory())).max() < 1e-9


def square(world: ExperienceMap, bias: float, sign: float = 1.0, laps: int = 3):
    """Laps of a unit square with a biased turn; views of later laps are seen rotated by a known angle."""
    truth = []
    for k in range(4 * laps):
        relative = 0.0 if k < 4 else 0.4 * (k % 3 - 1)
        before = 0.0 if k <= 4 else 0.4 * ((k - 1) % 3 - 1)
        # The robot stands turned by `relative` against the heading at which it stored the place.
        moved = compose(inverse(np.array([0, 0, before])), np.array([1.0, 0, np.pi / 2 + bias + relative]))
        if k == 0:
            moved = np.zeros(3)
        action = Action.CREATE if k < 4 else Action.LINK if k == 4 else Action.SET
        fold(world, moved, action, k % 4, sign * relative)
        truth.append([(0, 0), (1, 0), (1, 1), (0, 1)][k % 4])
    return np.array(truth, float)


@pytest.mark.parametrize("solver", ["least_squares", "relaxation"])
def test_relative_headings_are_subtracted(solver):
    config = ExperienceConfig.model_validate({"solver": {"name": solver}})
    errors = {}
    for sign in (1.0, -1.0):
        world = ExperienceMap(config)
        square(world, 0.0, sign)
        corners = world.nodes()[:, :2]
        sides = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
        errors[sign] = np.abs(sides - 1).max()
    assert errors[1.0] < 1e-6
    assert errors[-1.0] > 0.05


def test_traversals_are_evidence_in_either_direction():
    world = ExperienceMap()
    fold(world, (0, 0, 0), Action.CREATE, 0)
    fold(world, (1.0, 0, 0), Action.CREATE, 1, dt=2.0)
    fold(world, (-1.2, 0, 0), Action.SET, 0, dt=3.0)
    edges = world.edges()
    assert len(edges.i) == 1
    link = world.graph().edges[0, 1]
    assert link["traversals"] == 2
    assert link["duration"] == 5.0
    assert 1.0 < link["dx"] < 1.2


def test_motion_before_the_first_node_counts_once():
    world = ExperienceMap()
    fold(world, (0.5, 0, 0))
    fold(world, (0.5, 0, 0), Action.CREATE, 0)
    fold(world, (1.0, 0, 0), Action.CREATE, 1)
    assert np.allclose(world.nodes()[:, 0], [1.0, 2.0])
    assert np.allclose(world.edges().motion[0], [1.0, 0, 0])


@pytest.mark.parametrize("stop", [1, 5, 6, 11])
def test_a_restored_map_continues_bit_for_bit(stop):
    def play(world, start, end):
        stream = np.random.default_rng(1)
        for k in range(end):
            moved = stream.normal(0, 1, 3)
            if k >= start:
                fold(world, moved, Action.CREATE if k < 5 else Action.LINK, k % 5, 0.1)
        return world

    whole = play(ExperienceMap(), 0, 15)
    second = ExperienceMap()
    second.restore(play(ExperienceMap(), 0, stop).arrays())
    play(second, stop, 15)
    for name, value in whole.arrays().items():
        assert np.array_equal(value, second.arrays()[name]), name


def test_invalid_odometry_changes_nothing():
    world = ExperienceMap()
    fold(world, (0, 0, 0), Action.CREATE, 0)
    fold(world, (np.nan, 0, 0))
    pose = fold(world, (1, 0, 0), Action.LINK, 77)
    assert np.allclose(pose, [1, 0, 0])
    assert len(world.nodes()) == 1
