"""Laws of the solvers of maps and of pose graphs by dense algebra, and maps written and read back."""

import warnings

import networkx
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from ratslam.mapping import pose_graph
from ratslam.mapping.normal_equations import BlockPattern
from ratslam.mapping.optimizer import CalibrationPrior, MapCovariance, MapFit, MapProblem, System, solve
from ratslam.mapping.pose_graph import Edges, Termination, difference_error, read_json, write_g2o, write_json
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, correct_heading, integrate, wrap
from tests.helpers.g2o import read_g2o
from tests.ratslam.mapping import optimizer_cases as cases

PRIORS = CalibrationPrior(0.03, 0.02), CalibrationPrior(0.03, 0.02, -0.01, 0.04)
"""Of the bias alone, and with a turn error."""
priors = st.sampled_from(PRIORS)
seeds = st.integers(0, 1000)


@settings(max_examples=20)
@given(seeds, st.sampled_from([cases.SURE, 3.0]), priors)
def test_a_step_is_gauss_newtons(seed, scale, prior):
    """By a dense least-squares solve of numerical derivatives."""
    stream = np.random.default_rng(seed)
    truth, chain, closures = cases.laps(stream, 0.04, 8, 0.02, -0.05)
    closures = closures._replace(scale=np.full(3, scale))
    start = MapFit(truth + stream.normal(0, 0.03, truth.shape), 0.01, np.zeros(0), 0.02)
    weights, x = cases.robust_weights(start, chain, closures), cases.unknowns(start, prior)

    def errors(x):
        return cases.residuals(x, start, chain, closures, prior, weights)

    step = np.linalg.lstsq(cases.slopes(errors, x), -errors(x), rcond=None)[0]
    fit = solve(start, MapProblem(chain, closures, prior), 1)
    assert np.allclose(fit.weights, weights)
    assert np.allclose(wrap(cases.unknowns(fit, prior) - x - step), 0, atol=1e-6)


@settings(max_examples=6)
@given(seeds, priors)
def test_without_robust_weights_it_is_least_squares(seed, prior):
    stream = np.random.default_rng(seed)
    _, chain, closures = cases.laps(stream, 0.04, 8, 0.03)
    start = cases.from_odometry(chain)
    x = cases.unknowns(solve(start, MapProblem(chain, closures, prior), 50), prior)
    rest = start, chain, closures, prior, np.ones(3)
    found = least_squares(cases.residuals, cases.unknowns(start, prior), args=rest, method="lm", xtol=1e-12)
    assert np.abs(wrap(found.x - x)).max() < 1e-4
    assert (cases.residuals(x, *rest) ** 2).sum() <= 2 * found.cost * (1 + 1e-6)


@pytest.mark.parametrize("bias", [0.06, -0.03])
@pytest.mark.parametrize(
    ("turn_error", "prior"),
    [(0.0, cases.WIDE), (0.0, cases.BOTH_WIDE), (0.2, cases.BOTH_WIDE), (-0.1, cases.BOTH_WIDE)],
)
def test_true_closures_determine_the_calibration_and_all_poses(bias, turn_error, prior):
    truth, chain, closures = cases.laps(np.random.default_rng(0), bias, turn_error=turn_error)
    start = cases.from_odometry(chain)
    assert cases.apart(start.poses, truth) > 0.5
    fit = solve(start, MapProblem(chain, closures, prior), 30)
    assert cases.apart(fit.poses, truth) < 1e-5
    assert fit.bias == pytest.approx(bias, abs=1e-6)
    assert fit.turn_error == pytest.approx(turn_error, abs=1e-6)
    assert np.allclose(fit.weights, 1)


def robust_case(seed, cost_limit, prior=PRIORS[0], count=8):
    """Laps with noise, a start that is off, and sequences of which the second is false."""
    stream = np.random.default_rng(seed)
    truth, chain, closures = cases.laps(stream, 0.04, count, 0.02)
    turn = closures.turn + (closures.sequence == 1) * stream.uniform(-0.5, 0.5)
    closures = closures._replace(scale=stream.uniform(1, 20, 3), cost_limit=cost_limit, turn=turn)
    start = truth + stream.normal(0, 0.05, truth.shape)
    start[0] = truth[0]
    return MapFit(start, 0.0, np.zeros(3)), MapProblem(chain, closures, prior)


