"""Laws of the pose cells, beside the network as an explicit hidden Markov model by dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.map_state import piece_start
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from ratslam.network import pose_cells
from ratslam.network.pose_cells import Belief
from ratslam.recall.memory import MapFeedback
from tactile.base.se2 import compose, inverse
from tests.helpers.merges import random_merge
from tests.ratslam.network import dense_network as dense
from tests.ratslam.network.dense_network import CELL, cells_at, network_of, random_case, tie_matrix

seeds = st.integers(0, 10_000)
ROUNDING = 5e-6
"""Largest error in single precision, at positions of up to tens of cells."""
tie = jax.jit(pose_cells.tie, static_argnums=(0, 1))
drive = jax.jit(pose_cells.drive, static_argnums=(0, 1))
read, integrate_path = jax.jit(pose_cells.read, static_argnums=0), jax.jit(pose_cells.integrate_path)
activity_at = jax.jit(pose_cells.activity_at, static_argnums=0)


@given(seeds)
def test_shares_are_those_of_the_eight_cells_around(seed):
    case = random_case(seed)
    index, weight = tie(case.network, case.shape, cells_at(case.poses, case.used))
    index, weight = np.asarray(index), np.asarray(weight, float)
    assert index.min() >= 0
    assert index.max() < np.prod(case.shape)
    assert weight.min() >= 0
    assert np.abs(weight.sum(axis=0) - case.used).max() < ROUNDING
    found = np.zeros((np.prod(case.shape), case.used.size))
    for one, share in zip(index, weight, strict=True):
        np.add.at(found, (one.ravel(), np.arange(case.used.size)), share.ravel())
    expected = tie_matrix(case.network, case.shape, case.poses, case.used).reshape(found.shape)
    assert np.abs(found - expected).max() < ROUNDING


@given(st.sampled_from([0.01, 0.3, 0.5, 1.2, 5.0]), st.sampled_from([7, 8, 36]))
def test_excitation_falls_from_one_at_both_sides_and_ends_within_the_ring(sd, size):
    weights = pose_cells.excitation(sd, size)
    half = len(weights) // 2
    assert half <= (size - 1) // 2
    reach = np.arange(size + 1)
    expected = np.maximum(1 - (reach / sd) ** 2 / 8, 0) ** 4
    assert weights[half:] == pytest.approx(expected[: half + 1], rel=1e-6)
    assert np.array_equal(weights, weights[::-1])
    assert half == (size - 1) // 2 or expected[half + 1] == 0


@given(seeds, st.integers(2, 200))
def test_many_small_motions_are_one(seed, count):
    case, stream = random_case(seed), np.random.default_rng(seed)
    small, whole = stream.normal(0, [0.1 * CELL, 0.05 * CELL, 0.05], (count, 3)), np.zeros(3)
    for one in small:
        whole = compose(whole, one)
    by_steps = cells = cells_at(case.poses)
    for one in small[::-1]:  # p m^-1 of motions a, b is p b^-1 a^-1
        by_steps = integrate_path(by_steps, jnp.asarray(one))
    at_once = integrate_path(cells, jnp.asarray(whole))
    for name in ("x", "y", "cosine", "sine"):
        found, expected = getattr(by_steps, name), getattr(at_once, name)
        assert np.abs(found - expected).max() < 3e-7 * count, name
    found, expected = (np.cos(each.heading - each.heading[0, 0]) for each in (by_steps, at_once))
    assert found == pytest.approx(expected, abs=1e-4)


steps = st.tuples(st.floats(-40, 40), st.floats(-40, 40), st.floats(-20, 20))


@given(seeds, steps)
def test_a_packet_is_not_blurred_by_any_motion(seed, step):
    """A view cell where the packet has moved to reads what one at the packet read before the motion; all of
    it where a single pose cell holds it."""
    network, shape = network_of(12, 11), (12, 9, 11)
    stream = np.random.default_rng(seed)
    layer, y, x = (int(stream.integers(0, n)) for n in shape)
    on_cell = [x * CELL, y * CELL, layer * np.pi / 6]
    between = on_cell + stream.uniform(0, 1, 3) * [CELL, CELL, np.pi / 6]
    motion = np.array(step) * [CELL, CELL, 1]
    for pose, whole in ((on_cell, 1.0), (between, None)):
        belief = dense.held(network, shape, [[pose]], [[1.0]])
        rest = read(network, cells_at([[pose]]), belief.activity)
        there = cells_at([[compose(np.array(pose), motion)]])
        moved = integrate_path(there, jnp.asarray(motion))
        found = read(network, moved, belief.activity)
        assert float(found[0, 0]) == pytest.approx(whole or float(rest[0, 0]), abs=1e-4)
        prior, lost = dense.predictor(network, belief, there, jnp.asarray(motion))
        assert float(prior[0, 0]) > 0.9
        assert float(prior[0, 0] + lost) == pytest.approx(1, abs=ROUNDING)


@given(seeds)
def test_activity_is_read_where_the_preferred_poses_of_cells_have_moved(seed):
    case = random_case(seed)
    heading, _, x = case.shape
    network = network_of(heading, x)
    activity = np.random.default_rng(seed).random((heading, x, x)).astype(np.float32)
    belief, every = Belief(jnp.asarray(activity), case.belief.mass), np.arange(activity.size)
    at_rest = activity_at(network, belief, jnp.zeros(3), every)
    assert np.asarray(at_rest) == pytest.approx(activity.ravel(), abs=ROUNDING)
    layer, row, column = np.unravel_index(every, activity.shape)
    poses = np.stack([column * CELL, row * CELL, layer * 2 * np.pi / heading], axis=-1)
    from_where = compose(poses, inverse(case.motion))
    ties = tie_matrix(network, activity.shape, from_where[None], np.ones((1, activity.size)))
    expected = np.tensordot(activity.astype(float), ties, axes=3)
    chosen = np.random.default_rng(seed).choice(activity.size, 20)
    found = activity_at(network, belief, jnp.asarray(case.motion), chosen)
    assert np.asarray(found) == pytest.approx(expected[chosen], abs=ROUNDING)


@given(seeds)
def test_prediction_and_update_are_those_of_a_hidden_markov_model(seed):
    case, stream = random_case(seed), np.random.default_rng(seed)
    cells, (prior, lost) = cells_at(case.poses, case.used), dense.predicted(case)
    found, gone = dense.predictor(case.network, case.belief, cells, jnp.asarray(case.motion))
    assert np.asarray(found, float) == pytest.approx(prior, abs=ROUNDING)
    assert float(gone) == pytest.approx(lost, abs=ROUNDING)
    likelihood, novelty = stream.exponential(1, case.used.shape) ** 3, stream.exponential(1)
    fresh = 1 - np.asarray(case.belief.activity, float).sum()
    entered = 0.1 * fresh * case.used / max(case.used.sum(), 1)
    rest = (1 - case.belief.activity.sum() + gone).astype(float) - entered.sum()
    mass, novel = pose_cells.inhibit(likelihood * (found.astype(float) + entered), novelty * rest)
    belief = dense.anchored(case.network, case.belief, cells, mass)
    joint = likelihood * (prior + entered), novelty * (fresh + lost - entered.sum())
    total = joint[0].sum() + joint[1]
    assert np.asarray(belief.mass) == pytest.approx(joint[0] / total, abs=ROUNDING)
    assert float(novel) == pytest.approx(joint[1] / total, abs=ROUNDING)
    assert np.asarray(belief.activity) == pytest.approx(dense.driven(case, joint[0] / total), abs=ROUNDING)
    assert float(belief.activity.sum()) + float(novel) == pytest.approx(1, abs=ROUNDING)


def test_views_that_are_nowhere_likely_leave_no_nan():
    mass, novel = pose_cells.inhibit(jnp.zeros((2, 3)), jnp.zeros(()))
    assert not np.asarray(mass).any()
    assert float(novel) == 0


def test_at_the_start_all_is_novelty():
    network = network_of(12, 11)
    belief = pose_cells.start(network, (3, 5))
    for leaf, shape in zip(belief, ((12, 11, 11), (3, 5)), strict=True):
        assert (leaf.shape, leaf.dtype) == (shape, np.float32)
        assert not np.asarray(leaf).any()
    found, lost = dense.predictor(network, belief, cells_at(np.zeros((3, 5, 3))), jnp.ones(3))
    assert not np.asarray(found).any()
    assert float(lost) == 0


@pytest.mark.parametrize("rows", [1, 255, 256, 257, 600])
def test_rows_are_joined_in_blocks_up_to_the_last_in_use(rows):
    """However many rows there is room for, and wherever the last one in use is."""
    network, shape, stream = network_of(), (36, 21, 21), np.random.default_rng(rows)
    poses = stream.uniform(-1, 1, (1, 1024, 3))
    mass = stream.random((1, 1024)).astype(np.float32)
    used = np.arange(1024)[None] < rows
    whole = drive(network, shape, cells_at(poses, used), jnp.asarray(mass))
    alone = drive(network, shape, cells_at(poses[:, :rows], used[:, :rows]), jnp.asarray(mass[:, :rows]))
    assert float(whole.sum()) == pytest.approx(mass[used].sum(), rel=1e-5)
    assert np.abs(whole - alone).max() < ROUNDING
    inside, outside = np.split(read(network, cells_at(poses, used), whole), [rows], axis=1)
    assert np.abs(inside - read(network, cells_at(poses[:, :rows], used[:, :rows]), alone)).max() < ROUNDING
    assert not outside.any()


PERIODS = [factor * 1.25 * 9 * CELL * 2**n for n in range(5) for factor in (0.999, 1.001)]
LENGTH = st.floats(0, 1e9) | st.sampled_from(PERIODS)


@given(LENGTH, LENGTH)
def test_a_side_doubles_where_the_map_is_longer_than_a_period_and_a_quarter(x, y):
    network, expected = network_of(12, 9), []
    for length in (x, y):
        side = 9
        while length > 1.25 * side * CELL and side < 9 * 8:
            side *= 2
        expected.append(side)
    poses = np.array([[-1.0, 2.0, 0.0], [x - 1, 2.0, 1.0], [-1.0, y + 2, 0.0]])
    assert pose_cells.sides_for(network, poses) == tuple(expected)
    assert pose_cells.sides_for(network, poses[:1]) == pose_cells.sides_for(network, poses[:0]) == (9, 9)


@given(seeds, st.sampled_from([(22, 11), (11, 22), (44, 88)]))
def test_more_cells_read_the_same_where_no_places_share_one(seed, sides):
    stream, network = np.random.default_rng(seed), network_of(12, 11)
    poses = stream.uniform([2 * CELL, 2 * CELL, -9], [7 * CELL, 7 * CELL, 9], (2, 20, 3))
    mass = stream.dirichlet(np.full(41, 0.5))[:-1].reshape(2, 20)
    cells, motion = cells_at(poses), jnp.asarray(stream.uniform(-1, 1, 3) * [CELL, CELL, 3])
    before = dense.held(network, (12, 11, 11), poses, mass)
    silent = pose_cells.cover(network, before, sides)
    assert silent.activity.shape == (12, sides[1], sides[0])
    assert not np.asarray(silent.activity).any()
    assert np.array_equal(silent.mass, before.mass)
    after = dense.anchored(network, silent, cells, silent.mass)
    assert float(after.activity.sum()) == pytest.approx(float(before.activity.sum()), abs=1e-6)
    found = (dense.predictor(network, belief, cells, motion) for belief in (before, after))
    for one, other in zip(*found, strict=True):
        assert np.asarray(other) == pytest.approx(np.asarray(one), abs=1e-5)


PATH = np.array([[0.0, 0.0, 0.0], [1.5, 0.4, 1.0], [-0.8, -0.7, 2.0]])


def test_pieces_that_lie_apart_need_no_more_cells_than_the_largest():
    backend = RecallBackend(RecallBackendConfig(), (1, 8, 1))

    def sides(*pieces):
        apart = [compose(piece_start(k, backend.cell), piece) for k, piece in enumerate(pieces)]
        return backend.sides(MapFeedback(np.concatenate(apart), 0.0, 0.0, 0.0, 0.0, 0.0))

    large = PATH * [3, 1, 1]
    for count in (1, 2, 5):
        assert sides(*[PATH] * count) == (21, 21)
    assert sides(large) == sides(PATH, large) == (84, 21)
    assert sides(PATH * [60, 1, 1])[0] == 8 * 21


@given(seeds)
def test_mass_goes_to_the_row_and_direction_of_the_merged_keyframe(seed):
    belief, stream = random_case(seed).belief, np.random.default_rng(seed)
    shifts, rows = belief.mass.shape
    count = int(stream.integers(1, rows + 1))
    merged = random_merge(stream, count)
    mass = np.array(belief.mass) * (np.arange(rows) < count)
    after = pose_cells.merge_rows(belief._replace(mass=jnp.asarray(mass)), merged.onto, merged.offset)
    expected = np.zeros(mass.shape)
    for row, shift in np.ndindex(count, shifts):
        opposite = np.cos(merged.offset[row, 2]) < 0 and shifts > 1
        expected[shifts - 1 - shift if opposite else shift, merged.onto[row]] += mass[shift, row]
    assert np.asarray(after.mass) == pytest.approx(expected, abs=1e-6)
    assert float(after.mass.sum()) == pytest.approx(mass.sum(), abs=1e-6)
    assert np.array_equal(after.activity, belief.activity)  # until it is anchored again
    assert {leaf.dtype for leaf in after} == {np.dtype(np.float32)}


@given(seeds)
def test_mass_of_rows_that_are_gone_is_novelty(seed):
    case, stream = random_case(seed), np.random.default_rng(seed)
    rows = case.used.shape[1]
    left = stream.random(int(stream.integers(0, rows + 5))) < 0.6
    after = pose_cells.lose_rows(case.belief, left)
    kept = np.zeros(rows, bool)
    kept[: len(left)] = left[:rows]
    assert np.array_equal(after.mass, np.where(kept, case.belief.mass, 0))
    again = dense.anchored(case.network, after, cells_at(case.poses, case.used), after.mass)
    assert float(again.activity.sum()) == pytest.approx(float(after.mass.sum()), abs=1e-6)


def test_a_memory_without_view_cells_has_nothing_to_merge():
    network = network_of(12, 11)
    belief = pose_cells.start(network, (1, 0))
    merged = random_merge(np.random.default_rng(0), 1)
    assert pose_cells.merge_rows(belief, merged.onto, merged.offset) is belief
