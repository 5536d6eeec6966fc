"""Laws of particles: motion and its errors, weights, resampling, maps, genealogy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from ratslam.grid import particles
from ratslam.grid.config import DriftConfig, ResamplingConfig
from ratslam.grid.particles import LAYERS, Genealogy, Particles
from tactile.base.se2 import compose, wrap
from tactile.base.types import Odometry
from tests.helpers.grid_world import STEADY

SYSTEMATIC = ResamplingConfig()
MULTINOMIAL = ResamplingConfig(scheme="multinomial")
COUNT = 16

placing = jax.jit(particles.assign_copies)


def placed(offspring):
    return jax.tree.map(np.asarray, placing(jnp.asarray(offspring, jnp.int32)))


def swarm(poses, dtype=float, session=0.0):
    poses = jnp.asarray(poses, dtype)
    scales = jnp.full((len(poses), 2), session, dtype)
    return Particles(poses, scales, jnp.zeros_like(scales), jnp.zeros(len(poses), dtype))


def odometry(dx, dy, dtheta, dtype=float):
    return Odometry(*(jnp.asarray(value, dtype) for value in (dx, dy, dtheta, 0.5)))


moved = jax.jit(particles.move, static_argnums=0)
EXACT, STILL = DriftConfig(**STEADY), jnp.bool_(False)


def drifting(**changes):
    return EXACT.model_copy(update=changes)


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=1, max_size=8))
def test_odometry_without_noise_is_composed(motions):
    expected, group = np.array([0.3, -0.2, 2.5]), swarm([[0.3, -0.2, 2.5]] * 2)
    for k, motion in enumerate(motions):
        group = moved(EXACT, group, odometry(*motion), jnp.bool_(k % 2), jax.random.key(k))
        expected = compose(expected, np.array(motion))
    off = np.asarray(group.pose) - expected
    assert off[:, :2] == pytest.approx(0, abs=1e-9)
    assert wrap(off[:, 2]) == pytest.approx(0, abs=1e-9)


def test_a_particle_scales_odometry_by_its_own_errors():
    group = swarm([[0, 0, np.pi / 2]] * 2)._replace(
        session=jnp.array([[0.1, -0.2], [0.0, 0.0]]), move=jnp.array([[0.05, 0.1], [-0.5, 0.0]])
    )
    driven = moved(EXACT, group, odometry(2, 0, 0), STILL, jax.random.key(0))
    assert driven.pose[:, 1] == pytest.approx([2 * 1.15, 2 * 0.5])
    assert driven.pose[:, 0] == pytest.approx(0, abs=1e-12)
    turned = moved(EXACT, group, odometry(0, 0, 1), STILL, jax.random.key(0))
    assert turned.pose[:, 2] - np.pi / 2 == pytest.approx([0.9, 1.0])
    assert turned.pose[:, :2] == pytest.approx(0, abs=1e-12)


def test_scale_errors_persist_over_session_movement_or_step():
    """Size: 12 variances and correlations of 40 000 particles within 4.5 standard errors: 1e-4."""
    count, config = 40_000, drifting(session=0.05, move=0.03)
    group = particles.start(config, jax.random.key(0), count, np.dtype(float))
    assert not np.any(group.pose)
    scales, groups = [], []
    for k, changed in enumerate([True, False, True]):
        before = group.pose
        group = moved(config, group, odometry(1, 0, 0), jnp.bool_(changed), jax.random.key(k + 1))
        scales.append(np.asarray(group.pose - before)[:, 0] - 1)
        groups.append(group)
    first, second, third = groups
    assert np.array_equal(first.session, third.session)
    assert np.array_equal(first.move, second.move)
    assert np.all(first.move != third.move)
    assert scales[1] == pytest.approx(scales[0], abs=1e-12)
    error = 4.5 / np.sqrt(count)
    covariance = 0.05**2 * np.ones((2, 2)) + 0.03**2 * np.eye(2)
    sizes = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)) + covariance**2)
    assert (np.abs(np.cov(scales[0], scales[2]) - covariance) <= error * sizes).all()
    for scale, sd in ((first.session, 0.05), (first.move, 0.03)):
        assert np.corrcoef(scale.T)[0, 1] == pytest.approx(0, abs=error)
        assert np.std(scale, axis=0) == pytest.approx(sd, rel=error)


def test_noise_of_each_step_has_the_configured_scale():
    """Size: 8 means and variances of 40 000 particles within 4.5 standard errors: 1e-4."""
    count, config = 40_000, drifting(step=0.02, heading=5e-4)
    error, group = 4.5 / np.sqrt(count), swarm(np.zeros((count, 3)))

    def after(dx, dtheta):
        ahead = odometry(dx, 0, dtheta)
        return np.asarray(moved(config, group, ahead, jnp.bool_(True), jax.random.key(1)).pose)

    straight, turn, still = after(0.5, 0.0), after(0.0, -0.8), after(0.0, 0.0)
    moments = [
        (straight[:, 0], 0.5, 0.01), (straight[:, 2], 0.0, 5e-4), (straight[:, 1], 0.0, 0.5 * 2.5e-4),
        (turn[:, 2], -0.8, np.hypot(0.016, 5e-4)), (still[:, 2], 0.0, 5e-4),
    ]  # fmt: skip
    for value, mean, sd in moments:
        assert value.mean() == pytest.approx(mean, abs=error * sd)
        assert value.std() == pytest.approx(sd, rel=error)
    assert not turn[:, :2].any()
    assert not still[:, :2].any()


def test_turning_on_the_spot_for_ever_keeps_the_heading_in_float32():
    turn, key = odometry(0, 0, 0.15, np.float32), jax.random.key(0)
    turned = jax.jit(lambda k, group: particles.move(EXACT, group, turn, STILL, key))
    group = jax.lax.fori_loop(0, 100_000, turned, swarm(np.zeros((2, 3)), np.float32))
    off = np.asarray(group.pose, float)[:, 2] - 100_000 * float(turn.dtheta)
    assert wrap(off) == pytest.approx(0, abs=0.02)


def test_a_heading_drift_persists_and_copies_vary_it():
    """Size: standard deviations of 20 000 drifts within 4.5 standard errors: 1e-4."""
    count, config = 20_000, drifting(heading_rate=0.002)
    group = particles.start(config, jax.random.key(0), count, np.dtype(float))
    assert np.std(group.heading_rate) == pytest.approx(0.002, rel=4.5 / np.sqrt(2 * count))
    for _ in range(3):
        group = moved(config, group, odometry(0, 0, 0.1), jnp.bool_(True), jax.random.key(1))
    assert np.allclose(group.pose[:, 2], 3 * (0.1 + 0.5 * group.heading_rate), atol=1e-12)
    drawn_all = placed(np.where(np.arange(count) == 7, count, 0))
    after = particles.copy_particles(ResamplingConfig(heading_rate=1e-4), group, drawn_all, jax.random.key(2))
    change = np.delete(np.asarray(after.heading_rate - group.heading_rate[7]), 7)
    assert after.heading_rate[7] == group.heading_rate[7]
    assert np.std(change) == pytest.approx(1e-4, rel=4.5 / np.sqrt(2 * count))
    assert particles.start(EXACT, jax.random.key(0), 3, np.dtype(float)).heading_rate is None


def test_a_robot_pressed_against_a_wall_does_not_advance_and_turns_by_part_of_its_odometry():
    """Size: mean and deviation of 10 000 uniform shares within 4.5 standard errors: 1e-4."""
    count, group = 10_000, swarm(np.zeros((10_000, 3)))

    def after(slip, forward, pressed):
        ahead, config = odometry(forward, 0, 0.4), drifting(slip=slip)
        return np.asarray(moved(config, group, ahead, STILL, jax.random.key(3), jnp.bool_(pressed)).pose)

    pressed = after(1.0, 0.1, True)
    assert np.abs(pressed[:, :2]).max() < 1e-15
    assert (pressed[:, 2] >= 0).all()
    assert (pressed[:, 2] <= 0.4).all()
    assert pressed[:, 2].mean() == pytest.approx(0.2, abs=4.5 * 0.4 / np.sqrt(12 * count))
    assert after(0.0, 0.1, True)[0] == pytest.approx([0.1, 0.0, 0.4])
    assert (after(1.0, 0.1, False) == after(0.0, 0.1, False)).all()
    assert (after(1.0, -0.1, True) == after(0.0, -0.1, True)).all()  # it backs off
    assert np.hypot(*after(0.5, 0.1, True)[:, :2].T) == pytest.approx(0.05)


weighed = jax.jit(particles.weigh)
averaged = jax.jit(particles.weighted_mean)


@given(st.lists(st.floats(-1e4, 1e4), min_size=COUNT, max_size=COUNT), st.floats(-1e3, 1e3))
def test_weights_are_the_softmax_and_effective_particles_the_inverse_of_their_squares(logs, shift):
    share = np.exp(np.array(logs) - max(logs))
    share /= share.sum()
    found = particles.normalised_weights(jnp.asarray(logs) + shift)
    assert found == pytest.approx(share, abs=1e-9)
    assert particles.effective_count(found) == pytest.approx(1 / (share**2).sum())


def test_likelihoods_multiply_weights():
    first, second = np.random.default_rng(0).normal(0, 3, (2, COUNT))
    second[5] = -np.inf
    after, vanished = weighed(weighed(swarm(np.zeros((COUNT, 3))), first)[0], second)
    assert not vanished
    assert after.weight == pytest.approx(first + second - (first + second).max())


@pytest.mark.parametrize(
    "odd", [[-np.inf] * COUNT, [np.nan] * COUNT, [0.0] * 15 + [np.nan], [np.inf] * COUNT]
)
def test_vanished_weights_are_left_unchanged_and_flagged(odd):
    before = swarm(np.zeros((COUNT, 3)))._replace(weight=-jnp.arange(COUNT, dtype=float))
    after, vanished = weighed(before, jnp.asarray(odd))
    assert vanished
    assert np.array_equal(after.weight, before.weight)


@given(st.integers(0, 2**32 - 1), st.floats(-7, 7))
def test_the_mean_turns_with_the_particles(seed, turned):
    stream = np.random.default_rng(seed)
    poses, share = stream.normal(0, [1, 1, 0.4], (COUNT, 3)), stream.dirichlet(np.ones(COUNT))
    pose, spread = averaged(poses, share)
    shifted, same = averaged(poses + [3, -2, turned], share)
    middle = share @ poses[:, :2]
    assert pose[:2] == pytest.approx(middle)
    assert spread[:2] == pytest.approx(np.sqrt(share @ (poses[:, :2] - middle) ** 2))
    assert pose[2] == pytest.approx(share @ poses[:, 2], abs=0.1)
    assert shifted[:2] - pose[:2] == pytest.approx([3, -2])
    assert wrap(float(shifted[2] - pose[2]) - turned) == pytest.approx(0, abs=1e-9)
    assert spread == pytest.approx(np.asarray(same))


def test_particles_that_agree_have_no_spread():
    pose, spread = averaged(np.full((COUNT, 3), 2.5, np.float32), np.full(COUNT, 1 / COUNT, np.float32))
    assert pose == pytest.approx([2.5, 2.5, 2.5])
    assert np.asarray(spread) == pytest.approx(0, abs=1e-3)  # square roots of rounding errors


WEIGHTS = st.lists(st.sampled_from([0.0, 1e-9, 0.01, 0.3, 1.0, 1.0, 7.0]), min_size=COUNT, max_size=COUNT)
drawing = jax.jit(particles.resample, static_argnums=0)


def drawn(config, share, seed):
    return jax.tree.map(np.asarray, drawing(config, share, jax.random.key(seed)))


def copies(resampling):
    return np.bincount(resampling.ancestor, minlength=len(resampling.ancestor))


@given(WEIGHTS.filter(any), st.integers(0, 2**32 - 1), st.sampled_from([SYSTEMATIC, MULTINOMIAL]))
def test_systematic_copies_are_within_one_of_the_share_and_none_is_without_weight(weights, seed, config):
    share = np.array(weights) / sum(weights)
    count = copies(drawn(config, share, seed))
    assert not count[share == 0].any()
    if config is SYSTEMATIC:
        assert (count >= np.floor(COUNT * share - 1e-9)).all()
        assert (count <= np.ceil(COUNT * share + 1e-9)).all()


@given(st.lists(st.integers(0, COUNT - 1), min_size=COUNT, max_size=COUNT))
def test_survivors_stay_and_the_others_are_replaced(parents):
    offspring = np.bincount(parents, minlength=COUNT)
    resampling = placed(offspring)
    slots = np.arange(COUNT)
    assert np.array_equal(copies(resampling), offspring)
    assert np.array_equal(resampling.ancestor == slots, offspring > 0)
    assert resampling.copies == (offspring == 0).sum()
    source, target = resampling.source[: resampling.copies], resampling.target[: resampling.copies]
    assert np.array_equal(target, slots[offspring == 0])
    assert np.array_equal(resampling.ancestor[target], source)


@pytest.mark.parametrize("shape", [(COUNT,), (COUNT, 3, 4, 5)])
def test_rows_are_copied_from_the_ancestors(shape):
    stream = np.random.default_rng(0)
    rows = stream.random(shape)
    for seed in range(20):
        resampling = drawn(SYSTEMATIC, stream.dirichlet(np.full(COUNT, 0.2)), seed)
        assert resampling.copies > 0
        after = jax.jit(particles.copy_rows)(rows, resampling)
        assert np.array_equal(after, rows[resampling.ancestor])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [2, 30, 100])
def test_equal_weights_change_nothing(count, dtype):
    share = np.asarray(particles.normalised_weights(jnp.full(count, -3.0, dtype)))
    for seed in range(10):
        assert drawn(SYSTEMATIC, share, seed).copies == 0
        assert np.array_equal(drawn(SYSTEMATIC, share, seed).ancestor, np.arange(count))


def test_a_last_particle_of_weight_0_is_never_drawn():
    """With so many particles that in float32 the last systematic point is often rounded up to 1."""
    count = 100_000
    share = particles.normalised_weights(jnp.zeros(count, np.float32).at[-1].set(-jnp.inf))
    assert share[-1] == 0
    assert all(drawn(SYSTEMATIC, share, seed).ancestor[-1] != count - 1 for seed in (0, 1, 2, 65, 178, 881))


@pytest.mark.parametrize("config", [SYSTEMATIC, MULTINOMIAL], ids=["systematic", "multinomial"])
def test_drawing_is_unbiased(config):
    """Size: each of 10 counts of 4 000 draws lies within 4.5 standard errors of N w: 7e-5 in all; for
    multinomial draws also their variance, N w (1 - w), within 4.5 of 3 % (heaviest particle)."""
    share, draws = np.array([0.01, 0.03, 0.05, 0.08, 0.1, 0.1, 0.12, 0.15, 0.16, 0.2]), 4000
    keys = jax.random.split(jax.random.key(3), draws)
    resampling = jax.jit(jax.vmap(partial(particles.resample, config, share)))(keys)
    counts = np.stack([np.bincount(row, minlength=10) for row in np.asarray(resampling.ancestor)])
    spread = np.sqrt(10 * share * (1 - share) / draws)
    assert (np.abs(counts.mean(axis=0) - 10 * share) <= 4.5 * spread).all()
    if config is MULTINOMIAL:
        assert counts[:, -1].var() == pytest.approx(10 * 0.2 * 0.8, rel=4.5 * 0.03)


def test_copies_differ_a_little_and_survivors_not_at_all():
    """Size: standard deviations of 15 numbers, each of 20 000 copies, within 4.5 standard errors: 1e-4."""
    count, config = 20_001, ResamplingConfig(length=0.01, heading=0.02, scale=0.03)
    before = swarm(np.arange(3 * count).reshape(count, 3), session=0.1)
    rank = jnp.arange(count, dtype=float)
    before = before._replace(move=before.session + rank[:, None], weight=-rank)
    resampling = placed(np.where(np.arange(count) == 7, count, 0))
    after = jax.jit(particles.copy_particles, static_argnums=0)(config, before, resampling, jax.random.key(0))
    before, after = (jax.tree.map(np.asarray, group) for group in (before, after))
    assert np.array_equal(after.pose[7], before.pose[7])
    assert np.array_equal(after.session[7], before.session[7])
    assert np.array_equal(after.move, np.tile(before.move[7], (count, 1)))
    assert not np.any(after.weight)
    jitter = np.concatenate([after.pose - before.pose[7], after.session - before.session[7]], axis=1)
    jitter = np.delete(jitter, 7, axis=0) / [0.01, 0.01, 0.02, 0.03, 0.03]
    assert np.abs(np.cov(jitter.T) - np.eye(5)).max() < 4.5 * np.sqrt(2 / count)


MAPS, SIDE, WINDOW = 3, 24, 16
read = jax.jit(particles.interpolate, static_argnums=1)
around = jax.jit(particles.windows_around, static_argnums=(1, 2))
cut = jax.jit(particles.read_window, static_argnums=(2, 3))
put = jax.jit(particles.write_window, static_argnums=2)


def filled(dtype=float):
    return np.random.default_rng(0).normal(size=(MAPS, LAYERS, SIDE, SIDE)).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_between_cells_is_bilinear(dtype):
    maps = filled(dtype=dtype)
    place = np.random.default_rng(1).uniform(0, SIDE - 1, (MAPS, 500, 2)).astype(dtype)
    for k, layer in np.ndindex(MAPS, LAYERS):
        expected = map_coordinates(maps[k, layer].astype(float), place[k].T[::-1], order=1)
        found = np.asarray(read(maps, layer, place))[k]
        assert found.dtype == dtype
        assert found == pytest.approx(expected, abs=1e-12 if dtype == np.float64 else 2e-5)


@given(st.tuples(*[st.floats(allow_nan=True, width=32)] * 2))
def test_places_outside_are_unexplored(place):
    x, y = place
    value = float(read(np.ones((1, LAYERS, SIDE, SIDE)), 0, np.array([[place]]))[0, 0])
    inside = 0 <= x < SIDE - 1 and 0 <= y < SIDE - 1
    assert value == pytest.approx(1.0 if inside else 0.0)


def test_places_are_relative_to_the_middle_of_the_map():
    point = np.array([[0.0, 0.0], [0.1, -0.05]])
    assert particles.to_cells(point, 0.05, 51) == pytest.approx(np.array([[25, 25], [27, 24]]))
    # In a map of even side the middle lies between cells.
    assert particles.to_cells(point, 0.05, 50)[0] == pytest.approx(24.5)
    maps = np.zeros((1, LAYERS, 51, 51))
    maps[0, 0, 24, 27] = 1  # row is y, column x
    assert read(maps, 0, np.asarray(particles.to_cells(point, 0.05, 51))[None])[0] == pytest.approx([0, 1])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("side", "size"), [(1, 1), (5, 5), (17, 5), (15, 15), (17, 16), (40, 22)])
def test_windows_lie_around_their_place_and_inside_the_map(side, size, dtype):
    stream = np.random.default_rng(side)
    near, far = stream.uniform(0, side - 1, (50, 2)), stream.normal(0, 10.0 ** stream.uniform(0, 8, (50, 2)))
    place = np.concatenate([near, far]).astype(dtype)
    corner = np.asarray(particles.windows_around(place, side, size))
    assert corner.dtype == np.int32
    middle = np.floor(place).astype(np.int64) - (size // 2 - 1)
    assert np.array_equal(corner, np.clip(middle, 0, side - size))
    away = np.asarray(particles.windows_around(np.array([[1e12, -1e12]], dtype), side, size))
    assert ((away >= 0) & (away + size <= side)).all()


@pytest.mark.parametrize(("size", "layer"), [(6, 0), (WINDOW, 1), (SIDE, 2)])
def test_written_windows_are_read_back_and_nothing_else_changes(size, layer):
    maps = filled()
    corner = np.asarray(around(np.random.default_rng(2).uniform(-5, SIDE + 5, (MAPS, 2)), SIDE, size))
    before = cut(maps, corner, size, layer)
    for k, (x, y) in enumerate(corner):
        assert np.array_equal(before[k], maps[k, layer, y : y + size, x : x + size])
    assert np.array_equal(put(maps, corner, layer, before), maps)
    values = np.random.default_rng(3).normal(size=before.shape)
    after = np.array(put(maps, corner, layer, values))
    assert np.array_equal(cut(after, corner, size, layer), values)
    for k, (x, y) in enumerate(corner):
        after[k, layer, y : y + size, x : x + size] = before[k]
    assert np.array_equal(after, maps)


def test_places_in_windows_are_places_in_the_map():
    maps = filled()
    place = np.random.default_rng(4).uniform(4, SIDE - 5, (MAPS, 2))
    corner = np.asarray(around(place, SIDE, WINDOW))
    inside = np.asarray(particles.to_window(place[:, None], corner))
    assert inside[:, 0] == pytest.approx(place - corner)
    windows = np.stack([cut(maps, corner, WINDOW, layer) for layer in range(LAYERS)], axis=1)
    for layer in range(LAYERS):
        assert read(windows, layer, inside) == pytest.approx(np.asarray(read(maps, layer, place[:, None])))


PATHS = 6


def reports(count, every=1):
    """Poses, shares and ancestors of random particles; all descend from few at every `every`-th report."""
    stream = np.random.default_rng(0)
    for k in range(count):
        ancestor = np.sort(stream.integers(0, PATHS, PATHS)) if k % every == every - 1 else np.arange(PATHS)
        pose = np.array([k, 0, 0]) + stream.normal(0, [1, 1, 0.05], (PATHS, 3))
        yield pose, stream.dirichlet(np.ones(PATHS)), ancestor


def genealogy_of(rows):
    tree = Genealogy(PATHS)
    for row in rows:
        tree.append(*row)
    return tree


def by_copying(rows):
    paths, weights = [[] for _ in range(PATHS)], np.full(PATHS, 1 / PATHS)
    ancestor = np.arange(PATHS)
    for pose, share, after in rows:
        paths = [[*paths[ancestor[n]], pose[n]] for n in range(PATHS)]
        weights, ancestor = share, after
    return np.einsum("n,ntc->tc", weights, np.array(paths).reshape(PATHS, -1, 3))


def assert_same(path, expected):
    """The headings are so close that all kinds of mean agree within the tolerance."""
    assert path.shape == expected.shape
    assert path[:, :2] == pytest.approx(expected[:, :2])
    assert path[:, 2] == pytest.approx(expected[:, 2], abs=1e-3)


@pytest.mark.parametrize(("count", "every"), [(0, 1), (1, 1), (2, 1), (17, 7), (40, 1), (40, 7)])
def test_the_path_is_that_of_the_ancestors(count, every):
    rows = list(reports(count, every=every))
    assert_same(genealogy_of(rows).path(), by_copying(rows))


@pytest.mark.parametrize("levels", [1, 5 * PATHS, 40 * PATHS])
def test_memory_is_bounded_and_settled_paths_stay(monkeypatch, levels):
    """Settling is exact if all particles descend from one, as they soon do."""
    stream = np.random.default_rng(1)
    rows = [(pose, share, np.full(PATHS, stream.integers(0, PATHS))) for pose, share, _ in reports(200)]
    whole = genealogy_of(rows).path()
    monkeypatch.setattr(particles, "MAX_POSES", levels)
    tree = genealogy_of(rows)
    assert tree.arrays()["pose"].size // 3 <= max(levels, PATHS)
    assert tree.path() == pytest.approx(whole)
    assert_same(whole, by_copying(rows))


def test_poses_beyond_the_bound_are_weighted_means(monkeypatch):
    monkeypatch.setattr(particles, "MAX_POSES", 20 * PATHS)
    rows = list(reports(60, every=9))
    assert np.abs(genealogy_of(rows).path() - by_copying(rows)).max() < 2


def test_headings_are_averaged_on_the_circle():
    share = np.full(PATHS, 1 / PATHS)
    for heading in ([3.1, 3.2, 3.3, -3.1, -3.0, 3.14], [0.0, 1.0, 2.0, 3.0, -1.5, -0.4]):
        expected = np.angle(share @ np.exp(1j * np.array(heading)))
        for turned in range(PATHS):
            pose = np.zeros((PATHS, 3))
            pose[:, 2] = np.roll(heading, turned)
            found = genealogy_of([(pose, share, np.arange(PATHS))]).path()[0, 2]
            assert wrap(found - expected) == pytest.approx(0, abs=1e-9)
