"""Solving maps of 10 000 and 100 000 nodes with a tenth as many closures, beside other solvers."""

from __future__ import annotations

import time
import warnings
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ratslam.classic.experience_map import ExperienceConfig, ExperienceMap
from ratslam.core.estimates import Action, Estimate
from ratslam.mapping.pose_graph import Edges, GraphEquations, Termination, least_squares
from tactile.base.se2 import between, wrap
from tactile.base.types import Odometry, observation

NOISE = np.array([0.02, 0.02, 0.01])
"""Standard deviations of every edge, m, m, rad; some maps have ten times the heading noise."""


def city(count, stream):
    """A random walk on a square grid of 1 m."""
    heading = np.cumsum(stream.choice([0, 0, 0, np.pi / 2, -np.pi / 2], count))
    steps = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1)
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), wrap(heading)]), 1.1


def serpentine(count, stream):
    """Lanes up and down a square field: one long chain, closures to the lane beside only."""
    lane, along = np.divmod(np.arange(count), int(np.sqrt(count)))
    across = np.where(lane % 2 == 0, along, int(np.sqrt(count)) - 1 - along)
    ahead = np.diff(np.stack([across, lane], axis=1), axis=0)
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    return np.column_stack([across, lane, np.append(heading, heading[-1])]).astype(float), 1.01


def arena(count, stream):
    """Straight lines across a square, with closures between all of them."""
    half, turns, poses = 0.25 * np.sqrt(count), stream.normal(0, 0.2, count), np.zeros((count, 3))
    for k in range(1, count):
        x, y, heading = poses[k - 1]
        if max(abs(x), abs(y)) > half:
            turns[k] = np.clip(wrap(np.arctan2(-y, -x) - heading), -0.5, 0.5)
        poses[k] = x + 0.5 * np.cos(heading), y + 0.5 * np.sin(heading), heading + turns[k]
    return poses, 0.6


PATHS = {"city": city, "serpentine": serpentine, "arena": arena}


