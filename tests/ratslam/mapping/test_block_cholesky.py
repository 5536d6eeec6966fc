"""Laws of the factorisation by blocks, against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.normal_equations import BlockPattern

seeds, counts = st.integers(0, 10_000), st.integers(1, 25)


def graph(stream, count):
    """A chain of nodes with edges between random ones, some of them twice."""
    a = np.arange(count - 1)
    pairs = stream.integers(0, count, (count, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return np.concatenate([a, pairs[:, 0], pairs[:, 1]]), np.concatenate([a + 1, pairs[:, 1], pairs[:, 0]])


def matrix(stream, pattern, a, b, damping=1.0):
    """A positive definite matrix on a graph: the blocks in the order of elimination, and the dense one in
    the order of the nodes."""
    count = pattern.count
    jacobian = stream.normal(size=(len(a), 3, 6))
    each = np.swapaxes(jacobian, 1, 2) @ jacobian
    diagonal = np.tile(damping * np.eye(3), (count, 1, 1))
    above, dense = np.zeros((len(pattern.row), 3, 3)), np.zeros((count, 3, count, 3))
    dense[np.arange(count), :, np.arange(count)] = diagonal
    for i, j, slot, block in zip(a, b, pattern.slot, each, strict=True):
        diagonal[pattern.place[i]] += block[:3, :3]
        diagonal[pattern.place[j]] += block[3:, 3:]
        cross = block[:3, 3:]
        above[slot] += cross if pattern.place[i] < pattern.place[j] else cross.T
        dense[i, :, i] += block[:3, :3]
        dense[j, :, j] += block[3:, 3:]
        dense[i, :, j] += cross
        dense[j, :, i] += cross.T
    return diagonal, above, dense.reshape(3 * count, 3 * count)


@given(seeds, counts, st.integers(1, 4))
def test_solutions_and_determinant_are_those_of_the_dense_matrix(seed, count, columns):
    stream = np.random.default_rng(seed)
    a, b = graph(stream, count)
    pattern = BlockPattern(count, a, b)
    diagonal, above, dense = matrix(stream, pattern, a, b)
    factor = pattern.factorise(diagonal, above)
    right = stream.normal(size=(count, 3, columns))
    solution = factor.solve(right[np.argsort(pattern.place)])[pattern.place]
    expected = np.linalg.solve(dense, right.reshape(3 * count, columns))
    assert np.allclose(solution.reshape(expected.shape), expected, rtol=1e-7, atol=1e-9)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-9)


@given(seeds, counts)
def test_the_order_of_elimination_is_a_permutation(seed, count):
    pattern = BlockPattern(count, *graph(np.random.default_rng(seed), count))
    assert sorted(pattern.place.tolist()) == list(range(count))


@given(seeds, st.integers(2, 25))
def test_a_pattern_serves_many_matrices(seed, count):
    stream = np.random.default_rng(seed)
    a, b = graph(stream, count)
    pattern = BlockPattern(count, a, b)
    right = stream.normal(size=(count, 3, 1))
    cases = [matrix(stream, pattern, a, b)[:2] for _ in range(3)]
    together = [pattern.factorise(*case).solve(right) for case in cases]
    apart = [BlockPattern(count, a, b).factorise(*case).solve(right) for case in reversed(cases)]
    assert all(np.array_equal(one, other) for one, other in zip(together, reversed(apart), strict=True))


@given(seeds, counts)
def test_a_matrix_that_is_not_positive_definite_has_no_factor(seed, count):
    stream = np.random.default_rng(seed)
    a, b = graph(stream, count)
    pattern = BlockPattern(count, a, b)
    diagonal, above, dense = matrix(stream, pattern, a, b)
    node = int(stream.integers(count))
    diagonal[pattern.place[node]] -= 2 * np.linalg.eigvalsh(dense)[-1] * np.eye(3)
    assert pattern.factorise(diagonal, above) is None
    assert pattern.factorise(np.zeros_like(diagonal), np.zeros_like(above)) is None


def test_a_graph_without_nodes_has_an_empty_solution():
    none = np.zeros(0, int)
    factor = BlockPattern(0, none, none).factorise(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    assert factor.solve(np.zeros((0, 3, 2))).shape == (0, 3, 2)
    assert factor.log_determinant == 0.0
