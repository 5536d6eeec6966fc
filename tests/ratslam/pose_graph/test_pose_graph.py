"""Laws of the pose-graph solvers, and their optimum on the M3500 graph."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.classic.relaxation import relax
from ratslam.pose_graph import (
    Edges,
    Termination,
    difference_error,
    geman_mcclure,
    huber,
    least_squares,
    linear_initialization,
    logmap_error,
)
from ratslam.pose_graph.chains import find_chains
from ratslam.pose_graph.edges import information_matrices
from ratslam.pose_graph.io import write_g2o
from ratslam.pose_graph.least_squares import ReducedEquations
from tactile.base.se2 import between, compose, integrate, inverse, wrap
from tests.helpers.g2o import read_g2o


def loops(stream, count=120, closures=20, noise=(0.0, 0.0)):
    """A wandering path with true closures: poses and edges, measured with the given noise (m, rad)."""
    truth = np.vstack([np.zeros(3), integrate(stream.normal([0.5, 0, 0], [0.1, 0.1, 0.5], (count - 1, 3)))])
    i = np.concatenate([np.arange(count - 1), stream.integers(0, count // 2, closures)])
    j = np.concatenate([np.arange(1, count), stream.integers(count // 2, count, closures)])
    measured = between(truth[i], truth[j]) + stream.normal(0, 1, (len(i), 3)) * [noise[0], noise[0], noise[1]]
    sd = np.maximum([noise[0], noise[0], noise[1]], 0.01)
    return truth, Edges(i, j, measured, np.tile(1 / sd**2, (len(i), 1)))


def tangle(stream, count):
    """Chains of all lengths connected at random: measured forwards and backwards, twice over, with
    blind alleys, a loop at one node, two nodes in a ring and one alone; nodes and edges in any order."""
    nodes, i, j = 1, [], []
    while nodes < count:
        length = int(stream.integers(1, 9))
        run = [int(stream.integers(nodes)), *range(nodes, nodes + length)]
        nodes += length
        if stream.random() < 0.7:
            run.append(int(stream.integers(nodes)))
        i, j = i + run[:-1], j + run[1:]
    i, j = i + [i[0], nodes, nodes + 1], j + [j[0], nodes + 1, nodes]
    name = np.concatenate([[0], 1 + stream.permutation(nodes + 2)])
    turned, order = stream.random(len(i)) < 0.5, stream.permutation(len(i))
    i, j = name[np.where(turned, j, i)][order], name[np.where(turned, i, j)][order]
    truth = stream.normal(0, 3, (nodes + 3, 3))
    measured = between(truth[i], truth[j]) + stream.normal(0, 0.05, (len(i), 3))
    half = stream.normal(0, 3, (len(i), 3, 3)) + 9 * np.eye(3)
    return truth, Edges(i, j, measured, half @ half.swapaxes(1, 2))


@given(st.integers(0, 1000), st.sampled_from([difference_error, logmap_error]))
def test_jacobians_are_the_derivatives(seed, error):
    stream = np.random.default_rng(seed)
    poses = stream.normal(0, 1, (2, 3))
    edges = Edges(np.array([0]), np.array([1]), stream.normal(0, 1, (1, 3)), np.ones((1, 3)))
    value, *jacobians = error(poses, edges)
    if abs(abs(value[0, 2]) - np.pi) < 0.01:
        return
    for node, jacobian in enumerate(jacobians):
        for axis in range(3):
            step = np.zeros((2, 3))
            step[node, axis] = 1e-6
            slope = (error(poses + step, edges)[0] - error(poses - step, edges)[0]) / 2e-6
            assert np.allclose(slope[0], jacobian[0, :, axis], atol=1e-6, rtol=1e-4)


def solve_dense(edges, count, heading):
    """Positions by dense least squares, headings given; node 0 at the origin."""
    rows = np.zeros((len(edges.i), count))
    rows[np.arange(len(edges.i)), edges.j] += 1
    rows[np.arange(len(edges.i)), edges.i] -= 1
    c, s = np.cos(heading[edges.i]), np.sin(heading[edges.i])
    x, y = edges.motion[:, 0], edges.motion[:, 1]
    moved = np.stack([c * x - s * y, s * x + c * y], axis=1)
    root = np.sqrt(edges.information[:, :2].mean(axis=1))[:, None]
    found = np.linalg.lstsq(root * rows[:, 1:], root * moved)[0]
    root = np.sqrt(edges.information[:, 2:])
    around = wrap(heading[edges.j] - heading[edges.i] - edges.motion[:, 2])
    left = np.linalg.lstsq(root * rows[:, 1:], root * around[:, None])[0]
    return np.vstack([np.zeros((1, 2)), found]), np.abs(left).max()


@given(st.integers(0, 1000), st.integers(5, 60), st.sampled_from([0.01, 0.1]))
def test_linear_initialization_is_the_dense_two_stage_solve(seed, closures, noise):
    stream = np.random.default_rng(seed)
    truth, edges = loops(stream, 120, closures, (0.02, noise))
    turned = stream.random(len(edges.i)) < 0.3  # some measured the other way round
    motion = edges.motion.copy()
    motion[turned] = inverse(motion[turned])
    i, j = np.where(turned, edges.j, edges.i), np.where(turned, edges.i, edges.j)
    edges = Edges(i, j, motion, stream.uniform(50, 500, (len(i), 3)))
    found = linear_initialization(len(truth), edges)
    positions, left = solve_dense(edges, len(truth), found[:, 2])
    assert left < 1e-9  # no change of the headings lowers the error
    assert np.abs(found[:, :2] - positions).max() < 1e-9


def test_linear_initialization_places_unconnected_parts_at_the_start():
    edges = Edges(np.array([0, 2, 3]), np.array([1, 3, 4]), np.tile([1.0, 0, 0], (3, 1)), np.ones((3, 3)))
    assert np.allclose(linear_initialization(6, edges, np.array([5, 5, np.pi / 2])), [
        [5, 5, np.pi / 2], [5, 6, np.pi / 2],
        [5, 5, np.pi / 2], [5, 6, np.pi / 2], [5, 7, np.pi / 2], [5, 5, np.pi / 2],
    ])  # fmt: skip


@given(st.integers(0, 1000), st.booleans())
def test_exact_graphs_are_solved_exactly(seed, reduced):
    truth, edges = loops(np.random.default_rng(seed))
    solved = least_squares(truth, edges, eliminate_chains=reduced)
    assert solved.termination is Termination.CONVERGED
    assert np.abs(solved.poses - truth).max() < 1e-9
    found = linear_initialization(len(truth), edges)
    assert np.abs(found[:, :2] - truth[:, :2]).max() < 1e-6


@given(st.integers(0, 1000), st.integers(2, 60))
def test_chains_lead_from_junction_to_junction(seed, count):
    truth, edges = tangle(np.random.default_rng(seed), count)
    reducible = np.random.default_rng(seed + 1).random(len(edges.i)) < 0.9
    found = find_chains(len(truth), edges.i, edges.j, reducible)
    assert sorted([*found.junctions, *found.inner]) == list(range(len(truth)))
    assert sorted([*found.edge, *found.direct]) == list(range(len(edges.i)))
    assert reducible[found.edge].all()
    assert found.junctions[0] == 0
    start = np.where(found.sign > 0, edges.i[found.edge], edges.j[found.edge])
    stop = np.where(found.sign > 0, edges.j[found.edge], edges.i[found.edge])
    begins = np.isin(np.arange(len(start)), found.first)
    assert np.array_equal(start[begins], found.junctions[found.start[: len(found.first)]])
    assert np.array_equal(stop[np.roll(begins, -1)], found.junctions[found.end[: len(found.first)]])
    assert np.array_equal(start[~begins], found.inner)
    assert np.array_equal(stop[found.into], found.inner)
    # Every node with two reducible edges is in a chain, except in isolated rings.
    degree = np.bincount(edges.i, minlength=len(truth)) + np.bincount(edges.j, minlength=len(truth))
    degree[edges.i[~reducible]] = degree[edges.j[~reducible]] = degree[edges.i[edges.i == edges.j]] = 9
    assert set(np.flatnonzero(degree[:-2] == 2)) - {0} <= {*found.inner, *ring(edges)}


def ring(edges):
    """Nodes whose two edges lead to the same other node."""
    pairs = np.sort(np.stack([edges.i, edges.j], axis=1), axis=1)
    kinds, times = np.unique(pairs, axis=0, return_counts=True)
    return kinds[times > 1].ravel()


@given(st.integers(0, 1000), st.integers(2, 60), st.sampled_from([difference_error, logmap_error]))
def test_a_step_with_chains_eliminated_balances_the_full_graph(seed, count, error):
    truth, edges = tangle(np.random.default_rng(seed), count)
    at = truth + np.random.default_rng(seed + 1).normal(0, 0.2, truth.shape)
    errors = error(at, edges)
    reduced = ReducedEquations(len(at), edges, np.zeros(len(edges.i), bool))
    short = reduced.step(at, errors, information_matrices(edges.information), 0.0)
    residual, by_i, by_j = errors
    # Least squares of the linearised errors, unconnected parts included: the residuals must be equal.
    change = (
        residual
        + np.einsum("eab,eb->ea", by_i, short[edges.i])
        + np.einsum("eab,eb->ea", by_j, short[edges.j])
    )
    force = np.einsum("eab,eb->ea", information_matrices(edges.information), change)
    balance = np.zeros_like(at)
    np.add.at(balance, edges.i, np.einsum("eba,eb->ea", by_i, force))
    np.add.at(balance, edges.j, np.einsum("eba,eb->ea", by_j, force))
    assert np.abs(balance[1:]).max() < 1e-7 * np.abs(force).max()


@given(st.integers(0, 200), st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3)))
def test_a_moved_graph_has_the_moved_solution(seed, by):
    truth, edges = loops(np.random.default_rng(seed), noise=(0.02, 0.01))
    here = least_squares(truth, edges).poses
    there = least_squares(compose(np.array(by), truth), edges).poses
    gap = there - compose(np.array(by), here)
    assert np.abs(gap[:, :2]).max() < 1e-5
    assert np.abs(wrap(gap[:, 2])).max() < 1e-5


@given(st.integers(0, 1000), st.sampled_from([0.01, 0.03]), st.sampled_from([difference_error, logmap_error]))
@settings(max_examples=40)
def test_eliminating_chains_reaches_the_same_optimum(seed, noise, error):
    truth, edges = loops(np.random.default_rng(seed), 200, 40, (0.02, noise))
    start = linear_initialization(len(truth), edges)
    whole, reduced = (least_squares(start, edges, error=error, eliminate_chains=f) for f in (False, True))
    assert whole.termination is reduced.termination is Termination.CONVERGED
    assert reduced.cost == pytest.approx(whole.cost, rel=1e-9)
    assert np.abs(between(whole.poses, reduced.poses)).max() < 1e-5


def test_the_cost_under_heavy_heading_noise_is_chi_square():
    """0.1 rad per step: the final cost is chi-square with as many degrees of freedom."""
    for seed in range(5):
        truth, edges = loops(np.random.default_rng(seed), 1200, 150, (0.02, 0.1))
        start = linear_initialization(len(truth), edges)
        reduced = least_squares(start, edges, eliminate_chains=True)
        assert reduced.termination is Termination.CONVERGED
        free = 3 * (len(edges.i) - len(truth) + 1)
        assert reduced.cost < free + 5 * np.sqrt(2 * free)
        whole = least_squares(start, edges, eliminate_chains=False, iterations=reduced.iterations)
        assert reduced.cost <= whole.cost * (1 + 1e-9)


@pytest.mark.parametrize("reduced", [False, True])
def test_robust_kernels_limit_the_influence_of_a_false_closure(reduced):
    truth, edges = loops(np.random.default_rng(0), noise=(0.02, 0.005))
    false = Edges(
        *(np.concatenate([a, b]) for a, b in zip(edges, ([3], [110], [[0, 0, 0]], [[1e4] * 3]), strict=True))
    )
    robust = np.arange(len(false.i)) >= len(truth) - 1
    harm = {}
    for name, kernel in {"huber": huber(1.0), "geman": geman_mcclure(9.0)}.items():
        poses = least_squares(truth, false, kernel=kernel, robust=robust, eliminate_chains=reduced).poses
        harm[name] = np.abs(poses - truth)[:, :2].max()
    plain = np.abs(least_squares(truth, false, eliminate_chains=reduced).poses - truth)[:, :2].max()
    assert harm["geman"] < plain / 5
    assert harm["huber"] < plain / 5


def test_heavy_heading_noise_terminates_without_nan():
    stream = np.random.default_rng(1)
    _, edges = loops(stream, 400, 60, (0.02, 0.1))
    start = np.vstack([np.zeros(3), integrate(edges.motion[:399])])
    solved = least_squares(start, edges, iterations=200)
    assert np.isfinite(solved.poses).all()
    assert solved.termination in (Termination.CONVERGED, Termination.NO_DECREASE)
    better = least_squares(linear_initialization(400, edges), edges, iterations=200)
    assert np.isfinite(better.poses).all()
    assert better.cost <= solved.cost * 1.001


def test_heading_drift_of_more_than_half_a_turn_is_corrected():
    count = 400
    truth = np.vstack([np.zeros(3), integrate(np.tile([0.1, 0, 0.05], (count - 1, 1)))])
    i, j = np.arange(count - 1), np.arange(1, count)
    measured = between(truth[i], truth[j]) + [0, 0, 0.01]  # 4 rad too much by the end
    edges = Edges(
        np.append(i, np.arange(0, 260, 10)), np.append(j, np.arange(0, 260, 10) + 126),
        np.vstack([measured, between(truth[np.arange(0, 260, 10)], truth[np.arange(0, 260, 10) + 126])]),
        np.vstack([np.tile([1e4, 1e4, 1e3], (count - 1, 1)), np.tile([1e4, 1e4, 1e4], (26, 1))]),
    )  # fmt: skip
    solved = least_squares(linear_initialization(count, edges), edges)
    assert np.abs(solved.poses - truth)[:380, :2].max() < 0.5


def test_degenerate_graphs_terminate():
    nothing = Edges(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))
    assert least_squares(np.zeros((1, 3)), nothing).termination is Termination.CONVERGED
    one = Edges(np.array([0]), np.array([1]), np.array([[np.nan, 0, 0]]), np.ones((1, 3)))
    assert least_squares(np.zeros((2, 3)), one).termination is Termination.NOT_FINITE
    apart = Edges(np.array([0, 3]), np.array([1, 4]), np.ones((2, 3)), np.ones((2, 3)))
    for reduced in (False, True):
        solved = least_squares(np.zeros((5, 3)), apart, eliminate_chains=reduced)
        assert np.isfinite(solved.poses).all()
        assert solved.termination is Termination.CONVERGED
    assert np.isfinite(linear_initialization(5, apart)).all()


@pytest.fixture(scope="module")
def m3500(reference_data):
    table = np.loadtxt(reference_data / "data" / "m3500_edges.csv", delimiter=",", skiprows=1)
    start = np.loadtxt(reference_data / "data" / "m3500_vertices.csv", delimiter=",", skiprows=1)[:, 1:]
    information = np.zeros((len(table), 3, 3))
    for k, (a, b) in enumerate(zip(*np.triu_indices(3), strict=True)):
        information[:, a, b] = information[:, b, a] = table[:, 5 + k]
    return start, Edges(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:5], information)


def test_m3500_reaches_the_optimum_of_gtsam(m3500):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gtsam = pytest.importorskip("gtsam")
    start, edges = m3500
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(start):
        values.insert(k, gtsam.Pose2(*pose))
    for i, j, motion, weight in zip(*edges, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(weight)
        graph.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*motion), noise))
    graph.add(gtsam.NonlinearEqualityPose2(0, gtsam.Pose2(*start[0])))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-15)
    settings.setAbsoluteErrorTol(1e-15)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    theirs = np.array([[solved.atPose2(k).x(), solved.atPose2(k).y()] for k in range(len(start))])
    for error, near in ((logmap_error, 1e-6), (difference_error, 1e-4)):
        for reduced in (False, True):
            ours = least_squares(start, edges, error=error, eliminate_chains=reduced)
            assert ours.termination is Termination.CONVERGED
            assert np.hypot(*(ours.poses[:, :2] - theirs).T).max() <= near


def test_relaxation_leaves_exact_graphs_and_pulls_others_together():
    truth, edges = loops(np.random.default_rng(2), 30, 5)
    motion = edges.motion
    columns = (np.hypot(motion[:, 0], motion[:, 1]), np.arctan2(motion[:, 1], motion[:, 0]), motion[:, 2])
    assert np.abs(relax(truth, edges.i, edges.j, *columns, 20, 0.5) - truth).max() < 1e-12
    bent = truth + np.random.default_rng(3).normal(0, 0.05, truth.shape)
    errors = [
        np.abs(difference_error(relax(bent, edges.i, edges.j, *columns, n, 0.5), edges)[0]).max()
        for n in (0, 50)
    ]
    assert errors[1] < errors[0] / 5


def test_g2o_files_read_back_exactly(tmp_path):
    truth, edges = loops(np.random.default_rng(4), 20, 4)
    write_g2o(tmp_path / "a.g2o", truth, edges)
    poses, back = read_g2o(tmp_path / "a.g2o")
    assert np.array_equal(poses, truth)
    assert np.array_equal(back.motion, edges.motion)
    write_g2o(tmp_path / "b.g2o", poses, back)
    assert (tmp_path / "a.g2o").read_bytes() == (tmp_path / "b.g2o").read_bytes()
