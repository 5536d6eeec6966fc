"""The classic relaxation, compared with a naive implementation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.classic.relaxation import relax
from tactile.base.se2 import between, wrap


def naive(poses, start, end, distance, heading, facing, loops, correction):
    """Each link in turn, as in the paper."""
    poses = poses.copy()
    for _ in range(loops):
        for link in range(len(start)):
            a, b = start[link], end[link]
            bearing = poses[a, 2] + heading[link]
            expected = poses[a, :2] + distance[link] * np.array([np.cos(bearing), np.sin(bearing)])
            pull = correction * (poses[b, :2] - expected)
            turn = poses[b, 2] - poses[a, 2] - facing[link]
            turn = correction * np.arctan2(np.sin(turn), np.cos(turn))
            poses[a, :2] += pull
            poses[b, :2] -= pull
            poses[a, 2] += turn
            poses[b, 2] -= turn
    poses[:, 2] = np.arctan2(np.sin(poses[:, 2]), np.cos(poses[:, 2]))
    return poses


def links(poses, ends):
    motion = between(poses[ends[:, 0]], poses[ends[:, 1]])
    length, bearing = np.hypot(motion[:, 0], motion[:, 1]), np.arctan2(motion[:, 1], motion[:, 0])
    return ends[:, 0], ends[:, 1], length, bearing, motion[:, 2]


@given(seed=st.integers(0, 2**32 - 1), correction=st.floats(0.05, 1), loops=st.integers(0, 5))
def test_the_sweep_equals_the_naive_one(seed, correction, loops):
    """Order, signs and shares are those of the naive loop."""
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-3, 3, (12, 3))
    ends = np.array([rng.permutation(12)[:2] for _ in range(20)])
    table = links(rng.uniform(-3, 3, (12, 3)), ends)
    ours = relax(poses, table, loops, correction)
    theirs = naive(poses, *table, loops, correction)
    np.testing.assert_allclose(ours[:, :2], theirs[:, :2], rtol=0, atol=1e-12)
    np.testing.assert_allclose(wrap(ours[:, 2] - theirs[:, 2]), 0, atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1))
def test_an_exact_graph_stays(seed):
    """If every link agrees, no number of sweeps moves a node."""
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-3, 3, (10, 3))
    ends = np.array([rng.permutation(10)[:2] for _ in range(15)])
    np.testing.assert_allclose(relax(poses, links(poses, ends), 50, 0.5), poses, rtol=0, atol=1e-12)


def test_a_link_shares_its_error():
    """One sweep with a correction of one half closes a link of two nodes from both ends."""
    none = np.array([0.0])
    link = np.array([0]), np.array([1]), np.array([2.0]), none, none
    out = relax(np.zeros((2, 3)), link, 1, 0.5)
    assert out == pytest.approx(np.array([[-1.0, 0, 0], [1.0, 0, 0]]))


def test_empty_graphs_are_unchanged():
    """Without links or nodes the poses are returned unchanged."""
    empty, ids = np.zeros(0), np.zeros(0, int)
    none = ids, ids, empty, empty, empty
    assert relax(np.ones((1, 3)), none, 3, 0.5).tolist() == [[1.0, 1.0, 1.0]]
    assert relax(np.zeros((0, 3)), none, 3, 0.5).shape == (0, 3)
