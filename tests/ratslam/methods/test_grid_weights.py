"""Weights of the grid filter's particles after a report, also against an exact filter."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.grid import likelihoods, particles
from ratslam.grid.particles import EVIDENCE
from tactile.base.types import MotionKind
from tests.helpers.grid_world import TIPS, at_pose, drive, initial, report, with_map
from tests.ratslam.methods.grid_filters import CORRIDOR, FILTER, SINGLE, column_of_wall, placed


@pytest.mark.parametrize("backend", [FILTER, SINGLE], ids=["float64", "float32"])
def test_particles_whose_map_explains_a_contact_weigh_more(backend):
    start = with_map(initial(backend), column_of_wall(backend, 0.6))
    poses = jnp.zeros_like(start.particles.pose)
    tips = TIPS[1, 0]
    for k, x in enumerate((0.6 - tips, 0.9 - tips, 0.3 - tips)):  # on the wall, behind it, before it
        poses = poses.at[10 * k : 10 * k + 10, 0].set(float(x))
    start = start._replace(
        particles=start.particles._replace(pose=poses, session=0 * start.particles.session)
    )
    _, _, evidence = drive(backend, start, [report(touching=[1, 2], dead=[0, 3], motion=MotionKind.OTHER)])
    wall, unknown, empty = evidence.weights[0].reshape(3, 10)
    assert wall.min() > 3 * unknown.max()
    assert unknown.min() > empty.max()
    _, _, evidence = drive(backend, start, [report(dead=[0, 3], motion=MotionKind.OTHER)])
    wall, unknown, empty = evidence.weights[0].reshape(3, 10)
    assert wall.max() < unknown.min() <= empty.min() * 1.1


def test_particles_whose_map_has_the_walls_direction_weigh_more():
    wall = report(touching=[0, 1], wall=(0.3, 0.3), sd=0.04)
    start = at_pose(initial(FILTER), [0.0, 0.0, 0.0])
    start, *_ = drive(FILTER, start, [wall, report(-1e-6)] * 6)
    turned = np.repeat([0.0, 0.3, np.pi / 4], 10)
    pose = start.particles.pose.at[:, 2].set(turned)
    start = start._replace(particles=start.particles._replace(pose=pose, weight=0 * start.particles.weight))
    _, _, evidence = drive(FILTER, start, [wall])
    aligned, oblique, across = evidence.weights[0].reshape(3, 10)
    assert aligned.min() > oblique.max()
    assert oblique.min() > across.max()


def corridor(backend, reports, spread):
    """Mean and variance of the position after each report along a corridor whose map is given, by an exact
    histogram filter: a heading of 0, and steps d with a standard deviation of `spread` d.

    Weighs as the filter does, from its likelihoods at each place; [T, 2], m and m2.
    """
    config, fine = backend.config, 2e-3
    x = np.arange(-0.3, 1.2, fine)
    pose = np.stack([x, 0 * x, 0 * x], axis=1)
    maps = np.zeros((1, particles.LAYERS, backend.side, backend.side))
    maps[0, EVIDENCE] = column_of_wall(backend, 0.65)
    maps = jnp.asarray(maps)
    belief, touched, moments = np.where(np.abs(x) < fine / 2, 1.0, 0.0), np.zeros(2, bool), []

    def evidence(points):
        place = placed(backend, pose, points).reshape(1, -1, 2)
        return np.asarray(particles.interpolate(maps, EVIDENCE, place)).reshape(len(x), len(points))

    for o in reports:
        sd = spread * abs(float(o.odometry.dx))
        gap = (x[:, None] - x[None] - float(o.odometry.dx)) / sd
        belief = np.exp(-0.5 * gap**2) @ belief
        if o.motion != MotionKind.BACK:
            free = np.repeat(~o.contact, len(backend.free) // 2)
            logs = likelihoods.free_space(config.likelihood, evidence(backend.free), free)
            logs += likelihoods.contact(config.likelihood, evidence(TIPS[:2]), o.contact & ~touched)
            belief = belief * np.exp(np.asarray(logs))
        touched = o.contact & (o.motion != MotionKind.BACK)
        belief = belief / belief.sum()
        mean = belief @ x
        moments.append([mean, belief @ (x - mean) ** 2])
    return np.array(moments)


@pytest.mark.soak
def test_position_in_a_corridor_is_that_of_an_exact_filter():
    """Mean and variance of the position at four reports named beforehand, over 20 runs of 1 000 particles:
    |t| < 5 in each of eight tests with 19 degrees of freedom. Size: 7e-4."""
    spread, runs = CORRIDOR.config.drift.step, 20
    backend = CORRIDOR
    reading = partial(report, whiskers=2)
    reports = [reading(0.1)] * 4 + [reading(0.1, touching=[1])] + [reading(-0.05)] * 2 + [reading(0.05)]
    reports += [reading(0.06, touching=[1]), reading(0.02, touching=[0, 1])]
    checked = [3, 4, 6, 9]  # free, a contact, backed off, the last contact
    exact = corridor(backend, reports, spread)
    found, drawn = [], []
    for seed in range(runs):
        start = with_map(initial(backend, seed), column_of_wall(backend, 0.65))
        _, estimate, evidence = drive(backend, start, reports)
        found.append(np.stack([estimate.pose[:, 0], estimate.spread[:, 0] ** 2], axis=1))
        drawn.append((evidence.ancestor != np.arange(1000)).any(axis=1))
    found = np.array(found)
    error = found.std(axis=0, ddof=1) / np.sqrt(runs)
    assert (np.abs((found.mean(axis=0) - exact) / error)[checked] < 5).all()
    # Without resampling, or without the contacts, the result would differ by far more.
    assert np.any(drawn, axis=1).all()
    blind = corridor(
        backend,
        [o._replace(contact=np.zeros(2, bool), motion=np.int32(MotionKind.BACK)) for o in reports],
        spread,
    )
    assert (np.abs((blind - exact) / error)[checked[1:], 0] > 20).all()
