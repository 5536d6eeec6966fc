"""Laws of motion: composed odometry, errors of scale, heading drift, slip at walls."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.grid import particles
from ratslam.grid.config import DriftConfig, ResamplingConfig
from tactile.base.se2 import compose, wrap
from tests.helpers.grid_world import STEADY
from tests.ratslam.grid.particle_cases import odometry, placed, swarm

moved = jax.jit(particles.move, static_argnums=0)


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
