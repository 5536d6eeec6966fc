"""The live filter is least squares over keyframes since the map is known; steps are relative to keyframes."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from ratslam.mapping.live_filter import LEAST_WEIGHT, LiveFilter
from ratslam.mapping.loop_closures import Candidate
from ratslam.mapping.map_state import MapState
from ratslam.mapping.optimizer import MapFit
from ratslam.mapping.step_record import NO_TRAVEL, StepRecord, Travel, leading_to
from tactile.base.se2 import between, compose, integrate, wrap
from tactile.base.types import Odometry
from tests.ratslam.mapping.map_cases import LAP, STEP, add, drive, new_graph, new_map, sequence

CELL, SECTOR, KNOWN = 0.05, 2 * np.pi / 12, 8
"""The last: keyframes whose poses count as known."""
MOTION = np.array([0.04, 0.005, 0.35])
START = np.array([2.0, -1.0, 2.5])  # not the origin, and headings wrap on the way
reals = st.floats(-1.0, 1.0)
motions = st.tuples(reals, reals, st.floats(-3.0, 3.0)).map(np.array)
weights = st.floats(0.0, 1.0)


def graph_at(*poses: np.ndarray) -> MapState:
    """Keyframes at these poses [3], with views of 12 sectors."""
    appearance = SimpleNamespace(metric=lambda: SimpleNamespace(angle=SECTOR))
    graph = new_graph(CELL, 3, appearance)
    add(graph, np.zeros(3), np.array(poses[0], float))
    for before, pose in pairwise(poses):
        add(graph, between(np.array(before, float), np.array(pose, float)))
    return graph


def claim(graph: MapState, match: int, shift: int = 0) -> Candidate:
    """The newest keyframe recognised at keyframe `match`, turned by so many sectors."""
    return Candidate(graph.count - 1, match, shift, 0.9, 5.0)


def known_part() -> MapState:
    """Keyframes on a curve, the newest of which is the first unknown one's predecessor."""
    return graph_at(START, *integrate(np.tile(MOTION, (KNOWN - 1, 1)), START))


UNKNOWN, CLOSURES = 11, {3: (2, 0, 1.0), 4: (4, 1, 1.0), 7: (5, -2, 0.4), 9: (1, 0, 0.8), 10: (3, 3, 0.1)}
"""Number of the unknown keyframe: known keyframe that it is recognised at, sector shift, robust weight."""
Closures = dict[int, tuple[int, int, float]]


def small_case(closures: Closures) -> tuple[MapState, np.ndarray]:
    """Known keyframes, one put where each closure claims an unknown one but for a small error, so that the
    equations are as good as linear; and the motions of the unknown ones."""
    stream, graph = np.random.default_rng(3), known_part()
    steps = np.array([MOTION + [0, 0, 0.2 * np.sin(k)] for k in range(UNKNOWN)])
    on = integrate(steps, graph.pose.rows[-1])
    for k, (match, shift, _) in closures.items():
        graph.pose.rows[match] = on[k] + [0.0, 0.0, shift * SECTOR] + stream.normal(0, 1e-5, 3)
    return graph, steps


