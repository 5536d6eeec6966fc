"""Solving maps of 10 000 and 100 000 nodes with a tenth as many closures, beside other solvers."""

from __future__ import annotations

import time
import warnings
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ratslam.classic.experience_map import ExperienceConfig, ExperienceMap
from ratslam.core.types import Action, Estimate
from ratslam.pose_graph import Edges, Termination, least_squares, linear_initialization
from tactile.base.se2 import between, integrate, wrap
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


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("count", [10_000, 100_000])
def test_two_stages(benchmark, size, name, count):
    """Beside the classic sweep, compiled: 100 sweeps from odometry."""
    truth, edges = measure_path(name, count := size(count))
    sweep(truth[:2].copy(), Edges(*(column[:1] for column in edges)), 1)
    took, poses = median_time(lambda: linear_initialization(count, edges))
    swept, relaxed = median_time(lambda: sweep(integrated(edges, count), edges, 100), 1)
    print(
        f"\n{name}, {count} nodes: two stages {took * 1e3:.1f} ms, misfit {misfit(poses, edges):.3g}; "
        f"100 sweeps {swept * 1e3:.0f} ms, misfit {misfit(relaxed, edges):.3g}"
    )
    benchmark.extra_info["ms"] = took * 1e3
    assert misfit(benchmark.pedantic(linear_initialization, args=(count, edges), rounds=1), edges) < misfit(
        relaxed, edges
    )


@pytest.mark.parametrize("name", PATHS)
def test_cold(benchmark, size, name):
    """Two stages and SE(2) least squares from there, beside the same without elimination and gtsam."""
    truth, edges = measure_path(name, size(10_000))

    def cold(**how):
        return least_squares(linear_initialization(len(truth), edges), edges, **how)

    took, solved = median_time(cold)
    whole, plain = median_time(lambda: cold(eliminate_chains=False), 1)
    theirs, rest = gtsam_optimum(linear_initialization(len(truth), edges), edges)
    print(
        f"\n{name}: cold {took * 1e3:.0f} ms, {solved.iterations} iterations, misfit "
        f"{misfit(solved.poses, edges):.4f}; all nodes {whole * 1e3:.0f} ms, "
        f"{misfit(plain.poses, edges):.4f}; gtsam {theirs * 1e3:.0f} ms, {rest:.4f}"
    )
    benchmark.extra_info["ms"] = took * 1e3
    solved = benchmark.pedantic(cold, rounds=1)
    assert solved.termination is Termination.CONVERGED
    assert solved.cost == pytest.approx(plain.cost, rel=1e-9)


@pytest.mark.parametrize("name", PATHS)
def test_warm(benchmark, size, name):
    """One more closure in a solved map, beside the same without elimination."""
    truth, edges = measure_path(name, size(10_000))
    before = Edges(*(column[:-1] for column in edges))
    start = least_squares(linear_initialization(len(truth), before), before).poses

    def warm(**how):
        return least_squares(start, edges, tolerance=1e-3, **how)

    took, solved = median_time(warm, 11)
    whole, _ = median_time(lambda: warm(eliminate_chains=False), 1)
    print(
        f"\n{name}: warm {took * 1e3:.1f} ms, {solved.iterations} iterations; all nodes {whole * 1e3:.0f} ms"
    )
    benchmark.extra_info["ms"] = took * 1e3
    solved = benchmark.pedantic(warm, rounds=1)
    assert solved.termination is Termination.CONVERGED
    assert solved.iterations <= 3


@pytest.mark.parametrize("name", PATHS)
def test_cold_with_a_tenth_of_a_radian_a_step(benchmark, size, name):
    """Heading errors exceed a turn within a hundred steps, so damping determines the optimum reached."""
    truth, edges = measure_path(name, size(10_000), NOISE * [1, 1, 10])
    start = linear_initialization(len(truth), edges)
    took, solved = median_time(lambda: least_squares(start, edges, iterations=100), 1)
    whole, plain = median_time(lambda: least_squares(start, edges, iterations=20, eliminate_chains=False), 1)
    theirs, rest = gtsam_optimum(start, edges)
    print(
        f"\n{name}: {took * 1e3:.0f} ms, {solved.iterations} iterations, misfit "
        f"{misfit(solved.poses, edges):.4f}; all nodes, 20 iterations {whole * 1e3:.0f} ms, "
        f"{misfit(plain.poses, edges):.4f}; gtsam {theirs * 1e3:.0f} ms, {rest:.4f}"
    )
    benchmark.pedantic(least_squares, args=(start, edges), kwargs={"iterations": 1}, rounds=1)
    assert misfit(solved.poses, edges) < 1.1


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


def integrated(edges, count):
    return np.vstack([np.zeros(3), integrate(edges.motion[: count - 1])])


def sweep(poses, edges, loops):
    """`ratslam.classic.relaxation.relax`, compiled, as a stand-in for the C++ original."""
    columns = [np.ascontiguousarray(column) for column in (*poses.T, edges.i, edges.j, *edges.motion.T)]
    compiled()(*columns, loops)
    return np.stack(columns[:3], axis=1)


@cache
def compiled():
    @pytest.importorskip("numba").njit
    def swept(x, y, th, i, j, mx, my, mt, loops):
        for _ in range(loops):
            for k in range(len(i)):
                a, b = i[k], j[k]
                c, s = np.cos(th[a]), np.sin(th[a])
                ex = 0.5 * (x[b] - x[a] - c * mx[k] + s * my[k])
                ey = 0.5 * (y[b] - y[a] - s * mx[k] - c * my[k])
                turned = th[b] - th[a] - mt[k]
                eth = 0.5 * (turned - 2 * np.pi * np.round(turned / (2 * np.pi)))
                x[a] += ex
                y[a] += ey
                th[a] += eth
                x[b] -= ex
                y[b] -= ey
                th[b] -= eth

    return swept


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
