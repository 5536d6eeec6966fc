"""Laws of the pose-graph solvers, their optimum on the M3500 graph, and maps written and read back."""

from __future__ import annotations

import warnings

import networkx
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.pose_graph import (
    Edges,
    Termination,
    difference_error,
    geman_mcclure,
    growing_equations,
    huber,
    least_squares,
    read_json,
    write_g2o,
    write_json,
)
from tactile.base.errors import InputError
from tactile.base.se2 import between, integrate
from tests.helpers.g2o import read_g2o


def loops(stream, count=120, closures=20, noise=(0.0, 0.0)):
    """A wandering path with true closures: poses and edges, measured with the given noise (m, rad)."""
    truth = np.vstack([np.zeros(3), integrate(stream.normal([0.5, 0, 0], [0.1, 0.1, 0.5], (count - 1, 3)))])
    i = np.concatenate([np.arange(count - 1), stream.integers(0, count // 2, closures)])
    j = np.concatenate([np.arange(1, count), stream.integers(count // 2, count, closures)])
    measured = between(truth[i], truth[j]) + stream.normal(0, 1, (len(i), 3)) * [noise[0], noise[0], noise[1]]
    sd = np.maximum([noise[0], noise[0], noise[1]], 0.01)
    return truth, Edges(i, j, measured, np.tile(1 / sd**2, (len(i), 1)))


@given(st.integers(0, 1000))
def test_jacobians_are_the_derivatives(seed):
    stream = np.random.default_rng(seed)
    poses = stream.normal(0, 1, (2, 3))
    edges = Edges(np.array([0]), np.array([1]), stream.normal(0, 1, (1, 3)), np.ones((1, 3)))
    value, *jacobians = difference_error(poses, *edges[:3])
    if abs(abs(value[0, 2]) - np.pi) < 0.01:
        return
    for node, jacobian in enumerate(jacobians):
        for axis in range(3):
            step = np.zeros((2, 3))
            step[node, axis] = 1e-6
            ahead, behind = (difference_error(poses + by, *edges[:3]) for by in (step, -step))
            slope = (ahead[0] - behind[0]) / 2e-6
            assert np.allclose(slope[0], jacobian[0, :, axis], atol=1e-6, rtol=1e-4)


def reckoned(edges, count):
    """The poses by the edges from each node to the next, which come first."""
    return np.vstack([np.zeros(3), integrate(edges.motion[: count - 1])])


@given(st.integers(0, 1000))
@settings(max_examples=20)
def test_the_optimum_under_a_robust_kernel_is_that_of_a_dense_solver(seed):
    """Huber's loss by scipy, on closures some of which are false, several times, or to the node itself."""
    stream = np.random.default_rng(seed)
    truth, edges = loops(stream, 30, 8, (0.02, 0.01))
    motion = edges.motion + (stream.random((37, 1)) < 0.2) * stream.normal(0, 0.3, (37, 3))
    motion[:29] = edges.motion[:29]
    i, j = (np.append(column, column[[30, 31, 5]]) for column in (edges.i, edges.j))
    j[-1] = i[-1]
    edges = Edges(i, j, np.vstack([motion, motion[[30, 31, 5]]]), np.tile(edges.information[:1], (40, 1)))
    robust = np.arange(40) >= 29
    solved = least_squares(truth, edges, kernel=huber(1.0), robust=robust)
    assert solved.termination is Termination.CONVERGED

    def loss(flat):
        poses = np.vstack([truth[:1], flat.reshape(-1, 3)])
        left, by_i, by_j = difference_error(poses, *edges[:3])
        chi2 = (left**2 * edges.information).sum(axis=1)
        value = np.where(robust & (chi2 > 1), 2 * np.sqrt(chi2) - 1, chi2)
        pull = np.where(robust & (chi2 > 1), 1 / np.sqrt(chi2), 1.0)[:, None] * left * edges.information
        slope = np.zeros_like(poses)
        np.add.at(slope, edges.i, 2 * np.einsum("eab,ea->eb", by_i, pull))
        np.add.at(slope, edges.j, 2 * np.einsum("eab,ea->eb", by_j, pull))
        return value.sum(), slope[1:].ravel()

    best = scipy.optimize.minimize(loss, solved.poses[1:].ravel(), jac=True, method="BFGS")
    assert solved.cost == pytest.approx(loss(solved.poses[1:].ravel())[0], rel=1e-12)
    assert solved.cost <= best.fun * (1 + 1e-12)
    assert np.abs(loss(solved.poses[1:].ravel())[1]).max() < 1e-6 * edges.information.max()


def test_a_graph_that_grows_is_solved_to_the_same_bits_as_one_that_was_loaded():
    truth, edges = loops(np.random.default_rng(7), 200, 60, (0.02, 0.01))
    order = np.argsort(np.maximum(edges.i, edges.j), kind="stable")  # closures when their nodes are there
    edges = Edges(*(column[order] for column in edges))
    growing = None
    for size in range(20, len(order), 3):
        part = Edges(*(column[:size] for column in edges))
        count = int(part.j.max()) + 1
        growing = growing_equations(count, part, growing)
        kept, fresh = (
            least_squares(truth[:count], part, equations=equations)
            for equations in (growing, growing_equations(count, part, None))
        )
        assert np.array_equal(kept.poses, fresh.poses)
        assert kept.cost == pytest.approx(least_squares(truth[:count], part).cost, rel=1e-9)


def test_robust_kernels_limit_the_influence_of_a_false_closure():
    truth, edges = loops(np.random.default_rng(0), noise=(0.02, 0.005))
    false = Edges(
        *(np.concatenate([a, b]) for a, b in zip(edges, ([3], [110], [[0, 0, 0]], [[1e4] * 3]), strict=True))
    )
    robust = np.arange(len(false.i)) >= len(truth) - 1
    plain = np.abs(least_squares(truth, false).poses - truth)[:, :2].max()
    for kernel in (huber(1.0), geman_mcclure(9.0)):
        poses = least_squares(truth, false, kernel=kernel, robust=robust).poses
        assert np.abs(poses - truth)[:, :2].max() < plain / 5


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
    solved = least_squares(reckoned(edges, count), edges)
    assert np.abs(solved.poses - truth)[:380, :2].max() < 0.5


def test_degenerate_graphs_terminate():
    nothing = Edges(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))
    assert least_squares(np.zeros((1, 3)), nothing).termination is Termination.CONVERGED
    one = Edges(np.array([0]), np.array([1]), np.array([[np.nan, 0, 0]]), np.ones((1, 3)))
    assert least_squares(np.zeros((2, 3)), one).termination is Termination.NOT_FINITE
    apart = Edges(np.array([0, 3]), np.array([1, 4]), np.ones((2, 3)), np.ones((2, 3)))
    solved = least_squares(np.zeros((5, 3)), apart)
    assert np.isfinite(solved.poses).all()
    assert solved.termination is Termination.CONVERGED


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
    ours = least_squares(start, edges)  # the error of gtsam is the logarithm of ours
    assert ours.termination is Termination.CONVERGED
    assert np.hypot(*(ours.poses[:, :2] - theirs).T).max() <= 1e-4


FINITE = st.floats(allow_nan=False, allow_infinity=False)


def example(seed=0):
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(6, 3, 3))
    i, j = np.arange(6), np.array([1, 2, 3, 4, 0, 2])
    return rng.normal(size=(7, 3)), Edges(i, j, rng.normal(size=(6, 3)), half + np.swapaxes(half, 1, 2))


@given(values=st.lists(FINITE, min_size=9, max_size=9))
def test_g2o_reads_back_exactly(values, tmp_path_factory):
    """Every finite float survives, bit for bit."""
    path = tmp_path_factory.mktemp("g2o") / "map.g2o"
    values = np.array(values)
    poses = np.stack([values[:3], values[3:6]])
    write_g2o(path, poses, Edges(np.array([0]), np.array([1]), values[None, 6:], np.ones((1, 3))))
    again, edges = read_g2o(path)
    assert again.tobytes() == poses.tobytes()
    assert edges.motion.tobytes() == values[None, 6:].tobytes()
    assert (edges.information == np.eye(3)).all()


def test_g2o_keeps_full_information_and_the_same_map_is_the_same_bytes(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    poses, edges = example()
    write_g2o(a, poses, edges)
    again, read = read_g2o(a)
    assert (again == poses).all()
    for ours, theirs in zip(edges, read, strict=True):
        assert (ours == theirs).all()
    write_g2o(b, again, read)
    assert a.read_bytes() == b.read_bytes()


def test_json_reads_back_ids_numbers_flags_and_directions_exactly(tmp_path):
    made = networkx.DiGraph()
    made.add_node(0, x=0.1, y=1 / 3, heading=-1e-300, template=4)
    made.add_node(1, x=1.0, y=2.0, heading=3.0, template=0)
    made.add_edge(0, 1, dx=0.1, dy=2 / 3, dtheta=0.0, traversals=2, length=1.5, duration=3.0, closure=True)
    a, b = tmp_path / "a", tmp_path / "b"
    write_json(a, made)
    again = read_json(a)
    assert isinstance(again, networkx.DiGraph)
    assert dict(again.nodes(data=True)) == dict(made.nodes(data=True))
    assert list(again.edges(data=True)) == list(made.edges(data=True))
    write_json(b, again)
    assert a.read_bytes() == b.read_bytes()


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "3", '{"nodes": 3, "edges": []}', '{"nodes": [{}]}'])
def test_files_that_are_not_graphs_are_refused(tmp_path, text):
    """The error names the file."""
    path = tmp_path / "map.json"
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        read_json(path)
    assert raised.value.where.startswith(str(path))