def dense_solution(graph: MapState, steps: np.ndarray, closures: Closures) -> tuple[np.ndarray, np.ndarray]:
    """The newest pose [3] and its covariance [3, 3] by least squares over all unknown keyframes."""
    known = graph.pose.rows[:KNOWN]
    noise = [graph_at(np.zeros(3), step).newest_variance() for step in steps]

    def residuals(x: np.ndarray) -> np.ndarray:
        poses = np.vstack([known[-1], x.reshape(-1, 3)])
        errors = between(poses[:-1], poses[1:]) - steps
        errors[:, 2] = wrap(errors[:, 2])
        parts = [errors / np.sqrt(noise)]
        for k, (match, shift, weight) in closures.items():
            error = between(known[match], poses[k + 1]) + [0, 0, shift * SECTOR]
            error[2] = wrap(error[2])
            parts.append(error[None] / np.sqrt(graph.closure_variance() / weight))
        return np.concatenate(parts).ravel()

    x = integrate(steps, known[-1]).ravel()
    found = least_squares(residuals, x, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return found.x[-3:], np.linalg.inv(found.jac.T @ found.jac)[-3:, -3:]


@pytest.mark.parametrize("used", [[], [3], [3, 4], [10], sorted(CLOSURES)], ids=str)
def test_the_newest_pose_is_that_of_least_squares(used):
    closures = {k: CLOSURES[k] for k in used}
    graph, steps = small_case(closures)
    expected, spread = dense_solution(graph, steps, closures)
    live, reckoned = LiveFilter(), graph.pose.rows[-1]
    for k, step in enumerate(steps):
        saved, live = live.arrays(), LiveFilter()  # a restored filter goes on
        live.restore(saved)
        reckoned = compose(reckoned, step)
        add(graph, step)
        live.advance(graph)
        if k in closures:
            graph.pose.rows[-1] = live.correct(graph, claim(graph, *closures[k][:2]), closures[k][2])
    assert live.covariance == pytest.approx(spread, rel=1e-3, abs=1e-3 * np.abs(spread).max())
    moved, right = between(reckoned, graph.pose.rows[-1]), between(reckoned, expected)
    largest = np.abs(right).max()
    assert moved == pytest.approx(right, abs=1e-3 * largest + 1e-10)
    assert largest > 1e-7 or not used


@given(steps=st.lists(st.tuples(motions, st.one_of(st.none(), weights)), min_size=1, max_size=12))
def test_the_covariance_stays_a_covariance_and_no_closure_enlarges_it(steps):
    graph, live = known_part(), LiveFilter()
    live.advance(graph_at(START))  # the first keyframe is known
    assert np.array_equal(live.covariance, np.zeros((3, 3)))
    for k, (motion, weight) in enumerate(steps):
        add(graph, motion)
        live.advance(graph)
        assert k or np.diag(live.covariance) == pytest.approx(graph.newest_variance())
        before = live.covariance.copy()
        if weight is not None:
            graph.pose.rows[-1] = live.correct(graph, claim(graph, 2), weight)
        largest = np.linalg.eigvalsh(before).max()
        assert np.allclose(live.covariance, live.covariance.T, rtol=0, atol=1e-12 * largest)
        assert np.linalg.eigvalsh(live.covariance).min() > 0
        assert np.linalg.eigvalsh(before - live.covariance).min() >= -1e-12 * largest


@pytest.mark.parametrize(("weight", "parts"), [(1.0, 2), (0.25, 5), (LEAST_WEIGHT, 21), (0.0, 21)])
def test_a_sequence_of_little_weight_hardly_moves_the_pose(weight, parts):
    graph = graph_at([0, 0, 0], [0.3, 0.2, 0.1])
    live = LiveFilter()
    assert live.correct(graph, claim(graph, 0), weight) == pytest.approx(graph.pose.rows[-1])  # a known pose
    live.covariance = np.diag(graph.closure_variance())
    corrected = live.correct(graph, claim(graph, 0), weight)
    assert corrected == pytest.approx((1 - 1 / parts) * graph.pose.rows[-1])
    assert live.covariance == pytest.approx((1 - 1 / parts) * np.diag(graph.closure_variance()))


@pytest.mark.parametrize("facing", [2.9, -3.1, np.pi])
@pytest.mark.parametrize("turn", [0.4, -0.4])
@pytest.mark.parametrize("shift", [0, 3, -5])
def test_headings_are_corrected_the_short_way_and_a_turned_view_claims_a_turned_one(facing, turn, shift):
    """As in the optimiser: the heading is that of the match less the shift."""
    claimed = facing - shift * SECTOR
    graph = graph_at([0, 0, facing], [0.1, 0, wrap(claimed + turn)])
    live = LiveFilter()
    live.covariance = np.diag(graph.closure_variance())
    corrected = live.correct(graph, claim(graph, 0, shift), 1.0)
    assert -np.pi < corrected[2] <= np.pi
    assert wrap(corrected[2] - claimed) == pytest.approx(turn / 2)
    assert corrected[:2] == pytest.approx([0.05, 0.0])


def ahead(
    recalled: dict[int, tuple[int, float]], solve_every: int, strayed: float = 1e9
) -> tuple[float, int]:
    """How far the newest keyframe lies ahead of the one at its place, steps; how often it was solved."""
    settings = {"solve_every": solve_every, "solve_strayed": strayed, "robust_least": 1e3, "robust_most": 1e4}
    map, solved = new_map(**settings), []
    state, optimise = map.state, map.state.optimise
    state.optimise = lambda: solved.append(optimise())
    pose = drive(map, recalled, last=LAP + 18).state.unmerged.pose.rows
    return float(between(pose[-1 - LAP], pose[-1])[0]) / STEP, len(solved)


def test_the_map_follows_an_accepted_sequence_until_corrections_that_add_up_lead_to_an_optimisation():
    """The sequence comes to claim that the robot is a step ahead; others stop before it or fit."""
    begun, fits = sequence(LAP + 2, 2, 8, 4.0), sequence(LAP + 2, 2, 16, 4.0)
    strays = begun | sequence(LAP + 10, 11, 8, 4.0)
    assert abs(ahead(begun, 1000)[0]) < 0.1
    assert ahead(strays, 1)[0] > 0.4  # each closure optimised
    assert 0.4 < ahead(strays, 1000)[0] < 1
    assert ahead(fits, 1000, 0.1)[1] == ahead(fits, 1000)[1]
    assert ahead(strays, 1000, 0.1)[1] > ahead(strays, 1000)[1]


STEP_MOTION, NONE = np.array([0.2, 0.05, 0.3]), np.zeros(0)
POSES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [50.0, 9.0, -2.0]])


