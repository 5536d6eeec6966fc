"""The adaptive window: at every window level a step equals the step on the whole torus."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.classic import levels, pose_cells
from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.excitation_inhibition import ring_difference
from ratslam.classic.levels import StepInput, step_at, to_full_torus, window_levels
from tactile.base.types import Odometry

CELLS = {11: 2, 21: 2, 41: 3, 61: 4}
"""Cells per side, and the number of window levels there."""


@partial(jax.jit, static_argnames="config")
def steps_of(config, cells, motion, recall, energy, count):
    """The first `count` steps of motion in cells [T, 3]: poses, spreads [T, 3], outcomes and levels [T]."""
    used, unit = window_levels(config, np.dtype(float)), units(config, np.dtype(float))

    def step(k, carry):
        cells, *rows = carry
        odometry = Odometry(*(motion[k] * unit), jnp.ones(()))
        cells, info = pose_cells.step(config, used, cells, odometry, recall[k], energy[k])
        return cells, *(row.at[k].set(value) for row, value in zip(rows, (cells.pose, *info), strict=True))

    whole = jnp.zeros(len(motion), jnp.int32)
    return jax.lax.fori_loop(
        0, count, step, (cells, jnp.zeros_like(motion), jnp.zeros_like(motion), whole, whole)
    )


@partial(jax.jit, static_argnums=0)
def full_activity(config, cells):
    return to_full_torus(window_levels(config, cells.pose.dtype), cells.activity)


def compare(n, motion, recall, energy):
    """Compares both engines, compiled for up to 600 steps or more; returns the window levels."""
    count = len(motion)
    more = max(600 - count, 0)
    motion, recall = (np.pad(rows, ((0, more), (0, 0))) for rows in (motion, recall))
    energy = np.pad(energy, (0, more))
    moving = NetworkConfig(cells_xy=n)
    dense = moving.model_copy(update={"engine": "dense"})
    (one, pose, spread, outcome, level), (all_, whole_pose, whole_spread, whole_outcome, whole_level) = (
        steps_of(config, pose_cells.start(config, np.dtype(float)), motion, recall, energy, np.int32(count))
        for config in (moving, dense)
    )
    ring = rings(moving, np.dtype(float))
    assert np.abs(ring_difference(np.asarray(pose) - np.asarray(whole_pose), ring)).max() <= 1e-12
    assert np.nanmax(np.abs(np.asarray(spread) - np.asarray(whole_spread))) <= 1e-9
    assert np.array_equal(outcome, whole_outcome)
    assert not np.any(whole_level)
    gap = full_activity(moving, one) - full_activity(dense, all_)
    assert float(jnp.abs(gap).max()) <= 1e-14
    return np.asarray(level)[:count]


def random_motion(n, seed, often, speed, steps):
    """Motion of any size, injections of any energy at any place; without injections one window is enough."""
    stream = np.random.default_rng(seed)
    motion = stream.normal(0, speed, (steps, 3)) * [1, 0.3, 0.5]
    energy = np.where(stream.random(steps) < often, stream.choice([0.02, 0.1, 0.5, 2.0], steps), 0.0)
    level = compare(n, motion, stream.random((steps, 3)) * [n, n, 36], energy)
    if often == 0:
        assert not np.any(level)


@pytest.mark.soak
@settings(max_examples=2)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.01, 0.1]), st.sampled_from([0.05, 0.4, 2.0]))
def test_some_hundred_steps_equal_those_of_the_torus(seed, often, speed):
    random_motion(41, seed, often, speed, 200)


places = [st.floats(-12, 12), st.floats(-12, 12), st.floats(-18, 18)]
injection = st.tuples(st.integers(0, 119), *places, st.floats(1e-9, 3))
injections = given(st.lists(injection, max_size=8), st.floats(-1, 1), st.floats(-1, 1))


def injected(planted, speed, turn):
    """Injections across the faces of windows, a few cells from the packet."""
    motion = np.tile([speed, 0.0, turn], (120, 1))
    recall, energy = np.zeros((120, 3)), np.zeros(120)
    at = np.array([20.0, 20.0, 18.0])
    for k, x, y, heading, how_much in planted:
        recall[k], energy[k] = (at + [x, y, heading]) % [41, 41, 36], how_much
    compare(41, motion, recall, energy)


@settings(max_examples=3)
@injections
def test_injections_at_any_distance_from_the_packet_are_exact(planted, speed, turn):
    injected(planted, speed, turn)


@pytest.mark.soak
@settings(max_examples=30)
@injections
def test_many_injections_at_any_distance_from_the_packet_are_exact(planted, speed, turn):
    injected(planted, speed, turn)


@pytest.mark.parametrize("n", [*(pytest.param(n, marks=pytest.mark.soak) for n in (11, 21, 61)), 41])
def test_activity_too_large_for_a_level_moves_up(n):
    """A distant injection opens a second window, three need the torus, and finally one window is enough."""
    energy, recall = np.zeros(600), np.zeros((600, 3))
    energy[20] = energy[100:103] = 0.15
    recall[20], recall[100:103] = [1, n // 2, 3], [[1, 1, 1], [n // 2, 1, 30], [1, n // 2, 10]]
    level = compare(n, np.zeros((600, 3)), recall, energy)
    top = CELLS[n] - 1
    assert len(window_levels(NetworkConfig(cells_xy=n), np.dtype(float))) == CELLS[n]
    assert not np.any(level[:20])
    assert level[20] == (1 if top > 1 else top)
    assert level[102] == top
    assert level[-1] == 0


@pytest.mark.parametrize(("away", "exact"), [(2.0, True), (4.5, False), (9.0, False)])
def test_a_small_window_refuses_a_deposit_near_its_face(away, exact):
    """The cells excited by a deposit near the face would be lost."""
    config = NetworkConfig()
    sizes = window_levels(config, np.dtype(float))
    pose = jnp.asarray([10.0, 10.0, 18.0])
    activity = levels.point_activity(sizes, pose)
    inputs = StepInput(
        pose, pose + jnp.asarray([away, 0.0, 0.0]), jnp.asarray(0.3), jnp.int32(1), *[jnp.zeros(3)] * 2,
        jnp.zeros(()),
    )  # fmt: skip
    assert bool(jax.jit(partial(step_at, sizes[0]))(activity.blocks[0], inputs)[2]) == exact


@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (20.7, 0.2, 35.9), (10.0, 20.5, 17.0)])
def test_activity_is_the_same_at_any_level(where):
    config = NetworkConfig(cells_xy=41)
    sizes = window_levels(config, np.dtype(float))
    small = levels.point_activity(sizes, jnp.asarray(where))
    whole = levels.to_full_torus(sizes, small)
    assert float(whole.sum()) == pytest.approx(1)
    for k in range(1, len(sizes)):
        block = levels.block_at(sizes, k, small, sizes[k].window.origin_centred_on(jnp.asarray(where)))
        held = small._replace(
            blocks=tuple(block if j == k else b for j, b in enumerate(small.blocks)), level=jnp.int32(k)
        )
        assert np.array_equal(levels.to_full_torus(sizes, held), whole)


def test_wide_kernels_have_wide_margins():
    config = NetworkConfig(cells_xy=61, excite_width=11, inhibit_width=9)
    small = window_levels(config, np.dtype(float))[0].window
    assert (small.margin, small.gap, small.shape) == (5, 14, (20, 20, 20))


@pytest.mark.soak
@settings(max_examples=100)
@given(
    st.sampled_from([11, 21, 41, 61, 101]),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.01, 0.1]),
    st.sampled_from([0.05, 0.4, 2.0]),
)
def test_many_thousands_of_steps_equal_those_of_the_torus(n, seed, often, speed):
    random_motion(n, seed, often, speed, 1000)
