"""Laws of the attractor network."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.excitation_inhibition import make_window, ring_difference
from ratslam.classic.levels import Activity, Block, StepInput, step_at, to_full_torus, window_levels
from ratslam.classic.pose_cells import Outcome
from tactile.base.se2 import integrate
from tactile.base.types import Odometry

CONFIG = NetworkConfig()
UNITS = units(CONFIG, np.dtype(float))
RINGS = rings(CONFIG, np.dtype(float))


ROOMS = 32768, 131072
"""Largest numbers of steps of a compiled call."""
MOST = 5000
"""Steps of the slowest motions: 5 cells at 0.001 cells a step, as many at 0.01 degrees."""


@partial(jax.jit, static_argnames="config")
def steps_of(config, cells, motion, recall, energy, count):
    """The first `count` of motion in cells [T, 3]: poses [T, 3], outcomes [T], spreads [T, 3]."""
    levels = window_levels(config, np.dtype(motion.dtype))
    unit = units(config, np.dtype(motion.dtype))

    def step(k, carry):
        cells, poses, outcomes, spreads = carry
        odometry = Odometry(*(motion[k] * unit), jnp.ones((), motion.dtype))
        cells, (spread, outcome, _) = pose_cells.step(config, levels, cells, odometry, recall[k], energy[k])
        rows = poses.at[k].set(cells.pose), outcomes.at[k].set(outcome), spreads.at[k].set(spread)
        return cells, *rows

    empty = jnp.zeros_like(motion), jnp.zeros(len(motion), jnp.int32), jnp.zeros_like(motion)
    return jax.lax.fori_loop(0, count, step, (cells, *empty))


def go(motion, cells=None, injections=None, config=CONFIG, dtype=float):
    motion = np.asarray(motion, dtype)
    count = len(motion)
    room = next(room for room in ROOMS if room >= count)
    motion = np.pad(motion, ((0, room - count), (0, 0)))
    recall, energy = np.zeros((room, 3), dtype), np.zeros(room, dtype)
    for k, (at, how_much) in (injections or {}).items():
        recall[k], energy[k] = at, how_much
    cells = cells if cells is not None else pose_cells.start(config, np.dtype(dtype))
    after, *outputs = steps_of(config, cells, motion, recall, energy, np.int32(count))
    return after, tuple(np.asarray(output)[:count] for output in outputs)


def with_activity(cells, activity):
    """The state with the activity [K, N, N] of the whole torus replaced."""
    whole = Block(activity[None], jnp.zeros((1, 3), jnp.int32))
    below = cells.activity.blocks[:-1]
    return cells._replace(activity=Activity((*below, whole), jnp.int32(len(below))))


@jax.jit
def whole(cells):
    return to_full_torus(window_levels(CONFIG, cells.pose.dtype), cells.activity)


def deposited(activity, at, energy):
    torus = make_window(CONFIG, None, np.dtype(float))
    return torus.deposit(activity, jnp.zeros(3, jnp.int32), at, jnp.asarray(energy))


@pytest.fixture(scope="module")
def settled():
    return go(np.zeros((50, 3)))[0]


def travelled(start, poses):
    path = np.vstack([start, poses])
    return np.stack([np.unwrap(path[:, a], period=RINGS[a]) for a in range(3)], 1)[-1] - np.asarray(start)


def motions():
    """Speeds, cells a step, and directions, degrees; most directions of the slowest for the soak."""
    for speed in (0.001, 0.01, 0.1, 0.5, 1.7, 5.0):
        for direction in (0, 25, 45, 130, 270):
            seldom = pytest.mark.soak if speed < 0.1 and direction != 25 else ()
            yield pytest.param(speed, direction, marks=seldom)


@pytest.mark.parametrize(("speed", "direction"), list(motions()))
def test_decoded_motion_equals_odometry(settled, speed, direction):
    angle = np.deg2rad(direction)
    count = int(np.ceil(min(20 / speed, MOST)))
    _, (poses, outcomes, _) = go(
        np.tile([speed * np.cos(angle), speed * np.sin(angle), 0], (count, 1)), settled
    )
    moved = travelled(settled.pose, poses)
    heading = float(settled.pose[2]) * UNITS[2]
    expected = count * speed * np.array([np.cos(angle + heading), np.sin(angle + heading)])
    assert np.hypot(*(moved[:2] - expected)) <= 0.02 * np.hypot(*expected)
    assert not np.any(outcomes)


@pytest.mark.parametrize(("speed", "substeps"), [(0.51, 1), (0.75, 1), (0.76, 2), (1.5, 2)])
def test_a_step_takes_as_few_substeps_as_keep_the_packet_whole(settled, speed, substeps):
    still = settled._replace(lag=jnp.zeros(3))
    motion, zero = jnp.asarray([speed, 0.0, 0.0]), jnp.zeros(3)
    inputs = StepInput(
        still.pose, still.pose, jnp.zeros(()), jnp.int32(substeps), motion / substeps, zero, zero[2]
    )
    smallest = window_levels(CONFIG, np.dtype(float))[0]
    _, result, exact = jax.jit(partial(step_at, smallest))(still.activity.blocks[0], inputs)
    assert exact
    assert np.abs(go([motion], still)[1][0][0] - result[0]).max() < 1e-12


@pytest.mark.parametrize("degrees", [0.01, 0.1, 1, 7, 10, 33, 60, -60, -0.05])
def test_decoded_turning_equals_odometry(settled, degrees):
    count = int(np.ceil(min(200 / abs(degrees), MOST)))
    _, (poses, _, _) = go(np.tile([0, 0, np.deg2rad(degrees) / UNITS[2]], (count, 1)), settled)
    assert travelled(settled.pose, poses)[2] == pytest.approx(count * degrees / 10, rel=0.02)


@pytest.mark.parametrize("degrees", [1.0, -7.0, 20.0, 45.0])
@pytest.mark.parametrize("speed", [0.05, 0.5, 1.7])
def test_a_curve_ends_where_composed_odometry_ends(settled, speed, degrees):
    """Odometry is the new pose in the frame of the old one, in the network as in the map."""
    steps = int(np.ceil(180 / abs(degrees)))
    motion = np.tile([speed, 0.2 * speed, np.deg2rad(degrees) / UNITS[2]], (steps, 1))
    _, (poses, _, _) = go(motion, settled)
    start = np.asarray(settled.pose) * [1, 1, UNITS[2]]
    end = integrate(motion * [1, 1, UNITS[2]], start)[-1]
    assert np.hypot(*(travelled(settled.pose, poses)[:2] - (end - start)[:2])) < 0.02 * speed * steps + 0.1


def test_a_circle_closes(settled):
    steps = 100
    turn = 36 / steps
    motion = np.tile([0.4, 0.1, turn], (steps, 1))
    _, (poses, _, _) = go(motion, settled)
    assert np.abs(travelled(settled.pose, poses) - [0, 0, 36]).max() < 0.15


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.floats(-5, 5), st.floats(-5, 5), st.floats(-6, 6))
def test_any_activity_becomes_a_distribution(seed, dx, dy, turn):
    stream = np.random.default_rng(seed)
    activity = stream.random((36, 21, 21)) * (stream.random((36, 21, 21)) < stream.random())
    cells = with_activity(pose_cells.start(CONFIG, np.dtype(float)), jnp.asarray(activity))
    after, (poses, _, spread) = go([[dx, dy, turn]] * 3, cells)
    assert float(whole(after).sum()) == pytest.approx(1)
    assert float(whole(after).min()) >= 0
    assert np.isfinite(poses).all()
    assert np.isfinite(spread).all()
    assert ((poses >= 0) & (poses < RINGS)).all()


@pytest.mark.parametrize("level", [0.0, 1e-9, 1 / (36 * 21 * 21), 1.0])
def test_uniform_activity_dies_out_and_is_reseeded(settled, level):
    cells = with_activity(settled, np.full((36, 21, 21), level))
    after, (poses, outcomes, _) = go(np.zeros((3, 3)), cells)
    assert outcomes[0] == Outcome.RESEEDED
    assert not np.any(outcomes[1:])
    assert np.abs(ring_difference(poses[-1] - np.asarray(settled.pose), RINGS)).max() < 0.01
    assert float(whole(after).sum()) == pytest.approx(1)


@settings(max_examples=20)
@given(st.tuples(*[st.floats(0, 1, exclude_max=True)] * 3))
def test_a_deposit_between_cells_is_excited_like_one_on_a_cell(share):
    """The peak of a deposit at its own point, read off between cells, does not depend on where it falls."""
    pose = jnp.asarray([10.0, 10.0, 18.0]) + jnp.asarray(share)
    energy = make_window(CONFIG, None, np.dtype(float)).deposit_gain(pose)
    assert 1 - 1e-9 <= float(energy) <= 1.5
    total = float(deposited(jnp.zeros((36, 21, 21)), pose % RINGS, 1.0).sum())
    assert total == pytest.approx(1)


@pytest.mark.parametrize("shift", [(5, 0, 0), (0, 7, 0), (0, 0, 9), (20, 20, 35)])
def test_the_torus_has_no_edge(shift):
    """The same motion from another place of the torus gives a shifted copy."""
    stream = np.random.default_rng(1)
    motion = stream.normal(0, 0.7, (40, 3))
    here = pose_cells.start(CONFIG, np.dtype(float))
    there = with_activity(here, jnp.roll(whole(here), shift[::-1], (0, 1, 2)))
    there = there._replace(pose=(here.pose + np.array(shift, float)) % RINGS)
    if shift[2]:
        motion[:, :2] = 0  # another heading gives another direction
    first, (a, _, _) = go(motion, here)
    second, (b, _, _) = go(motion, there)
    assert np.abs(ring_difference(b - a - shift, RINGS)).max() < 1e-9
    assert np.allclose(jnp.roll(whole(first), shift[::-1], (0, 1, 2)), whole(second), atol=1e-10)


@pytest.mark.parametrize("n", [11, 17, 18, 21, 22, 23, 41])
def test_excitation_and_inhibition_are_the_same_everywhere(n):
    """Rings are computed in different ways by size, and none may show where it begins."""
    torus = make_window(NetworkConfig(cells_xy=n), None, np.dtype(float))
    activity = np.random.default_rng(n).random((36, n, n)) ** 8
    compute = jax.jit(torus.excite_and_inhibit)
    here = compute(activity)
    assert np.any(np.asarray(here)[:, :, [0, -1]] > 0)
    for shift in ((0, 0, 1), (0, 0, n // 2), (5, 7, 3)):
        there = compute(np.roll(activity, shift, (0, 1, 2)))
        assert np.abs(np.roll(here, shift, (0, 1, 2)) - there).max() <= 1e-15


@pytest.mark.parametrize("energy", [0.15, 0.3])
@pytest.mark.parametrize("distance", [0.7, 2.3, 4.0, 7.0])
@pytest.mark.parametrize("speed", [0.0, 0.02])
def test_feedback_never_undoes_a_closure(settled, speed, distance, energy):
    """An injection moves the packet as far with lag feedback as without."""
    at = (np.asarray(settled.pose) + [0, distance, 0.4]) % RINGS
    injections = {0: (at, energy), 1: (at, 0.7 * energy)}
    motion = np.tile([speed, 0, 0], (80, 1))
    open_loop = CONFIG.model_copy(update={"settle_steps": 10**6})
    _, (free, _, _) = go(motion, settled, injections, open_loop)
    _, (fed, _, _) = go(motion, settled, injections)
    pulled, actual = travelled(settled.pose, free)[1], travelled(settled.pose, fed)[1]
    assert abs(actual - pulled) < 0.3
    if abs(pulled) > 0.5:
        assert actual > 0.85 * pulled


def test_a_hundred_injections_at_once_settle():
    stream = np.random.default_rng(3)
    cells = pose_cells.start(CONFIG, np.dtype(float))
    activity = whole(cells)
    for at in stream.random((100, 3)) * RINGS:
        activity = deposited(activity, jnp.asarray(at), 0.15)
    after, (poses, outcomes, _) = go(np.zeros((150, 3)), with_activity(cells, activity))
    assert float((whole(after) > 0).sum()) < 500
    assert np.isfinite(poses).all()
    assert not np.any(outcomes)


def test_too_much_motion_is_limited_and_reported(settled):
    after, (poses, outcomes, _) = go([[1e6, 0, 0], [0, 0, 1e9]], settled)
    assert list(outcomes) == [Outcome.TOO_FAST] * 2
    assert np.isfinite(poses).all()
    assert float(whole(after).min()) >= 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_standing_still_stays(settled, dtype):
    start = jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype == float else leaf, settled)
    _, (poses, outcomes, _) = go(np.zeros((2000, 3)), start, dtype=dtype)
    assert np.abs(np.asarray(poses[-1]) - np.asarray(settled.pose)).max() < 1e-3
    assert not np.any(outcomes)


@pytest.mark.soak
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_standing_still_for_a_hundred_thousand_steps(settled, dtype):
    start = jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype == float else leaf, settled)
    _, (poses, outcomes, _) = go(np.zeros((100_000, 3)), start, dtype=dtype)
    assert np.abs(np.asarray(poses[-1]) - np.asarray(settled.pose)).max() < 1e-3
    assert np.isfinite(poses).all()
    assert not np.any(outcomes)


def test_float32_makes_the_same_step(settled):
    """Both precisions start each step from the same state, because long sequences diverge (weak chaos)."""
    stream = np.random.default_rng(5)
    cells, worst_pose, worst_activity = settled, 0.0, 0.0
    for _ in range(100):
        motion = stream.normal(0, 0.5, (1, 3))
        inject = {0: (stream.random(3) * RINGS, 0.1)} if stream.random() < 0.1 else {}
        narrow = jax.tree.map(lambda leaf: leaf.astype(np.float32) if leaf.dtype == float else leaf, cells)
        low, (pose32, _, _) = go(motion, narrow, inject, dtype=np.float32)
        cells, (pose64, _, _) = go(motion, cells, inject)
        gap = ring_difference(np.asarray(pose32[0], float) - np.asarray(pose64[0]), RINGS)
        worst_pose = max(worst_pose, np.abs(gap).max())
        worst_activity = max(
            worst_activity, float(np.abs(np.asarray(whole(low), float) - np.asarray(whole(cells))).max())
        )
    assert worst_pose <= 5e-6
    assert worst_activity <= 1e-7