def travelled(steps: int) -> Travel:
    travel = NO_TRAVEL
    for _ in range(steps):
        travel = travel.onwards(Odometry(*STEP_MOTION, 0.1))
    return travel


def recorded_steps(taken: bool = True) -> StepRecord:
    """Two keyframes, each followed by a step; three steps of a new piece, the third being its keyframe."""
    steps = StepRecord()
    for frame in (0, 1):
        steps.append(frame, NO_TRAVEL, STEP_MOTION)
        steps.append(frame, travelled(1), STEP_MOTION)
    for k in (1, 2):
        steps.append(leading_to(2), travelled(k), STEP_MOTION)
    if taken:
        steps.arrive(2, travelled(3))
        steps.append(2, NO_TRAVEL, STEP_MOTION)
    return steps


def test_steps_before_the_first_keyframe_of_a_piece_lead_to_it_and_remain_with_it() -> None:
    steps = recorded_steps()
    found = steps.poses(MapFit(POSES, 0.0, NONE))
    np.testing.assert_allclose(found[6], POSES[2])
    for k in (4, 5):
        np.testing.assert_allclose(compose(found[k], STEP_MOTION), found[k + 1], atol=1e-12)
    assert steps.first_steps(3).tolist() == [0, 2, 6]
    assert steps.of_keyframes(np.array([7, 8, 9])).tolist() == [7, 7, 8, 8, 9, 9, 9]
    for kept in ([0, 2], [2], [0, 1]):
        steps, number = recorded_steps(), np.full(3, -1)
        number[kept] = np.arange(len(kept))
        remaining = steps.take(number)
        assert remaining.tolist() == np.flatnonzero(np.isin([0, 0, 1, 1, 2, 2, 2], kept)).tolist()
        np.testing.assert_allclose(steps.poses(MapFit(POSES[kept], 0.0, NONE)), found[remaining])


@pytest.mark.parametrize(("settled", "owner"), [(False, 2), (True, 1)])
def test_until_it_is_taken_they_belong_to_the_keyframe_before(settled: bool, owner: int) -> None:
    steps = recorded_steps(taken=False)
    if settled:
        steps.settle(2)
    found = steps.poses(MapFit(POSES[:2], 0.0, NONE))[5]
    np.testing.assert_allclose(found, compose(POSES[1], travelled(2).motion))
    assert steps.of_keyframes(np.array([7, 8])).tolist() == [7, 7, 8, 8, 8, 8]
    steps.arrive(2, travelled(3))
    assert steps.of_keyframes(np.arange(3))[5] == owner
