"""Laws of the pose cells: ties, path integration, excitation, and the update as a hidden Markov model."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.network import pose_cells
from ratslam.network.pose_cells import Belief
from tactile.base.se2 import compose, inverse
from tests.ratslam.network.dense_network import (
    CELL,
    anchored,
    cells_at,
    driven,
    excited,
    held,
    network_of,
    predicted,
    predictor,
    random_case,
    silent,
    tie_matrix,
)

seeds = st.integers(0, 10_000)
ROUNDING = 5e-6
"""Largest error in single precision, at positions of up to tens of cells."""


def predict(case, poses=None, motion=None):
    """The prior of a case, at other poses or after another motion perhaps."""
    poses = case.poses if poses is None else poses
    motion = case.motion if motion is None else motion
    prior = predictor(case.network)(case.belief, cells_at(poses, case.used), jnp.asarray(motion))
    return jax.tree.map(lambda value: np.asarray(value, float), prior)


tie = jax.jit(pose_cells.tie, static_argnums=(0, 1))
drive = jax.jit(pose_cells.drive, static_argnums=(0, 1))
read, integrate_path = jax.jit(pose_cells.read, static_argnums=0), jax.jit(pose_cells.integrate_path)
excite = jax.jit(pose_cells.excite, static_argnums=0)
activity_at = jax.jit(pose_cells.activity_at, static_argnums=0)


# Ties


@given(seeds)
def test_what_view_cells_drive_and_what_they_read_are_adjoint(seed):
    case, stream = random_case(seed), np.random.default_rng(seed)
    cells = cells_at(case.poses, case.used)
    mass = stream.random(case.used.shape).astype(np.float32)
    activity = stream.random(case.shape).astype(np.float32)
    given_to = np.sum(np.asarray(drive(case.network, case.shape, cells, mass), float) * activity)
    got_from = np.sum(np.asarray(read(case.network, cells, jnp.asarray(activity)), float) * mass)
    assert given_to == pytest.approx(got_from, rel=ROUNDING)


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


@given(seeds, st.integers(-3, 3), st.integers(-3, 3), st.integers(-3, 3))
def test_places_whole_laps_apart_share_their_cells(seed, x, y, turns):
    case = random_case(seed)
    laps = np.array([x * case.shape[2] * CELL, y * case.shape[1] * CELL, turns * 2 * np.pi])
    here, there = (
        drive(case.network, case.shape, cells_at(poses, case.used), case.belief.mass)
        for poses in (case.poses, case.poses + laps)
    )
    assert np.abs(here - there).max() < ROUNDING


# Excitation


@pytest.mark.parametrize("sd", [0.01, 0.3, 0.5, 1.2, 5.0])
@pytest.mark.parametrize("size", [7, 8, 36])
def test_excitation_falls_from_one_at_both_sides(sd, size):
    weights = pose_cells.excitation(sd, size)
    assert len(weights) % 2
    assert len(weights) <= size
    assert weights[len(weights) // 2] == 1
    assert np.array_equal(weights, weights[::-1])
    assert (np.diff(weights[: len(weights) // 2 + 1]) > 0).all()
    near = min(1, len(weights) // 2)
    assert weights[len(weights) // 2 + near] == pytest.approx(np.exp(-((near / sd) ** 2) / 2), abs=0.1)


@given(seeds)
def test_excitation_is_that_of_cells_on_rings_and_its_own_adjoint(seed):
    case, stream = random_case(seed), np.random.default_rng(seed)
    one, other = stream.random((2, *case.shape)).astype(np.float32)
    found = np.asarray(excite(case.network, jnp.asarray(one)), float)
    assert found == pytest.approx(excited(case.network, one.astype(float)), rel=1e-5)
    back = np.asarray(excite(case.network, jnp.asarray(other)), float)
    assert np.sum(found * other) == pytest.approx(np.sum(one * back), rel=1e-5)


# Prediction


@given(seeds)
def test_prediction_conserves_mass(seed):
    """What a pose cell loses goes to the view cells that its excitation reaches, by its own density; only
    the leak, and what reaches none, is lost."""
    case = random_case(seed)
    found, lost = predict(case)
    activity = np.asarray(case.belief.activity, float)
    moved = integrate_path(cells_at(case.poses, case.used), jnp.asarray(case.motion))
    at = np.stack([np.asarray(value, float) for value in moved[:3]], axis=-1)
    ties = tie_matrix(case.network, case.shape, at, case.used)
    density = excited(case.network, ties.sum(axis=-1))
    stays = activity * density / (density + case.network.miss)
    assert found.min() >= 0
    assert lost >= 0
    assert not found[case.used == 0].any()
    assert found.sum() == pytest.approx((1 - case.network.leak) * stays.sum(), abs=ROUNDING)
    assert found.sum() + lost == pytest.approx(activity.sum(), abs=ROUNDING)


@given(seeds)
def test_prediction_is_the_transition_of_a_hidden_markov_model(seed):
    case = random_case(seed)
    found, lost = predict(case)
    expected, novel = predicted(case)
    assert found == pytest.approx(expected, abs=ROUNDING)
    assert lost == pytest.approx(novel, abs=ROUNDING)


def test_the_cases_reach_view_cells_and_miss_them():
    """Else the comparison with the matrices would say little."""
    shares = []
    for seed in range(40):
        case = random_case(seed)
        found, lost = predicted(case)
        shares.append([found.sum(), lost, case.belief.activity.sum()])
    found, lost, total = np.transpose(shares)
    assert (found > 0.3 * total).sum() > 10
    assert (lost > 0.3 * total).sum() > 10
    assert (found > 0.01).sum() > 25


# Path integration


@given(seeds)
def test_the_robot_that_moves_is_a_map_that_moves_the_other_way(seed):
    case = random_case(seed)
    there = compose(case.poses, inverse(case.motion))
    there[..., 2] = case.poses[..., 2] - case.motion[2]
    here, lost = predict(case)
    moved, left = predict(case, poses=there, motion=np.zeros(3))
    assert moved == pytest.approx(here, abs=ROUNDING)
    assert left == pytest.approx(lost, abs=ROUNDING)


@given(seeds, st.integers(2, 200))
def test_many_small_motions_are_one(seed, count):
    case, stream = random_case(seed), np.random.default_rng(seed)
    small = stream.normal(0, [0.1 * CELL, 0.05 * CELL, 0.05], (count, 3))
    whole = np.zeros(3)
    for one in small:
        whole = compose(whole, one)
    cells = cells_at(case.poses)
    by_steps = cells
    for one in small[::-1]:  # p m^-1 of motions a, b is p b^-1 a^-1
        by_steps = integrate_path(by_steps, jnp.asarray(one))
    at_once = integrate_path(cells, jnp.asarray(whole))
    for name in ("x", "y", "cosine", "sine"):
        found, expected = getattr(by_steps, name), getattr(at_once, name)
        assert np.abs(found - expected).max() < 3e-7 * count, name
    assert np.cos(by_steps.heading - by_steps.heading[0, 0]) == pytest.approx(
        np.cos(at_once.heading - at_once.heading[0, 0]), abs=1e-4
    )


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
        belief = held(network, shape, [[pose]], [[1.0]])
        rest = read(network, cells_at([[pose]]), belief.activity)
        there = cells_at([[compose(np.array(pose), motion)]])
        moved = integrate_path(there, jnp.asarray(motion))
        found = read(network, moved, belief.activity)
        assert float(found[0, 0]) == pytest.approx(whole or float(rest[0, 0]), abs=1e-4)
        prior, lost = predictor(network)(belief, there, jnp.asarray(motion))
        assert float(prior[0, 0]) > 0.9
        assert float(prior[0, 0] + lost) == pytest.approx(1, abs=ROUNDING)


@given(seeds)
def test_activity_is_read_where_the_preferred_poses_of_cells_have_moved(seed):
    """At rest every cell has its own activity; after a motion, that of the pose from which it comes."""
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


# The update


def update(case, likelihood, novelty, entered):
    """The belief and novelty after one view."""
    cells = cells_at(case.poses, case.used)
    found, lost = predictor(case.network)(case.belief, cells, jnp.asarray(case.motion))
    fresh = 1 - case.belief.activity.sum()
    mass, novel = pose_cells.inhibit(
        likelihood * (found + entered).astype(float), novelty * (fresh + lost - entered.sum()).astype(float)
    )
    return anchored(case.network)(case.belief, cells, mass), float(novel)


@given(seeds)
def test_the_update_is_that_of_a_hidden_markov_model(seed):
    case, stream = random_case(seed), np.random.default_rng(seed)
    likelihood, novelty = stream.exponential(1, case.used.shape) ** 3, stream.exponential(1)
    fresh = 1 - np.asarray(case.belief.activity, float).sum()
    entered = 0.1 * fresh * case.used / max(case.used.sum(), 1)
    belief, novel = update(case, likelihood, novelty, jnp.asarray(entered, jnp.float32))
    prior, lost = predicted(case)
    joint = likelihood * (prior + entered), novelty * (fresh + lost - entered.sum())
    total = joint[0].sum() + joint[1]
    assert np.asarray(belief.mass) == pytest.approx(joint[0] / total, abs=ROUNDING)
    assert novel == pytest.approx(joint[1] / total, abs=ROUNDING)
    assert np.asarray(belief.activity) == pytest.approx(driven(case, joint[0] / total), abs=ROUNDING)
    assert float(belief.activity.sum()) + novel == pytest.approx(1, abs=ROUNDING)


@given(seeds, st.floats(1e-6, 1e6))
def test_a_view_as_likely_everywhere_as_at_a_new_place_changes_no_odds(seed, likelihood):
    case = random_case(seed)
    found, lost = predict(case)
    novel = 1 - np.asarray(case.belief.activity, float).sum() + lost
    mass, after = pose_cells.inhibit(jnp.asarray(likelihood * found), jnp.asarray(likelihood * novel))
    assert np.asarray(mass) == pytest.approx(found, abs=ROUNDING)
    assert float(after) == pytest.approx(novel, abs=ROUNDING)


def test_views_that_are_nowhere_likely_leave_no_nan():
    mass, novel = pose_cells.inhibit(jnp.zeros((2, 3)), jnp.zeros(()))
    assert not np.asarray(mass).any()
    assert float(novel) == 0


ROW = np.stack([np.arange(8) * CELL, np.zeros(8), np.zeros(8)], axis=-1)
"""A path of view cells, one on each pose cell."""
HALL = 12, 21, 21


def two_packets(first, second, likelihood):
    """The masses of two packets at the begin of paths that do not meet, one step later."""
    network = network_of(12, 21)
    paths = np.stack([ROW, ROW + [0, 10 * CELL, 0]])
    mass = np.zeros((2, 8))
    mass[:, 2] = first, second
    belief, cells = held(network, HALL, paths, mass), cells_at(paths)
    for step in likelihood:
        prior, lost = predictor(network)(belief, cells, jnp.asarray([CELL, 0.0, 0.0]))
        novel = 1 - belief.activity.sum() + lost
        after, _ = pose_cells.inhibit(jnp.asarray(step, float) * prior.astype(float), novel.astype(float))
        belief = anchored(network)(belief, cells, after)
    return np.asarray(belief.mass, float)


def test_packets_keep_their_odds_under_equal_evidence():
    for gain in (0.2, 1.0, 5.0):
        one, other = two_packets(0.5, 0.1, [np.full((2, 8), gain)] * 3).sum(axis=1)
        assert one / other == pytest.approx(5, rel=1e-4)
        assert one > 1e-3
    ahead = two_packets(0.5, 0.1, [np.full((2, 8), 1.0)] * 3)
    assert (np.argmax(ahead, axis=1) == 5).all()


def test_a_view_that_contradicts_a_packet_removes_it():
    agree, contradict = np.ones((2, 8)), np.stack([np.full(8, 1e-3), np.ones(8)])
    one, other = two_packets(0.5, 0.1, [agree, contradict]).sum(axis=1)
    assert one < 0.01
    assert other > 0.09
    assert two_packets(0.5, 0.1, [agree, agree]).sum(axis=1)[0] > 0.4


def test_a_packet_where_no_view_cell_is_becomes_novelty():
    network = network_of(12, 21)
    belief = held(network, HALL, [ROW], np.eye(8)[None, 2])
    far = cells_at([ROW + [0, 5 * CELL, 0]])
    prior, lost = predictor(network)(belief, far, jnp.zeros(3))
    assert not np.asarray(prior).any()
    assert float(lost) == pytest.approx(1)


# Anchored on the map


@given(seeds)
def test_packets_move_with_the_keyframes_that_hold_them(seed):
    """After the map has moved every keyframe by itself, activity is where the same mass would drive it."""
    case, stream = random_case(seed), np.random.default_rng(seed)
    poses = case.poses + stream.normal(0, [CELL, CELL, 0.5], case.poses.shape)
    after = anchored(case.network)(case.belief, cells_at(poses, case.used), case.belief.mass)
    assert np.array_equal(after.mass, case.belief.mass)
    assert np.asarray(after.activity) == pytest.approx(
        driven(case._replace(poses=poses), case.belief.mass), abs=1e-5
    )
    assert float(after.activity.sum()) == pytest.approx(float(case.belief.activity.sum()), abs=ROUNDING)


@given(seeds, st.integers(-20, 20), st.integers(-20, 20), st.integers(-9, 9))
def test_a_map_moved_as_a_whole_predicts_the_same(seed, x, y, quarters):
    """By cells and quarter turns, in which the lattice comes to itself."""
    case = random_case(seed)
    shape = 12, case.shape[2], case.shape[2]
    case = case._replace(
        shape=shape, belief=held(case.network, shape, case.poses, case.belief.mass, case.used)
    )
    shift = np.array([x * CELL, y * CELL, quarters * np.pi / 2])
    poses = compose(shift, case.poses)
    belief = anchored(case.network)(case.belief, cells_at(poses, case.used), case.belief.mass)
    here, there = predict(case), predict(case._replace(belief=belief), poses=poses)
    for one, other in zip(here, there, strict=True):
        assert other == pytest.approx(one, abs=ROUNDING)


def test_at_the_start_all_is_novelty():
    network = network_of(12, 11)
    belief = pose_cells.start(network, (3, 5))
    assert belief.activity.shape == (12, 11, 11)
    assert belief.mass.shape == (3, 5)
    assert not any(np.asarray(leaf).any() for leaf in belief)
    assert {leaf.dtype for leaf in belief} == {np.dtype(np.float32)}
    found, lost = predictor(network)(belief, cells_at(np.zeros((3, 5, 3))), jnp.ones(3))
    assert not np.asarray(found).any()
    assert float(lost) == 0
    assert jax.tree.map(jnp.shape, belief) == jax.tree.map(jnp.shape, silent((12, 11, 11), (3, 5)))


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
    held_there = read(network, cells_at(poses, used), whole)
    assert (
        np.abs(held_there[:, :rows] - read(network, cells_at(poses[:, :rows], used[:, :rows]), alone)).max()
        < ROUNDING
    )
    assert not held_there[:, rows:].any()
