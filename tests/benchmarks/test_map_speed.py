"""A map of 10 000 nodes and 1 000 closures: the linear solve, a cold and a warm least-squares solve."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from evaluation.trajectory import ate
from ratslam.posegraph import Edges, Ending, least_squares, linear
from tactile.frames import between, wrap

NODES, CLOSURES = 10_000, 1_000


@pytest.fixture(scope="module")
def city():
    """A walk along the streets of a grid, closures where it comes by again: true poses and edges."""
    stream = np.random.default_rng(0)
    heading = np.cumsum(stream.choice([0, 0, 0, np.pi / 2, -np.pi / 2], NODES))
    steps = np.stack([np.cos(heading[:-1]), np.sin(heading[:-1])], axis=1)
    truth = np.column_stack([np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), wrap(heading)])
    near = np.sort(cKDTree(truth[:, :2]).query_pairs(1.1, output_type="ndarray"), axis=1)
    near = stream.permutation(near[near[:, 1] - near[:, 0] > 50])[:CLOSURES]
    i = np.concatenate([np.arange(NODES - 1), near[:, 0]])
    j = np.concatenate([np.arange(1, NODES), near[:, 1]])
    motion = between(truth[i], truth[j]) + stream.normal(0, 1, (len(i), 3)) * [0.02, 0.02, 0.01]
    return truth, Edges(i, j, motion, np.tile([2500.0, 2500.0, 1e4], (len(i), 1)))


def test_linear(benchmark, city):
    truth, edges = city
    poses = benchmark.pedantic(linear, args=(NODES, edges), rounds=5)
    assert ate(poses, truth) < 5


def test_cold(benchmark, city):
    truth, edges = city
    start = linear(NODES, edges)
    solved = benchmark.pedantic(least_squares, args=(start, edges), rounds=3)
    benchmark.extra_info["iterations"] = solved.iterations
    assert solved.ending is Ending.CONVERGED
    assert ate(solved.poses, truth) < 1


def test_warm(benchmark, city):
    _, edges = city
    before = Edges(*(column[:-1] for column in edges))
    start = least_squares(linear(NODES, before), before).poses
    solved = benchmark.pedantic(least_squares, args=(start, edges), kwargs={"tolerance": 1e-3}, rounds=3)
    benchmark.extra_info["iterations"] = solved.iterations
    print(f"\nwarm: {solved.iterations} iterations")
    assert solved.ending is Ending.CONVERGED
    assert solved.iterations <= 3