def cost_by_loops(fit, problem):
    chain, closures, prior, _ = problem
    odometry, recall = cases.parts(fit, chain, closures)
    cost = (odometry**2).sum() + ((fit.bias - prior.bias) / prior.bias_sd) ** 2
    if prior.turn_error_sd:
        cost += ((fit.turn_error - prior.turn_error) / prior.turn_error_sd) ** 2
    for sequence, scale in enumerate(closures.scale):
        each = (recall[closures.sequence == sequence] ** 2).sum(axis=1)
        if np.isfinite(closures.cost_limit):
            each = closures.cost_limit * each / (closures.cost_limit + each)
        mean = each.sum() / max(len(each), 1)
        cost += len(each) * scale * mean / (scale + mean)
    return cost


@given(seeds, st.sampled_from([np.inf, 20.0, 6.0, 0.5]), priors)
def test_every_step_lowers_the_robust_cost(seed, cost_limit, prior):
    """And it is that of explicit loops."""
    fit, problem = robust_case(seed, cost_limit, prior)
    fit, costs = fit._replace(bias=0.01, turn_error=0.02), []
    for _ in range(16):
        costs.append(System(problem).robust_cost(fit))
        assert costs[-1] == pytest.approx(cost_by_loops(fit, problem), rel=1e-9)
        assert np.allclose(fit.poses[0], cases.START, rtol=0, atol=1e-12)  # the first frame never moves
        fit = solve(fit, problem, 1)
    assert (np.diff(costs) <= 1e-9 * np.array(costs[:-1])).all()
    assert costs[-1] < 0.5 * costs[0]


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("cost_limit", [np.inf, 6.0, 1.0])
def test_the_solution_has_the_least_robust_cost(cost_limit, prior):
    start, problem = robust_case(3, cost_limit, prior)
    fit = solve(start, problem, 500)
    assert ((fit.weights > 0.01) & (fit.weights < 0.999)).any()
    least, x = System(problem).robust_cost(fit), cases.unknowns(fit, prior)
    for step in np.vstack([np.eye(len(x)), -np.eye(len(x))]):
        assert System(problem).robust_cost(cases.fit_of(x + 1e-3 * step, fit, prior)) > least


def test_a_coarser_tolerance_takes_fewer_steps():
    start, problem = robust_case(0, 6.0)
    fine = solve(start, problem, 100, 1e-9)
    for tolerance in (1e-3, 1e-5):
        coarse = solve(start, problem, 100, tolerance)
        assert 0 < cases.apart(coarse.poses, fine.poses) < 100 * tolerance
    assert np.array_equal(solve(start, problem, 1, 1e-9).poses, solve(start, problem, 100, 1e3).poses)


@pytest.mark.parametrize("seed", range(3))
def test_no_step_raises_the_cost(seed):
    """A closure that turns a long chain by radians, where a whole Gauss-Newton step would."""
    turn = np.random.default_rng(seed).normal(0, 0.3, 300)
    chain = cases.chained(np.column_stack([np.full(300, 0.1), np.zeros(300), turn]))
    closures = cases.closed([(3 + k, 296 + k) for k in range(4)], [2.0] * 4, [0] * 4, [20.0])
    system, fit, costs = System(MapProblem(chain, closures, PRIORS[1])), cases.from_odometry(chain), []
    for _ in range(9):
        costs.append(system.robust_cost(fit))
        fit = system.solve(fit, 1)
    assert np.diff(costs).max() <= 1e-6 * costs[0]


@given(st.floats(0, 5), st.floats(-0.2, 0.2), st.floats(-0.3, 0.3), seeds)
def test_a_turn_error_is_a_share_of_the_turn(length, bias, turn_error, seed):
    """The correction undoes the miscalibration, and a bias and a turn error add up."""
    motion = np.random.default_rng(seed).uniform(-1, 1, (1, 3))
    measured = cases.miscalibrated(motion, np.array([length]), bias, turn_error)
    assert np.allclose(correct_heading(measured, length, bias, turn_error), motion, atol=1e-12)
    both = correct_heading(motion, length, bias, turn_error)
    as_bias = correct_heading(motion, 1.0, bias * length + turn_error * motion[0, 2])
    assert np.allclose(both, as_bias, atol=1e-12)
    straight = motion * [1, 1, 0]
    assert np.allclose(correct_heading(straight, 1.0, 0.0, turn_error), straight, atol=1e-12)