def measure_path(name, count, noise=NOISE):
    """Odometry along a path and a tenth as many closures where it comes by again: true poses and edges."""
    stream = np.random.default_rng(0)
    truth, reach = PATHS[name](count, stream)
    truth = between(truth[0], truth)
    near = np.sort(cKDTree(truth[:, :2]).query_pairs(reach, output_type="ndarray"), axis=1)
    near = stream.permutation(near[near[:, 1] - near[:, 0] > 20])[: count // 10]
    i = np.concatenate([np.arange(count - 1), near[:, 0]])
    j = np.concatenate([np.arange(1, count), near[:, 1]])
    motion = between(truth[i], truth[j]) + stream.normal(0, 1, (len(i), 3)) * noise
    return truth, Edges(i, j, motion, np.tile(1 / noise**2, (len(i), 1)))


@pytest.fixture
def size(benchmark):
    """The number of nodes; few if times are not measured."""
    return lambda count: count if benchmark.enabled else min(count, 2500)


def median_time(call, rounds=5):
    """Median seconds of a call, and what it returned."""
    took = []
    for _ in range(rounds):
        start = time.perf_counter()
        found = call()
        took.append(time.perf_counter() - start)
    return float(np.median(took)), found


def misfit(poses, edges):
    """Chi-square per degree of freedom; 1 at the optimum."""
    left = between(poses[edges.i], poses[edges.j]) - edges.motion
    left[:, 2] = wrap(left[:, 2])
    return float((left**2 * edges.information).sum()) / (3 * (len(edges.i) - len(poses) + 1))


def displaced(truth):
    """The true poses, each off by a normal error of 0.1 m and 0.05 rad."""
    stream = np.random.default_rng(1)
    return np.vstack([truth[:1], truth[1:] + stream.normal(0, 1, (len(truth) - 1, 3)) * [0.1, 0.1, 0.05]])


@pytest.mark.parametrize("heading", [1, 10])
@pytest.mark.parametrize("name", PATHS)
def test_cold(benchmark, size, name, heading):
    """Least squares beside gtsam; also where headings err by more than a turn within a hundred steps."""
    truth, edges = measure_path(name, size(10_000), NOISE * [1, 1, heading])
    start = displaced(truth)
    took, solved = median_time(lambda: least_squares(start, edges), 1)
    theirs, rest = gtsam_optimum(start, edges)
    print(
        f"\n{name}, heading noise x {heading}: {took * 1e3:.0f} ms, {solved.iterations} iterations, misfit "
        f"{misfit(solved.poses, edges):.4f}; gtsam {theirs * 1e3:.0f} ms, {rest:.4f}"
    )
    benchmark.extra_info["ms"] = took * 1e3
    benchmark.pedantic(least_squares, args=(start, edges), kwargs={"iterations": 1}, rounds=1)
    assert misfit(solved.poses, edges) < 1.1


@pytest.mark.parametrize("name", PATHS)
def test_warm(benchmark, size, name):
    """One more closure in a solved map, with and without what is kept of the equations."""
    truth, edges = measure_path(name, size(10_000))
    before = Edges(*(column[:-1] for column in edges))
    start, known = least_squares(truth, before).poses, GraphEquations(len(truth), edges, len(edges.i))
    took, solved = median_time(lambda: least_squares(start, edges, tolerance=1e-3, equations=known), 11)
    whole, _ = median_time(lambda: least_squares(start, edges, tolerance=1e-3), 1)
    print(
        f"\n{name}: warm {took * 1e3:.1f} ms, {solved.iterations} iterations; with the order of elimination "
        f"{whole * 1e3:.0f} ms"
    )
    benchmark.extra_info["ms"] = took * 1e3
    benchmark.pedantic(least_squares, args=(start, edges), kwargs={"iterations": 1}, rounds=1)
    assert solved.termination is Termination.CONVERGED
    assert solved.iterations <= 3


def test_steps_without_a_closure(benchmark, size, monkeypatch):
    """A map of 10 000 places takes a step in the time of its own arithmetic: nothing is solved."""
    world = ExperienceMap(ExperienceConfig())
    nodes = size(10_000)
    _, edges = measure_path("city", nodes)
    solves = []
    monkeypatch.setattr("ratslam.classic.experience_map.least_squares", lambda *a, **k: solves.append(1))
    fold(world, edges.motion[: nodes - 1])
    took, _ = median_time(lambda: fold(world, edges.motion[:1000], start=nodes), 1)
    print(f"\na step without a closure: {took * 1e3:.1f} us")
    benchmark.pedantic(fold, args=(world, edges.motion[:10]), rounds=1)
    assert not solves


class Evidence(NamedTuple):
    """The fields of `ClassicEvidence` that the map reads."""

    template: int
    relative: float = 0.0


def fold(world, motions, start=0):
    """A new place at every step."""
    for k, moved in enumerate(motions, start):
        estimate = Estimate(np.zeros(3), np.zeros(3), k, -1, Action.CREATE, False)
        world.update(observation(Odometry(*moved, 1.0)), estimate, Evidence(k))


def gtsam_optimum(start, edges):
    """Seconds of gtsam's Levenberg-Marquardt from a start, and its misfit; NaN without gtsam."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import gtsam
    except ImportError:
        return np.nan, np.nan
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(start):
        values.insert(k, gtsam.Pose2(*pose))
    for i, j, motion, weight in zip(*edges, strict=True):
        noise = gtsam.noiseModel.Diagonal.Sigmas(1 / np.sqrt(weight))
        graph.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*motion), noise))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start[0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    took, found = median_time(gtsam.LevenbergMarquardtOptimizer(graph, values).optimize, 1)
    poses = np.array([[(p := found.atPose2(k)).x(), p.y(), p.theta()] for k in range(len(start))])
    return took, misfit(poses, edges)
