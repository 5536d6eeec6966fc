"""Laws of particles: motion, weights and resampling."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from ratslam.grid import particles
from ratslam.grid.config import DriftConfig, ResamplingConfig
from ratslam.grid.particles import Particles
from tactile.base.se2 import compose, wrap
from tactile.base.types import Odometry
from tests.helpers.grid_world import STEADY

SYSTEMATIC = ResamplingConfig()
MULTINOMIAL = ResamplingConfig(scheme="multinomial")
COUNT = 16
WEIGHTS = st.lists(st.sampled_from([0.0, 1e-9, 0.01, 0.3, 1.0, 1.0, 7.0]), min_size=COUNT, max_size=COUNT)

moved = jax.jit(particles.move, static_argnums=0)
weighed = jax.jit(particles.weigh)
drawing = jax.jit(particles.resample, static_argnums=0)
placing = jax.jit(particles.assign_copies)
averaged = jax.jit(particles.weighted_mean)


def drawn(config, share, seed):
    return jax.tree.map(np.asarray, drawing(config, share, jax.random.key(seed)))


def placed(offspring):
    return jax.tree.map(np.asarray, placing(jnp.asarray(offspring, jnp.int32)))


def copies(resampling):
    return np.bincount(resampling.ancestor, minlength=len(resampling.ancestor))


def swarm(poses, dtype=float, session=0.0, weight=0.0):
    poses = np.atleast_2d(np.asarray(poses, dtype))
    scales = np.full((len(poses), 2), session, dtype)
    return jax.tree.map(
        jnp.asarray, Particles(poses, scales, np.zeros_like(scales), np.full(len(poses), weight, dtype))
    )


def odometry(dx, dy, dtheta, dtype=float):
    return Odometry(*(jnp.asarray(value, dtype) for value in (dx, dy, dtheta, 0.5)))


# Resampling


@given(WEIGHTS.filter(any), st.integers(0, 2**32 - 1))
def test_systematic_copies_are_within_one_of_the_share(weights, seed):
    share = np.array(weights) / sum(weights)
    count = copies(drawn(SYSTEMATIC, share, seed))
    assert (count >= np.floor(COUNT * share - 1e-9)).all()
    assert (count <= np.ceil(COUNT * share + 1e-9)).all()
    assert count.sum() == COUNT


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


@given(WEIGHTS.filter(any), st.integers(0, 2**32 - 1), st.sampled_from([SYSTEMATIC, MULTINOMIAL]))
def test_particles_without_weight_have_no_copies(weights, seed, config):
    share = np.array(weights) / sum(weights)
    assert not copies(drawn(config, share, seed))[share == 0].any()


@pytest.mark.parametrize("shape", [(COUNT,), (COUNT, 3, 4, 5)])
def test_rows_are_copied_from_the_ancestors(shape):
    stream = np.random.default_rng(0)
    rows = stream.random(shape)
    for seed in range(20):
        resampling = drawn(SYSTEMATIC, stream.dirichlet(np.full(COUNT, 0.2)), seed)
        assert resampling.copies > 0
        after = jax.jit(particles.copy_rows)(rows, resampling)
        assert np.array_equal(after, rows[resampling.ancestor])


@pytest.mark.parametrize("config", [SYSTEMATIC, MULTINOMIAL], ids=["systematic", "multinomial"])
@pytest.mark.parametrize("heavy", [0, 7, COUNT - 1])
def test_one_heavy_particle_takes_all(config, heavy):
    share = np.zeros(COUNT)
    share[heavy] = 1
    for seed in range(10):
        resampling = drawn(config, share, seed)
        assert (resampling.ancestor == heavy).all()
        assert resampling.copies == COUNT - 1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [2, 30, 100])
def test_equal_weights_change_nothing(count, dtype):
    share = np.asarray(particles.normalised_weights(jnp.full(count, -3.0, dtype)))
    for seed in range(10):
        resampling = drawn(SYSTEMATIC, share, seed)
        assert resampling.copies == 0
        assert np.array_equal(resampling.ancestor, np.arange(count))


def test_a_last_particle_of_weight_0_is_never_drawn():
    """With so many particles that in float32 the last systematic point is often rounded up to 1."""
    count = 100_000
    share = particles.normalised_weights(jnp.zeros(count, np.float32).at[-1].set(-jnp.inf))
    assert share[-1] == 0
    assert all(
        drawn(SYSTEMATIC, share, seed).ancestor[-1] != count - 1 for seed in [*range(20), 65, 178, 881]
    )


@pytest.mark.parametrize("config", [SYSTEMATIC, MULTINOMIAL], ids=["systematic", "multinomial"])
def test_drawing_is_unbiased(config):
    """Size: each of 10 counts of 4 000 draws lies within 4.5 standard errors of N w: 7e-5 in all; for
    multinomial draws their total is also tested by chi-square at 1e-4, and their variance, N w (1 - w),
    within 4.5 standard errors of 3 % (heaviest particle)."""
    share, draws = np.array([0.01, 0.03, 0.05, 0.08, 0.1, 0.1, 0.12, 0.15, 0.16, 0.2]), 4000
    keys = jax.random.split(jax.random.key(3), draws)
    resampling = jax.jit(jax.vmap(partial(particles.resample, config, share)))(keys)
    counts = np.stack([np.bincount(row, minlength=10) for row in np.asarray(resampling.ancestor)])
    spread = np.sqrt(10 * share * (1 - share) / draws)
    assert (np.abs(counts.mean(axis=0) - 10 * share) <= 4.5 * spread).all()
    assert (counts.sum(axis=1) == 10).all()
    if config is MULTINOMIAL:
        assert chisquare(counts.sum(axis=0), 10 * share * draws).pvalue > 1e-4
        assert counts[:, -1].var() == pytest.approx(10 * 0.2 * 0.8, rel=4.5 * 0.03)


def test_copies_differ_a_little_and_survivors_not_at_all():
    """Size: standard deviations of 15 numbers, each of 20 000 copies, within 4.5 standard errors: 1e-4."""
    count = 20_001
    config = ResamplingConfig(length=0.01, heading=0.02, scale=0.03)
    before = swarm(np.arange(3 * count).reshape(count, 3), session=0.1)
    before = before._replace(
        move=before.session + jnp.arange(count, dtype=float)[:, None], weight=-before.pose[:, 0]
    )
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


def test_identity_makes_no_copies():
    resampling = particles.identity(COUNT)
    assert resampling.copies == 0
    assert np.array_equal(resampling.ancestor, np.arange(COUNT))


# Weights


@settings(max_examples=50)
@given(st.lists(st.floats(-1e4, 1e4), min_size=COUNT, max_size=COUNT), st.floats(-1e3, 1e3))
def test_weights_are_a_distribution_independent_of_a_common_offset(logs, shift):
    share = particles.normalised_weights(jnp.asarray(logs))
    assert float(share.sum()) == pytest.approx(1)
    assert share == pytest.approx(
        np.asarray(particles.normalised_weights(jnp.asarray(logs) + shift)), abs=1e-9
    )
    assert 1 - 1e-9 <= float(particles.effective_count(share)) <= COUNT + 1e-9


def test_likelihoods_multiply_weights():
    before = swarm(np.zeros((COUNT, 3)))
    first, second = np.random.default_rng(0).normal(0, 3, (2, COUNT))
    after, vanished = weighed(weighed(before, first)[0], second)
    expected = np.exp(first + second) / np.exp(first + second).sum()
    assert np.asarray(particles.normalised_weights(after.weight)) == pytest.approx(expected)
    assert float(after.weight.max()) == 0
    assert not vanished
    assert particles.effective_count(particles.normalised_weights(before.weight)) == pytest.approx(COUNT)


@pytest.mark.parametrize(
    "odd", [[-np.inf] * COUNT, [np.nan] * COUNT, [0.0] * 15 + [np.nan], [np.inf] * COUNT]
)
def test_vanished_weights_are_left_unchanged_and_flagged(odd):
    before = swarm(np.zeros((COUNT, 3)))._replace(weight=-jnp.arange(COUNT, dtype=float))
    after, vanished = weighed(before, jnp.asarray(odd))
    assert vanished
    assert np.array_equal(after.weight, before.weight)


def test_one_particle_that_explains_the_contacts_is_enough():
    likelihood = np.full(COUNT, -np.inf)
    likelihood[5] = -1e6
    after, vanished = weighed(swarm(np.zeros((COUNT, 3))), likelihood)
    assert not vanished
    assert np.array_equal(particles.normalised_weights(after.weight), np.arange(COUNT) == 5)


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


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_particles_that_agree_have_no_spread(dtype):
    pose, spread = averaged(np.full((COUNT, 3), 2.5, dtype), np.full(COUNT, 1 / COUNT, dtype))
    assert pose == pytest.approx([2.5, 2.5, 2.5])
    assert np.asarray(spread) == pytest.approx(0, abs=1e-3)  # square roots of rounding errors


# Motion


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 3), min_size=1, max_size=8))
def test_odometry_without_noise_is_composed(motions):
    config = DriftConfig(**STEADY)
    expected, group = np.array([0.3, -0.2, 2.5]), swarm([[0.3, -0.2, 2.5]] * 2)
    for k, motion in enumerate(motions):
        group = moved(config, group, odometry(*motion), jnp.bool_(k % 2), jax.random.key(k))
        expected = compose(expected, np.array(motion))
    for pose in np.asarray(group.pose):
        assert pose[:2] == pytest.approx(expected[:2], abs=1e-9)
        assert wrap(pose[2] - expected[2]) == pytest.approx(0, abs=1e-9)


def test_a_particle_scales_odometry_by_its_own_errors():
    config = DriftConfig(**STEADY)
    group = swarm([[0, 0, np.pi / 2]] * 2)._replace(
        session=jnp.array([[0.1, -0.2], [0.0, 0.0]]), move=jnp.array([[0.05, 0.1], [-0.5, 0.0]])
    )
    still = jnp.bool_(False)
    driven = moved(config, group, odometry(2, 0, 0), still, jax.random.key(0))
    assert driven.pose[:, 1] == pytest.approx([2 * 1.15, 2 * 0.5])
    assert driven.pose[:, 0] == pytest.approx(0, abs=1e-12)
    turned = moved(config, group, odometry(0, 0, 1), still, jax.random.key(0))
    assert turned.pose[:, 2] - np.pi / 2 == pytest.approx([0.9, 1.0])
    assert turned.pose[:, :2] == pytest.approx(0, abs=1e-12)


def test_scale_errors_persist_over_session_movement_or_step():
    """Size: 12 variances and correlations of 40 000 particles within 4.5 standard errors: 1e-4."""
    count = 40_000
    config = DriftConfig(session=0.05, move=0.03, step=0.0, heading=0.0)
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
    count = 40_000
    config = DriftConfig(session=0.0, move=0.0, step=0.02, heading=5e-4)
    error = 4.5 / np.sqrt(count)

    def after(dx, dtheta):
        group = swarm(np.zeros((count, 3)))
        return np.asarray(
            moved(config, group, odometry(dx, 0, dtheta), jnp.bool_(True), jax.random.key(1)).pose
        )

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
    count, turn = 100_000, 0.15
    config = DriftConfig(**STEADY)

    def step(k, group):
        return particles.move(config, group, odometry(0, 0, turn, np.float32), jnp.bool_(False), key)

    key = jax.random.key(0)
    group = jax.jit(lambda group: jax.lax.fori_loop(0, count, step, group))(
        swarm(np.zeros((2, 3)), np.float32)
    )
    heading = np.asarray(group.pose, float)[:, 2]
    assert wrap(heading - count * float(np.float32(turn))) == pytest.approx(0, abs=0.02)


def test_a_heading_drift_persists_and_copies_vary_it():
    """Size: standard deviations of 20 000 drifts within 4.5 standard errors: 1e-4."""
    count = 20_000
    config = DriftConfig(**STEADY).model_copy(update={"heading_rate": 0.002})
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
    without = particles.start(DriftConfig(**STEADY), jax.random.key(0), 3, np.dtype(float))
    assert without.heading_rate is None


def test_a_robot_pressed_against_a_wall_does_not_advance_and_turns_by_part_of_its_odometry():
    """Size: mean and deviation of 10 000 uniform shares within 4.5 standard errors: 1e-4."""
    count, key = 10_000, jax.random.key(3)
    config = DriftConfig(**STEADY).model_copy(update={"slip": 1.0})
    group, still = swarm(np.zeros((count, 3))), jnp.bool_(False)

    def after(config, forward, pressed):
        ahead = odometry(forward, 0, 0.4)
        return np.asarray(moved(config, group, ahead, still, key, jnp.bool_(pressed)).pose)

    pressed = after(config, 0.1, True)
    assert np.abs(pressed[:, :2]).max() < 1e-15
    assert (pressed[:, 2] >= 0).all()
    assert (pressed[:, 2] <= 0.4).all()
    assert pressed[:, 2].mean() == pytest.approx(0.2, abs=4.5 * 0.4 / np.sqrt(12 * count))
    whole = after(DriftConfig(**STEADY), 0.1, True)
    assert whole[0] == pytest.approx([0.1, 0.0, 0.4])
    assert (after(config, 0.1, False) == after(DriftConfig(**STEADY), 0.1, False)).all()
    assert (after(config, -0.1, True) == after(DriftConfig(**STEADY), -0.1, True)).all()  # it backs off
    half = after(config.model_copy(update={"slip": 0.5}), 0.1, True)
    assert np.hypot(*half[:, :2].T) == pytest.approx(0.05)