@settings(max_examples=10)
@given(seeds, st.sampled_from([1e12, 5.0]))
def test_without_a_turn_error_all_is_as_with_the_bias_alone(seed, scale):
    """A standard deviation of zero fixes the turn error, whatever its value is."""
    stream = np.random.default_rng(seed)
    _, chain, closures = cases.laps(stream, 0.04, 12, 0.02)
    closures = closures._replace(scale=np.full(3, scale))
    alone = MapProblem(chain, closures, CalibrationPrior(0.01, 0.02))
    fixed = alone._replace(prior=CalibrationPrior(0.01, 0.02, 0.3, 0.0))
    start = cases.from_odometry(chain, 0.01)
    fits = [solve(start, problem, 10) for problem in (alone, fixed)]
    assert np.array_equal(fits[0].poses, fits[1].poses)
    assert [fit[1:2] + fit[3:] for fit in fits] == [(fits[0].bias, 0.0)] * 2
    # Odometry whose turns were corrected beforehand by a turn error that is then held.
    before = cases.miscalibrated(chain.motion, 0 * chain.length, 0.0, 0.1)
    held = solve(start._replace(turn_error=0.1), fixed._replace(chain=chain._replace(motion=before)), 10)
    assert held.turn_error == 0.1
    assert cases.apart(held.poses, fits[0].poses) < 1e-9
    nearly = alone._replace(prior=CalibrationPrior(0.01, 0.02, 0.0, 1e-9))
    near, pair = solve(start, nearly, 10), (3, len(chain.length), 0.2)
    assert cases.apart(near.poses, fits[0].poses) < 1e-9
    one, same, close = (MapCovariance(near, each).relative(*pair) for each in (alone, fixed, nearly))
    assert np.array_equal(one, same)
    assert np.allclose(one, close, rtol=1e-6, atol=1e-12)


