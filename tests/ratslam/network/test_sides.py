"""The network grows with the map, and its mass follows rows of keyframes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.network import pose_cells
from ratslam.network.pose_cells import LARGEST, OUTGROWN
from ratslam.recall.memory import MergedRows
from tests.ratslam.network.dense_network import (
    CELL,
    anchored,
    cells_at,
    held,
    network_of,
    predictor,
    random_case,
)

seeds = st.integers(0, 10_000)

# Sides


def path(x, y):
    """Poses of a map of these lengths, m."""
    return np.array([[-1.0, 2.0, 0.0], [x - 1, 2.0, 1.0], [-1.0, y + 2, 0.0]])


@pytest.mark.parametrize("xy", [7, 21])
def test_a_side_doubles_where_the_map_is_longer_than_a_period_and_a_quarter(xy):
    network = network_of(12, xy)
    for doublings in range(4):
        periods = OUTGROWN * xy * CELL * 2**doublings
        within, beyond = path(0.999 * periods, 0), path(1.001 * periods, 0)
        assert pose_cells.sides_for(network, within) == (xy << doublings, xy)
        assert pose_cells.sides_for(network, beyond) == (min(xy << (doublings + 1), xy * LARGEST), xy)
        assert pose_cells.sides_for(network, beyond[:, [1, 0, 2]])[::-1] == pose_cells.sides_for(
            network, beyond
        )


@given(st.floats(0, 1e9), st.floats(0, 1e9))
def test_sides_never_exceed_the_limit_and_never_shrink_with_the_map(x, y):
    network = network_of(12, 9)
    sides = np.array(pose_cells.sides_for(network, path(x, y)))
    assert (sides >= 9).all()
    assert (sides <= 9 * LARGEST).all()
    assert (np.array(pose_cells.sides_for(network, path(2 * x, y))) >= sides).all()
    covered = np.array([x, y]) <= OUTGROWN * CELL * sides * (1 + 1e-9)
    assert (covered | (sides == 9 * LARGEST)).all()


def test_a_map_without_extent_has_the_first_sides():
    network = network_of(12, 9)
    assert pose_cells.sides_for(network, np.zeros((0, 3))) == (9, 9)
    assert pose_cells.sides_for(network, np.ones((1, 3))) == (9, 9)


@given(seeds, st.sampled_from([(22, 11), (11, 22), (44, 88)]))
def test_more_cells_read_the_same_where_no_places_share_one(seed, sides):
    """All places lie within the first network, and the motion does not carry them beyond."""
    stream, network = np.random.default_rng(seed), network_of(12, 11)
    poses = stream.uniform([2 * CELL, 2 * CELL, -9], [7 * CELL, 7 * CELL, 9], (2, 20, 3))
    mass = stream.dirichlet(np.full(41, 0.5))[:-1].reshape(2, 20)
    cells, motion = cells_at(poses), jnp.asarray(stream.uniform(-1, 1, 3) * [CELL, CELL, 3])
    before = held(network, (12, 11, 11), poses, mass)
    silent = pose_cells.cover(network, before, sides)
    assert silent.activity.shape == (12, sides[1], sides[0])
    assert not np.asarray(silent.activity).any()
    assert np.array_equal(silent.mass, before.mass)
    after = anchored(network)(silent, cells, silent.mass)
    assert float(after.activity.sum()) == pytest.approx(float(before.activity.sum()), abs=1e-6)
    for one, other in zip(
        predictor(network)(before, cells, motion), predictor(network)(after, cells, motion), strict=True
    ):
        assert np.asarray(other) == pytest.approx(np.asarray(one), abs=1e-5)


def test_places_that_shared_cells_have_cells_of_their_own_after_a_doubling():
    """A packet is also read a period away; with twice as many cells it is read where it is."""
    network = network_of(12, 11)
    poses = np.array([[[3 * CELL, 3 * CELL, 0.0], [14 * CELL, 3 * CELL, 0.0]]])
    before, cells = held(network, (12, 11, 11), poses, [[0.8, 0.0]]), cells_at(poses)
    found, _ = predictor(network)(before, cells, jnp.zeros(3))
    assert np.asarray(found)[0] == pytest.approx([0.4, 0.4], abs=0.02)
    covered = anchored(network)(pose_cells.cover(network, before, (22, 11)), cells, before.mass)
    found, _ = predictor(network)(covered, cells, jnp.zeros(3))
    assert np.asarray(found)[0] == pytest.approx([0.8, 0.0], abs=0.02)


# Rows


def merge_of(stream, count):
    """About half of the keyframes merged with older ones, of which some face the other way."""
    gone = stream.random(count) < 0.5
    gone[0] = False
    kept = np.flatnonzero(~gone)
    onto = np.array([k if not gone[k] else stream.choice(kept[kept < k]) for k in range(count)])
    offset = np.where(gone[:, None], stream.normal(0, 0.1, (count, 3)), 0.0)
    offset[:, 2] += np.pi * (gone & (stream.random(count) < 0.5))
    return MergedRows(kept, np.zeros((len(kept), 0)), kept, (np.cumsum(~gone) - 1)[onto], offset)


@given(seeds)
def test_mass_goes_to_the_row_and_direction_of_the_merged_keyframe(seed):
    belief, stream = random_case(seed).belief, np.random.default_rng(seed)
    shifts, rows = belief.mass.shape
    count = int(stream.integers(1, rows + 1))
    merged = merge_of(stream, count)
    mass = np.array(belief.mass) * (np.arange(rows) < count)
    after = pose_cells.merge_rows(belief._replace(mass=jnp.asarray(mass)), merged.onto, merged.offset)
    expected = np.zeros(mass.shape)
    for row in range(count):
        for shift in range(shifts):
            opposite = np.cos(merged.offset[row, 2]) < 0 and shifts > 1
            expected[shifts - 1 - shift if opposite else shift, merged.onto[row]] += mass[shift, row]
    assert np.asarray(after.mass) == pytest.approx(expected, abs=1e-6)
    assert float(after.mass.sum()) == pytest.approx(mass.sum(), abs=1e-6)
    assert np.array_equal(after.activity, belief.activity)  # until it is anchored again
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, belief)
    assert {leaf.dtype for leaf in after} == {np.dtype(np.float32)}


def test_restored_keyframes_come_back_without_mass():
    """Twice as many rows: each former one comes back beside the one that it was merged with."""
    belief = random_case(1).belief
    mass = np.array(belief.mass) * (np.arange(40) < 20)
    merged = MergedRows(
        np.repeat(np.arange(20), 2), np.zeros((40, 0)), np.arange(40), 2 * np.arange(20), np.zeros((20, 3))
    )
    after = np.asarray(
        pose_cells.merge_rows(belief._replace(mass=jnp.asarray(mass)), merged.onto, merged.offset).mass
    )
    assert np.array_equal(after[:, ::2], mass[:, :20])
    assert not after[:, 1::2].any()


@given(seeds)
def test_mass_of_rows_that_are_gone_is_novelty(seed):
    case, stream = random_case(seed), np.random.default_rng(seed)
    rows = case.used.shape[1]
    left = stream.random(int(stream.integers(0, rows + 5))) < 0.6
    after = pose_cells.lose_rows(case.belief, left)
    kept = np.zeros(rows, bool)
    kept[: len(left)] = left[:rows]
    assert np.array_equal(after.mass, np.where(kept, case.belief.mass, 0))
    again = anchored(case.network)(after, cells_at(case.poses, case.used), after.mass)
    assert float(again.activity.sum()) == pytest.approx(float(after.mass.sum()), abs=1e-6)


def test_a_memory_without_view_cells_has_nothing_to_merge():
    network = network_of(12, 11)
    belief = pose_cells.start(network, (1, 0))
    merged = merge_of(np.random.default_rng(0), 1)
    assert pose_cells.merge_rows(belief, merged.onto, merged.offset) is belief
