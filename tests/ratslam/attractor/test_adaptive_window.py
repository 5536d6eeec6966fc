"""Laws of the ladder: on every rung the network does what the whole torus does."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.attractor import adaptive_window, pose_cells, window
from ratslam.attractor.config import PoseCellConfig, rings, units
from tactile.base.types import Odometry

CELLS = {11: 2, 21: 2, 41: 3, 61: 4}
"""Cells a side, and how many rungs the ladder has there."""


@partial(jax.jit, static_argnames="config")
def run(config, cells, motion, recall, energy):
    """Motion in cells [T, 3]: poses, spreads [T, 3], outcomes and rungs [T]."""
    rungs, unit = adaptive_window.rungs(config, np.dtype(float)), units(config, np.dtype(float))

    def step(cells, row):
        moved, at, how_much = row
        odometry = Odometry(*(moved * unit), jnp.ones(()))
        cells, told = pose_cells.step(config, rungs, cells, odometry, at, how_much)
        return cells, (cells.pose, *told)

    return jax.lax.scan(step, cells, (motion, recall, energy))


spread_out = jax.jit(pose_cells.activity, static_argnums=0)


def compare(n, motion, recall, energy):
    """Both engines, for as many steps as fill a compiled run of 1000; returns the window's rungs."""
    count = len(motion)
    motion, recall = (np.pad(rows, ((0, 1000 - count), (0, 0))) for rows in (motion, recall))
    energy = np.pad(energy, (0, 1000 - count))
    window = PoseCellConfig(cells_xy=n)
    dense = window.model_copy(update={"engine": "dense"})
    start = [pose_cells.start(config, np.dtype(float)) for config in (window, dense)]
    one, (pose, spread, outcome, rung) = run(window, start[0], motion, recall, energy)
    all_, (whole_pose, whole_spread, whole_outcome, whole_rung) = run(dense, start[1], motion, recall, energy)
    ring = rings(window, np.dtype(float))
    assert np.abs(window.around(np.asarray(pose) - np.asarray(whole_pose), ring)).max() <= 1e-12
    assert np.nanmax(np.abs(np.asarray(spread) - np.asarray(whole_spread))) <= 1e-9
    assert np.array_equal(outcome, whole_outcome)
    assert not np.any(whole_rung)
    gap = spread_out(window, one) - spread_out(dense, all_)
    assert float(jnp.abs(gap).max()) <= 1e-14
    return np.asarray(rung)[:count]


def thousand(n, seed, often, speed):
    """Motion of any size, injections of any energy anywhere; without any, one patch is enough."""
    stream = np.random.default_rng(seed)
    motion = stream.normal(0, speed, (1000, 3)) * [1, 0.3, 0.5]
    energy = np.where(stream.random(1000) < often, stream.choice([0.02, 0.1, 0.5, 2.0], 1000), 0.0)
    rung = compare(n, motion, stream.random((1000, 3)) * [n, n, 36], energy)
    if often == 0:
        assert not np.any(rung)


@settings(max_examples=4)
@given(
    st.sampled_from([21, 41]),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.01, 0.1]),
    st.sampled_from([0.05, 0.4, 2.0]),
)
def test_a_thousand_steps_are_those_of_the_torus(n, seed, often, speed):
    thousand(n, seed, often, speed)


@settings(max_examples=6)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 119),
            st.floats(-12, 12),
            st.floats(-12, 12),
            st.floats(-18, 18),
            st.floats(1e-9, 3),
        ),
        max_size=8,
    ),
    st.floats(-1, 1),
    st.floats(-1, 1),
)
def test_injections_at_any_distance_from_the_packet_are_exact(planted, speed, turn):
    """Chosen to lie across the edges of patches: some cells from where the packet is then."""
    motion = np.tile([speed, 0.0, turn], (120, 1))
    recall, energy = np.zeros((120, 3)), np.zeros(120)
    at = np.array([20.0, 20.0, 18.0])
    for k, x, y, heading, how_much in planted:
        recall[k], energy[k] = (at + [x, y, heading]) % [41, 41, 36], how_much
    compare(41, motion, recall, energy)


@pytest.mark.parametrize("n", [11, 21, 41, pytest.param(61, marks=pytest.mark.soak)])
def test_what_a_rung_cannot_hold_climbs(n):
    """One far injection opens a second patch, three fill the torus, and in the end one patch is enough."""
    energy, recall = np.zeros(600), np.zeros((600, 3))
    energy[20] = energy[100:103] = 0.15
    recall[20], recall[100:103] = [1, n // 2, 3], [[1, 1, 1], [n // 2, 1, 30], [1, n // 2, 10]]
    rung = compare(n, np.zeros((600, 3)), recall, energy)
    top = CELLS[n] - 1
    assert len(adaptive_window.rungs(PoseCellConfig(cells_xy=n), np.dtype(float))) == CELLS[n]
    assert not np.any(rung[:20])
    assert rung[20] == (1 if top > 1 else top)
    assert rung[102] == top
    assert rung[-1] == 0


@pytest.mark.parametrize(("away", "exact"), [(2.0, True), (4.5, False), (9.0, False)])
def test_an_overflow_is_seen(away, exact):
    """A deposit so far out that the small patch would lose what it excites is refused by it."""
    config = PoseCellConfig()
    rungs = adaptive_window.rungs(config, np.dtype(float))
    pose = jnp.asarray([10.0, 10.0, 18.0])
    activity = adaptive_window.seeded(rungs, pose)
    push = adaptive_window.Push(
        pose, pose + jnp.asarray([away, 0.0, 0.0]), jnp.asarray(0.3), jnp.int32(1), *[jnp.zeros(3)] * 2,
        jnp.zeros(()),
    )  # fmt: skip
    assert bool(adaptive_window._step(rungs[0], activity.blocks[0], push)[2]) == exact


@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (20.7, 0.2, 35.9), (10.0, 20.5, 17.0)])
def test_activity_is_the_same_on_any_rung(where):
    config = PoseCellConfig(cells_xy=41)
    rungs = adaptive_window.rungs(config, np.dtype(float))
    small = adaptive_window.seeded(rungs, jnp.asarray(where))
    whole = adaptive_window.spread_out(rungs, small)
    assert float(whole.sum()) == pytest.approx(1)
    for k in range(1, len(rungs)):
        block = adaptive_window._switched(
            rungs, k, small, window.origin_about(rungs[k].patch, jnp.asarray(where))
        )
        held = small._replace(
            blocks=tuple(block if j == k else b for j, b in enumerate(small.blocks)), rung=jnp.int32(k)
        )
        assert np.array_equal(adaptive_window.spread_out(rungs, held), whole)


def test_wide_kernels_have_wide_margins():
    config = PoseCellConfig(cells_xy=61, excite_width=11, inhibit_width=9)
    small = adaptive_window.rungs(config, np.dtype(float))[0].patch
    assert (small.margin, small.gap, small.shape) == (5, 14, (20, 20, 20))


@pytest.mark.soak
@settings(max_examples=100)
@given(
    st.sampled_from([11, 21, 41, 61, 101]),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.01, 0.1]),
    st.sampled_from([0.05, 0.4, 2.0]),
)
def test_many_thousands_of_steps_are_those_of_the_torus(n, seed, often, speed):
    thousand(n, seed, often, speed)
