"""Laws of the attractor network; at every level of its window it equals that on the whole torus."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.classic import levels as hold
from ratslam.classic import pose_cells
from ratslam.classic.cell_probe import active_cells, activity_of, choose_cells, hold_cells
from ratslam.classic.config import NetworkConfig, rings, units
from ratslam.classic.excitation_inhibition import make_window, ring_difference
from ratslam.classic.levels import Activity, Block, StepInput, step_at, to_full_torus, window_levels
from ratslam.classic.pose_cells import Outcome
from tactile.base.errors import InputError
from tactile.base.se2 import integrate
from tactile.base.types import Odometry
from tests.oracle.stock import Attractor
from tests.oracle.trace import Parameters

CONFIG = NetworkConfig()
UNITS = units(CONFIG, np.dtype(float))
RINGS = rings(CONFIG, np.dtype(float))
ROOMS = 32768, 131072
"""Largest numbers of steps of a compiled call."""
MOST = 5000
"""Steps of the slowest motions: 5 cells at 0.001 cells a step, as many at 0.01 degrees."""


@partial(jax.jit, static_argnames="config")
def steps_of(config, cells, motion, recall, energy, count):
    """The first `count` steps of motion in cells [T, 3]: poses, spreads [T, 3], outcomes and levels [T]."""
    levels, unit = window_levels(config, np.dtype(motion.dtype)), units(config, np.dtype(motion.dtype))

    def step(k, carry):
        cells, *rows = carry
        odometry = Odometry(*(motion[k] * unit), jnp.ones((), motion.dtype))
        cells, info = pose_cells.step(config, levels, cells, odometry, recall[k], energy[k])
        return cells, *(row.at[k].set(value) for row, value in zip(rows, (cells.pose, *info), strict=True))

    whole = jnp.zeros(len(motion), jnp.int32)
    empty = jnp.zeros_like(motion), jnp.zeros_like(motion), whole, whole
    return jax.lax.fori_loop(0, count, step, (cells, *empty))


def run(config, cells, motion, recall, energy):
    """As `steps_of`, by a call that is compiled for this number of steps or more."""
    count = len(motion)
    more = next(room for room in ROOMS if room >= count) - count
    rows = (np.pad(row, [(0, more)] + [(0, 0)] * (row.ndim - 1)) for row in (motion, recall, energy))
    after, *outputs = steps_of(config, cells, *rows, np.int32(count))
    return after, *(np.asarray(output)[:count] for output in outputs)


def go(motion, cells=None, injections=None, config=CONFIG, dtype=float):
    """The cells after a motion; poses, outcomes and spreads of its steps."""
    motion = np.asarray(motion, dtype)
    recall, energy = np.zeros_like(motion), np.zeros(len(motion), dtype)
    for k, (at, how_much) in (injections or {}).items():
        recall[k], energy[k] = at, how_much
    cells = cells if cells is not None else pose_cells.start(config, np.dtype(dtype))
    after, poses, spreads, outcomes, _ = run(config, cells, motion, recall, energy)
    return after, (poses, outcomes, spreads)


def with_activity(cells, activity):
    """The state with the activity [K, N, N] of the whole torus replaced."""
    whole = Block(activity[None], jnp.zeros((1, 3), jnp.int32))
    below = cells.activity.blocks[:-1]
    return cells._replace(activity=Activity((*below, whole), jnp.int32(len(below))))


def as_type(cells, dtype):
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype == float else leaf, cells)


@partial(jax.jit, static_argnames="config")
def whole(cells, config=CONFIG):
    return to_full_torus(window_levels(config, cells.pose.dtype), cells.activity)


@pytest.fixture(scope="module")
def settled():
    return go(np.zeros((50, 3)))[0]


def travelled(start, poses):
    path = np.vstack([start, poses])
    return np.stack([np.unwrap(path[:, a], period=RINGS[a]) for a in range(3)], 1)[-1] - np.asarray(start)


@pytest.mark.parametrize(
    ("speed", "direction", "degrees"),
    [
        *((speed, direction, 0) for speed in (0.001, 0.01, 0.1, 0.5, 1.7, 5.0) for direction in (25, 130)),
        *((0.0, 0, degrees) for degrees in (0.01, 0.1, 1, 7, 10, 33, 60, -60, -0.05)),
        *((speed, 11, degrees) for speed in (0.05, 0.5, 1.7) for degrees in (1, -7, 45)),
    ],
)
def test_decoded_motion_equals_composed_odometry(settled, speed, direction, degrees):
    angle, count = np.deg2rad(direction), min(200 / abs(degrees) if degrees else 20 / speed, MOST)
    one = np.array([speed * np.cos(angle), speed * np.sin(angle), np.deg2rad(degrees) / UNITS[2]])
    motion, scale = np.tile(one, (int(np.ceil(count)), 1)), [1, 1, UNITS[2]]
    _, (poses, outcomes, _) = go(motion, settled)
    moved, start = travelled(settled.pose, poses), np.asarray(settled.pose) * scale
    end = integrate(motion * scale, start)[-1]
    off = np.hypot(*(moved[:2] - (end - start)[:2]))
    assert off <= 0.02 * speed * len(motion) + (0.1 if degrees else 0)
    assert moved[2] == pytest.approx(len(motion) * one[2], rel=0.02, abs=0.1)
    assert not np.any(outcomes)


@pytest.mark.parametrize(("speed", "substeps"), [(0.51, 1), (0.75, 1), (0.76, 2), (1.5, 2)])
def test_a_step_takes_as_few_substeps_as_keep_the_packet_whole(settled, speed, substeps):
    still = settled._replace(lag=jnp.zeros(3))
    motion, zero = jnp.asarray([speed, 0.0, 0.0]), jnp.zeros(3)
    count = jnp.int32(substeps)
    inputs = StepInput(still.pose, still.pose, zero[2], count, motion / substeps, zero, zero[2])
    smallest = window_levels(CONFIG, np.dtype(float))[0]
    _, result, exact = jax.jit(partial(step_at, smallest))(still.activity.blocks[0], inputs)
    assert exact
    assert np.abs(go([motion], still)[1][0][0] - result[0]).max() < 1e-12


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


@pytest.mark.parametrize("n", [11, 17, 18, 21, 22, 23, 41])
def test_excitation_and_inhibition_are_those_of_the_plain_engine(n):
    """Rings are computed in different ways by size."""
    torus = make_window(NetworkConfig(cells_xy=n), None, np.dtype(float))
    activity = np.random.default_rng(n).random((36, n, n)) ** 8
    expected = Attractor(Parameters(pc_dim_xy=n)).inhibited(activity)
    assert np.any(expected[:, :, [0, -1]] > 0)
    assert np.abs(jax.jit(torus.excite_and_inhibit)(activity) - expected).max() <= 1e-15


@pytest.mark.parametrize("energy", [0.15, 0.3])
@pytest.mark.parametrize("distance", [0.7, 2.3, 4.0, 7.0])
def test_feedback_never_undoes_a_closure(settled, distance, energy):
    at = (np.asarray(settled.pose) + [0, distance, 0.4]) % RINGS
    injections, motion = {0: (at, energy), 1: (at, 0.7 * energy)}, np.tile([0.02, 0, 0], (80, 1))
    open_loop = CONFIG.model_copy(update={"settle_steps": 10**6})
    runs = (go(motion, settled, injections, config)[1][0] for config in (open_loop, CONFIG))
    pulled, actual = (travelled(settled.pose, poses)[1] for poses in runs)
    assert abs(actual - pulled) < 0.3
    if abs(pulled) > 0.5:
        assert actual > 0.85 * pulled


def test_too_much_motion_is_limited_and_reported(settled):
    after, (poses, outcomes, _) = go([[1e6, 0, 0], [0, 0, 1e9]], settled)
    assert list(outcomes) == [Outcome.TOO_FAST] * 2
    assert np.isfinite(poses).all()
    assert float(whole(after).min()) >= 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("steps", [2000, pytest.param(100_000, marks=pytest.mark.soak)])
def test_standing_still_stays(settled, dtype, steps):
    _, (poses, outcomes, _) = go(np.zeros((steps, 3)), as_type(settled, dtype), dtype=dtype)
    assert np.abs(poses[-1] - np.asarray(settled.pose)).max() < 1e-3
    assert np.isfinite(poses).all()
    assert not np.any(outcomes)


def test_float32_makes_the_same_step(settled):
    """Both precisions start each step from the same state, because long sequences diverge (weak chaos)."""
    stream = np.random.default_rng(5)
    cells, worst_pose, worst_activity = settled, 0.0, 0.0
    for _ in range(100):
        motion = stream.normal(0, 0.5, (1, 3))
        inject = {0: (stream.random(3) * RINGS, 0.1)} if stream.random() < 0.1 else {}
        low, (pose32, _, _) = go(motion, as_type(cells, np.float32), inject, dtype=np.float32)
        cells, (pose64, _, _) = go(motion, cells, inject)
        gap = ring_difference(np.asarray(pose32[0], float) - np.asarray(pose64[0]), RINGS)
        worst_pose = max(worst_pose, np.abs(gap).max())
        difference = np.asarray(whole(low), float) - np.asarray(whole(cells))
        worst_activity = max(worst_activity, np.abs(difference).max())
    assert worst_pose <= 5e-6
    assert worst_activity <= 1e-7


LEVELS_OF = {11: 2, 21: 2, 41: 3, 61: 4}
"""Cells per side, and the number of window levels there."""


def compare(n, motion, recall, energy):
    moving = NetworkConfig(cells_xy=n)
    dense = moving.model_copy(update={"engine": "dense"})
    (one, pose, spread, outcome, level), (all_, whole_pose, whole_spread, whole_outcome, whole_level) = (
        run(config, pose_cells.start(config, np.dtype(float)), motion, recall, energy)
        for config in (moving, dense)
    )
    ring = rings(moving, np.dtype(float))
    rounding = 1e-16 * max(len(motion), 100)  # 1.5e-14 of activity, 1.4e-12 cells were found in 1,000 steps
    assert np.abs(ring_difference(pose - whole_pose, ring)).max() <= 100 * rounding
    assert np.nanmax(np.abs(spread - whole_spread)) <= 1e-9
    assert np.array_equal(outcome, whole_outcome)
    assert not np.any(whole_level)
    gap = whole(one, moving) - whole(all_, dense)
    assert float(jnp.abs(gap).max()) <= rounding
    return level


places = [st.floats(-12, 12), st.floats(-12, 12), st.floats(-18, 18)]
injection = st.tuples(st.integers(0, 119), *places, st.floats(1e-9, 3))


@settings(max_examples=3 if settings.default.max_examples < 100 else 30)  # more in the soak
@given(st.lists(injection, max_size=8), st.floats(-1, 1), st.floats(-1, 1))
def test_injections_at_any_distance_from_the_packet_are_exact(planted, speed, turn):
    motion = np.tile([speed, 0.0, turn], (120, 1))
    recall, energy = np.zeros((120, 3)), np.zeros(120)
    for k, x, y, heading, how_much in planted:
        recall[k], energy[k] = (np.array([20.0, 20.0, 18.0]) + [x, y, heading]) % [41, 41, 36], how_much
    compare(41, motion, recall, energy)


@pytest.mark.parametrize("n", [*(pytest.param(n, marks=pytest.mark.soak) for n in (11, 21, 61)), 41])
def test_activity_too_large_for_a_level_moves_up(n):
    """A distant injection opens a second window, three need the torus, and finally one window is enough."""
    energy, recall = np.zeros(600), np.zeros((600, 3))
    energy[20] = energy[100:103] = 0.15
    recall[20], recall[100:103] = [1, n // 2, 3], [[1, 1, 1], [n // 2, 1, 30], [1, n // 2, 10]]
    level = compare(n, np.zeros((600, 3)), recall, energy)
    top = LEVELS_OF[n] - 1
    assert len(window_levels(NetworkConfig(cells_xy=n), np.dtype(float))) == LEVELS_OF[n]
    assert not np.any(level[:20])
    assert level[20] == (1 if top > 1 else top)
    assert level[102] == top
    assert level[-1] == 0


@pytest.mark.parametrize(("away", "exact"), [(2.0, True), (4.5, False), (9.0, False)])
def test_a_small_window_refuses_a_deposit_near_its_face(away, exact):
    sizes, zero = window_levels(CONFIG, np.dtype(float)), jnp.zeros(3)
    pose = jnp.asarray([10.0, 10.0, 18.0])
    activity, there = hold.point_activity(sizes, pose), pose + jnp.asarray([away, 0.0, 0.0])
    inputs = StepInput(pose, there, jnp.asarray(0.3), jnp.int32(1), zero, zero, zero[2])
    assert bool(jax.jit(partial(step_at, sizes[0]))(activity.blocks[0], inputs)[2]) == exact


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
    stream, steps = np.random.default_rng(seed), 1000
    motion = stream.normal(0, speed, (steps, 3)) * [1, 0.3, 0.5]
    energy = np.where(stream.random(steps) < often, stream.choice([0.02, 0.1, 0.5, 2.0], steps), 0.0)
    level = compare(n, motion, stream.random((steps, 3)) * [n, n, 36], energy)
    if often == 0:
        assert not np.any(level)


WIDE = NetworkConfig(cells_xy=45, cells_heading=72)
TORUS = (72, 45, 45)
LEVELS = window_levels(WIDE, np.dtype(np.float64))
DENSE = window_levels(WIDE.model_copy(update={"engine": "dense"}), np.dtype(np.float64))


def random_activity(levels, number):
    """Activity in every block, of which that of one level is valid, in windows over the seams."""
    random, blocks = np.random.default_rng(number), []
    for level in levels:
        cells = random.random((level.windows, *level.window.shape))
        whole = level is levels[-1]
        origin = np.zeros((1, 3)) if whole else random.integers(0, (45, 45, 72), (level.windows, 3))
        blocks.append(Block(jnp.asarray(cells), jnp.asarray(origin, jnp.int32)))
    return Activity(tuple(blocks), jnp.int32(number))


@pytest.mark.parametrize(("levels", "number"), [*((LEVELS, k) for k in range(4)), (DENSE, 0)])
def test_chosen_and_all_cells_and_sums_are_those_of_the_torus(levels, number):
    activity = random_activity(levels, number)
    full = np.asarray(to_full_torus(levels, activity))
    torus = full.reshape(-1)
    assert len(LEVELS) == 4
    assert (torus > 0).any()
    everything = np.arange(len(torus), dtype=np.int32)
    np.testing.assert_array_equal(activity_of(levels, activity, everything), torus)
    assert activity_of(levels, activity, everything[:0]).shape == (0,)
    chosen = choose_cells(50, TORUS, seed=number)
    np.testing.assert_array_equal(activity_of(levels, activity, chosen), torus[chosen])
    held = jax.device_get(jax.jit(lambda: hold_cells(levels, activity))())
    cell, active = active_cells(levels, held)
    assert (active > 0).all()
    np.testing.assert_allclose(np.bincount(cell, active, len(torus)), torus, rtol=1e-6)
    if levels is LEVELS:
        sums = hold.activity_sums(levels, activity)
        np.testing.assert_allclose(sums.xy, full.sum(axis=0), rtol=1e-12)
        np.testing.assert_allclose(sums.heading, full.sum(axis=(1, 2)), rtol=1e-12)


def test_cells_are_drawn_by_the_seed_without_repetition_and_given_ones_keep_their_order():
    one, again, other = (choose_cells(64, TORUS, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    assert len(np.unique(one)) == 64
    assert one.dtype == np.int32
    np.testing.assert_array_equal(choose_cells(7 * 7 * 8, (8, 7, 7), 0), np.arange(7 * 7 * 8))
    given = ((44, 0, 0), (1, 2, 3), (0, 44, 71))
    heading, y, x = np.unravel_index(choose_cells(given, TORUS, 0), TORUS)
    assert tuple(zip(x.tolist(), y.tolist(), heading.tolist(), strict=True)) == given


@pytest.mark.parametrize(
    ("chosen", "where"),
    [(145_801, ""), (((0, 0, 0), (45, 0, 0)), ".1"), (((0, 45, 0),), ".0"), (((0, 0, 72),), ".0")],
)
def test_cells_outside_the_network_are_refused(chosen, where):
    with pytest.raises(InputError, match=rf"cells\.chosen{where}: .*expected"):
        choose_cells(chosen, TORUS, 0)