@given(seeds, st.sampled_from([CalibrationPrior(0.0, 0.05), CalibrationPrior(0.0, 0.05, 0.02, 0.1)]))
@settings(max_examples=20)
def test_relative_covariance_is_the_marginal_of_the_whole_information(seed, prior):
    stream = np.random.default_rng(seed)
    truth, chain, closures = cases.laps(stream, 0.02, 6, 0.02)
    closures = closures._replace(scale=np.array([2.0, 5.0, 20.0]))
    fit = MapFit(truth + stream.normal(0, 0.02, truth.shape), 0.01, np.zeros(3), 0.03)
    i, j = stream.choice(len(truth), 2, replace=False).tolist()
    turn = stream.uniform(-3, 3)
    weights, x = cases.robust_weights(fit, chain, closures), cases.unknowns(fit, prior)
    jacobian = cases.slopes(lambda x: cases.residuals(x, fit, chain, closures, prior, weights), x)

    def seen(x):
        poses = cases.fit_of(x, fit, prior).poses
        gap = between(compose(poses[i], np.array([0, 0, turn])), poses[j])
        return np.append(gap[:2], poses[j, 2] - poses[i, 2])  # unwrapped, so that the slope has no jump

    by = cases.slopes(seen, x)
    expected = by @ np.linalg.inv(jacobian.T @ jacobian) @ by.T
    covariance = MapCovariance(fit, MapProblem(chain, closures, prior)).relative(i, j, turn)
    assert np.allclose(covariance, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_an_unconnected_frame_leaves_the_map_unchanged_and_a_graph_without_nodes_has_an_empty_solution():
    chain = cases.chained(np.tile([0.5, 0.0, 0.1], (4, 1)))
    chain.variance[-1] = np.inf
    start, problem = cases.reckoned(chain) + 0.01, MapProblem(chain, cases.closed([]), cases.WIDE)
    fit = solve(MapFit(start, 0.01, np.zeros(0)), problem, 5)
    assert np.array_equal(fit.poses, start)
    assert fit.bias == 0.01
    assert np.isinf(MapCovariance(fit, problem).relative(0, 4, 0.0)).all()
    none, blocks = np.zeros(0, int), np.zeros((0, 3, 3))
    factor = BlockPattern(0, none, none).factorise(blocks, blocks)
    assert factor.solve(np.zeros((0, 3, 2))).shape == (0, 3, 2)
    assert factor.log_determinant == 0.0


counts = st.integers(1, 25)


def matrix(stream, count):
    """A positive definite matrix on a chain of nodes with edges between random ones, some of them twice: the
    pattern, its blocks in the order of elimination, and the dense one in the order of the nodes."""
    pairs = stream.integers(0, count, (count, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    chain = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    a, b = np.concatenate([chain, pairs, pairs[:, ::-1]]).T
    pattern = BlockPattern(count, a, b)
    jacobian = stream.normal(size=(len(a), 3, 6))
    each = np.swapaxes(jacobian, 1, 2) @ jacobian
    diagonal = np.tile(np.eye(3), (count, 1, 1))
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
    return pattern, diagonal, above, dense.reshape(3 * count, 3 * count)


@given(seeds, counts, st.integers(1, 4))
def test_solutions_and_determinant_are_those_of_the_dense_positive_definite_matrix(seed, count, columns):
    stream = np.random.default_rng(seed)
    pattern, diagonal, above, dense = matrix(stream, count)
    factor = pattern.factorise(diagonal, above)
    right = stream.normal(size=(count, 3, columns))
    solution = factor.solve(right[np.argsort(pattern.place)])[pattern.place]
    expected = np.linalg.solve(dense, right.reshape(3 * count, columns))
    assert np.allclose(solution.reshape(expected.shape), expected, rtol=1e-7, atol=1e-9)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-9)
    node = int(stream.integers(count))
    diagonal[pattern.place[node]] -= 2 * np.linalg.eigvalsh(dense)[-1] * np.eye(3)
    assert pattern.factorise(diagonal, above) is None
    assert pattern.factorise(np.zeros_like(diagonal), np.zeros_like(above)) is None


def loops(stream, count=120, closures=20, noise=(0.0, 0.0)):
    """A wandering path with true closures: poses and edges, measured with the given noise (m, rad)."""
    truth = np.vstack([np.zeros(3), integrate(stream.normal([0.5, 0, 0], [0.1, 0.1, 0.5], (count - 1, 3)))])
    i = np.concatenate([np.arange(count - 1), stream.integers(0, count // 2, closures)])
    j = np.concatenate([np.arange(1, count), stream.integers(count // 2, count, closures)])
    noise = np.array(noise)[[0, 0, 1]]
    measured = between(truth[i], truth[j]) + stream.normal(0, 1, (len(i), 3)) * noise
    sd = np.maximum(noise, 0.01)
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
            ahead, behind = (difference_error(poses + by, *edges[:3])[0][0] for by in (step, -step))
            assert np.allclose((ahead - behind) / 2e-6, jacobian[0, :, axis], atol=1e-6, rtol=1e-4)


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
    solved = pose_graph.least_squares(truth, edges, kernel=pose_graph.huber(1.0), robust=robust)
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

    found = solved.poses[1:].ravel()
    assert solved.cost == pytest.approx(loss(found)[0], rel=1e-12)
    best = scipy.optimize.minimize(loss, found, jac=True, method="BFGS")
    assert solved.cost <= best.fun * (1 + 1e-12)
    assert np.abs(loss(found)[1]).max() < 1e-6 * edges.information.max()


def test_a_graph_that_grows_is_solved_to_the_same_bits_as_one_that_was_loaded():
    truth, edges = loops(np.random.default_rng(7), 200, 60, (0.02, 0.01))
    order = np.argsort(np.maximum(edges.i, edges.j), kind="stable")  # closures when their nodes are there
    edges = Edges(*(column[order] for column in edges))
    growing = None
    for size in range(20, len(order), 3):
        part = Edges(*(column[:size] for column in edges))
        count = int(part.j.max()) + 1
        growing = pose_graph.growing_equations(count, part, growing)
        kept, fresh = (
            pose_graph.least_squares(truth[:count], part, equations=equations)
            for equations in (growing, pose_graph.growing_equations(count, part, None))
        )
        assert np.array_equal(kept.poses, fresh.poses)
        assert kept.cost == pytest.approx(pose_graph.least_squares(truth[:count], part).cost, rel=1e-9)


def test_robust_kernels_limit_a_false_closure_and_heading_drift_of_more_than_half_a_turn_is_corrected():
    truth, edges = loops(np.random.default_rng(0), noise=(0.02, 0.005))
    one = [3], [110], [[0, 0, 0]], [[1e4] * 3]
    false = Edges(*(np.concatenate(rows) for rows in zip(edges, one, strict=True)))
    robust = np.arange(len(false.i)) >= len(truth) - 1

    def off(**settings):
        return np.abs(pose_graph.least_squares(truth, false, **settings).poses - truth)[:, :2].max()

    for kernel in (pose_graph.huber(1.0), pose_graph.geman_mcclure(9.0)):
        assert off(kernel=kernel, robust=robust) < off() / 5
    truth = np.vstack([np.zeros(3), integrate(np.tile([0.1, 0, 0.05], (399, 1)))])
    i = np.append(np.arange(399), np.arange(0, 260, 10))
    j = np.append(np.arange(1, 400), np.arange(0, 260, 10) + 126)
    measured, information = between(truth[i], truth[j]), np.full((len(i), 3), 1e4)
    measured[:399, 2] += 0.01  # 4 rad too much by the end
    information[:399, 2] = 1e3
    start = np.vstack([np.zeros(3), integrate(measured[:399])])
    solved = pose_graph.least_squares(start, Edges(i, j, measured, information))
    assert np.abs(solved.poses - truth)[:380, :2].max() < 0.5


def test_degenerate_graphs_terminate():
    nothing = Edges(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))
    assert pose_graph.least_squares(np.zeros((1, 3)), nothing).termination is Termination.CONVERGED
    one = Edges(np.array([0]), np.array([1]), np.array([[np.nan, 0, 0]]), np.ones((1, 3)))
    assert pose_graph.least_squares(np.zeros((2, 3)), one).termination is Termination.NOT_FINITE
    apart = Edges(np.array([0, 3]), np.array([1, 4]), np.ones((2, 3)), np.ones((2, 3)))
    solved = pose_graph.least_squares(np.zeros((5, 3)), apart)
    assert (np.isfinite(solved.poses).all(), solved.termination) == (True, Termination.CONVERGED)


def test_m3500_reaches_the_optimum_of_gtsam(reference_data):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        gtsam = pytest.importorskip("gtsam")
    files = (reference_data / "data" / f"m3500_{name}.csv" for name in ("edges", "vertices"))
    table, start = (np.loadtxt(path, delimiter=",", skiprows=1) for path in files)
    start, information = start[:, 1:], np.zeros((len(table), 3, 3))
    for k, (a, b) in enumerate(zip(*np.triu_indices(3), strict=True)):
        information[:, a, b] = information[:, b, a] = table[:, 5 + k]
    edges = Edges(table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:5], information)
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
    ours = pose_graph.least_squares(start, edges)  # the error of gtsam is the logarithm of ours
    assert ours.termination is Termination.CONVERGED
    assert np.hypot(*(ours.poses[:, :2] - theirs).T).max() <= 1e-4


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=9, max_size=9), st.booleans())
def test_g2o_reads_back_exactly_and_the_same_map_is_the_same_bytes(tmp_path_factory, values, full):
    """Every finite float survives, bit for bit; also in full information."""
    a, b = (tmp_path_factory.mktemp("g2o") / name for name in "ab")
    poses, motion = np.reshape(values[:6], (2, 3)), np.reshape(values[3:], (2, 3))
    half = np.random.default_rng(0).normal(size=(2, 3, 3))
    information = half + half.swapaxes(1, 2) if full else np.ones((2, 3))
    write_g2o(a, poses, Edges(np.array([0, 1]), np.array([1, 0]), motion, information))
    again, read = read_g2o(a)
    assert (again.tobytes(), read.motion.tobytes()) == (poses.tobytes(), motion.tobytes())
    assert (read.i.tolist(), read.j.tolist()) == ([0, 1], [1, 0])
    assert (read.information == (information if full else np.eye(3))).all()
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
    path = tmp_path / "map.json"
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        read_json(path)
    assert raised.value.where.startswith(str(path))
