"""What the map costs at ten thousand nodes; every test says what came out, none how fast it must be."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ratslam.posegraph import Edges, Ending, difference_error, least_squares, linear
from ratslam.relaxation import relax
from tactile.frames import between, integrate, wrap

NODES, CLOSURES = 10_000, 1_000
NOISE = np.array([0.02, 0.02, 0.01])
"""Standard deviations of every link, m and rad."""


class World(NamedTuple):
    """A robot that wandered on a grid: where it was, what it measured, and one closure more."""

    truth: np.ndarray
    edges: Edges
    more: Edges


def cost(poses: np.ndarray, edges: Edges) -> float:
    return float((difference_error(poses, edges)[0] ** 2 * edges.information).sum())


@pytest.fixture(scope="module")
def world() -> World:
    rng = np.random.default_rng(0)
    turn = rng.choice([0.0, 0.0, 0.0, np.pi / 2, -np.pi / 2], NODES - 1)
    motions = np.column_stack([np.ones(NODES - 1), np.zeros(NODES - 1), turn])
    truth = np.concatenate([np.zeros((1, 3)), integrate(motions)])
    pairs = cKDTree(truth[:, :2]).query_pairs(1.1, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > 50]
    extra = rng.choice(pairs, CLOSURES + 1, replace=False)
    chain = np.column_stack([np.arange(NODES - 1), np.arange(1, NODES)])
    i, j = np.concatenate([chain, extra]).T
    motion = between(truth[i], truth[j]) + rng.normal(size=(len(i), 3)) * NOISE
    motion[:, 2] = wrap(motion[:, 2])
    more = Edges(i, j, motion, np.tile(1 / NOISE**2, (len(i), 1)))
    return World(truth, Edges(*(column[:-1] for column in more)), more)


def reckoned(edges: Edges) -> np.ndarray:
    return np.concatenate([np.zeros((1, 3)), integrate(edges.motion[: NODES - 1])])


def test_the_linear_start(benchmark, world):
    """Two sparse solves take most of the drift out."""
    start = benchmark.pedantic(linear, args=(NODES, world.edges), rounds=1)
    assert np.isfinite(start).all()
    assert cost(start, world.edges) < 0.1 * cost(reckoned(world.edges), world.edges)


def test_least_squares_cold(benchmark, world):
    """From the linear start to the end."""
    start = linear(NODES, world.edges)
    solution = benchmark.pedantic(least_squares, args=(start, world.edges), rounds=1)
    benchmark.extra_info["iterations"] = solution.iterations
    assert solution.ending is Ending.CONVERGED
    freedom = 3 * CLOSURES  # three measurements a link less three unknowns a node: what closures add
    assert solution.cost == pytest.approx(freedom, rel=0.15)


def test_least_squares_warm(benchmark, world):
    """One closure more, from the solution without it: what a running map pays."""
    before = least_squares(linear(NODES, world.edges), world.edges).poses
    solution = benchmark.pedantic(least_squares, args=(before, world.more), rounds=1)
    benchmark.extra_info["iterations"] = solution.iterations
    assert solution.ending is Ending.CONVERGED
    assert solution.cost < cost(before, world.more)
    assert np.abs(solution.poses - before)[:, :2].max() < 1.0


def test_a_sweep_of_relaxation(benchmark, world):
    """One sweep over all links, in order."""
    motion, start = world.edges.motion, reckoned(world.edges)
    length, bearing = np.hypot(motion[:, 0], motion[:, 1]), np.arctan2(motion[:, 1], motion[:, 0])
    table = (world.edges.i, world.edges.j, length, bearing, motion[:, 2])
    swept = benchmark.pedantic(relax, args=(start, *table, 1, 0.5), rounds=1)
    assert np.isfinite(swept).all()
    assert cost(swept, world.edges) < cost(start, world.edges)
