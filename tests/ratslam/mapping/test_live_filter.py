"""The live filter is least squares over the keyframes since the map is known; steps are known relative to
keyframes."""

from __future__ import annotations

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
from tactile.base.se2 import between, compose, wrap
from tactile.base.types import Odometry
from tests.ratslam.mapping.map_cases import LAP, STEP, add, drive, new_graph, new_map, sequence

CELL, SECTOR = 0.05, 2 * np.pi / 12
KNOWN = 8
"""Keyframes whose poses count as known."""
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
    poses = [START]
    for _ in range(KNOWN - 1):
        poses.append(compose(poses[-1], MOTION))
    return graph_at(*poses)


# Against least squares

CLOSURES = {3: (2, 0, 1.0), 4: (4, 1, 1.0), 7: (5, -2, 0.4), 9: (1, 0, 0.8), 10: (3, 3, 0.1)}
"""Number of the unknown keyframe: known keyframe that it is recognised at, sector shift, robust weight."""
UNKNOWN = 11


def small_case(closures: dict[int, tuple[int, int, float]]) -> tuple[MapState, list[np.ndarray]]:
    """Known keyframes, one put where each closure claims an unknown one but for a small error, so that the
    equations are as good as linear; and the motions of the unknown ones."""
    stream = np.random.default_rng(3)
    graph = known_part()
    on = [graph.pose.rows[-1]]
    steps = [MOTION + [0, 0, 0.2 * np.sin(k)] for k in range(UNKNOWN)]
    for step in steps:
        on.append(compose(on[-1], step))
    for k, (match, shift, _) in closures.items():
        turn = np.array([0.0, 0.0, shift * SECTOR])
        graph.pose.rows[match] = compose(on[k + 1], turn) + stream.normal(0, 1e-5, 3)
    return graph, steps


def dense_solution(
    graph: MapState, steps: list[np.ndarray], closures: dict[int, tuple[int, int, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """The newest pose [3] and its covariance [3, 3] by least squares over all unknown keyframes."""
    known = graph.pose.rows[:KNOWN]
    noise = [graph_at(np.zeros(3), step).newest_variance() for step in steps]

    def residuals(x: np.ndarray) -> np.ndarray:
        poses = np.vstack([known[-1], x.reshape(-1, 3)])
        errors = between(poses[:-1], poses[1:]) - np.array(steps)
        errors[:, 2] = wrap(errors[:, 2])
        parts = [errors / np.sqrt(noise)]
        for k, (match, shift, weight) in closures.items():
            error = between(known[match], poses[k + 1]) + [0, 0, shift * SECTOR]
            error[2] = wrap(error[2])
            parts.append(error[None] / np.sqrt(graph.closure_variance() / weight))
        return np.concatenate(parts).ravel()

    x = [known[-1]]
    for step in steps:
        x.append(compose(x[-1], step))
    found = least_squares(residuals, np.concatenate(x[1:]), jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
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
            match, shift, weight = closures[k]
            graph.pose.rows[-1] = live.correct(graph, claim(graph, match, shift), weight)
    assert live.covariance == pytest.approx(spread, rel=1e-3, abs=1e-3 * np.abs(spread).max())
    moved, right = between(reckoned, graph.pose.rows[-1]), between(reckoned, expected)
    largest = np.abs(right).max()
    assert moved == pytest.approx(right, abs=1e-3 * largest + 1e-10)
    assert largest > 1e-7 or not used


# Laws


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


@pytest.mark.parametrize(
    ("weight", "share"), [(1.0, 1 / 2), (0.25, 1 / 5), (LEAST_WEIGHT, 1 / 21), (0.0, 1 / 21)]
)
def test_a_sequence_of_little_weight_hardly_moves_the_pose(weight, share):
    graph = graph_at([0, 0, 0], [0.3, 0.2, 0.1])
    live = LiveFilter()
    assert live.correct(graph, claim(graph, 0), weight) == pytest.approx(graph.pose.rows[-1])  # a known pose
    live.covariance = np.diag(graph.closure_variance())
    corrected = live.correct(graph, claim(graph, 0), weight)
    assert corrected == pytest.approx((1 - share) * graph.pose.rows[-1])
    assert live.covariance == pytest.approx((1 - share) * np.diag(graph.closure_variance()))


@pytest.mark.parametrize("facing", [2.9, -3.1, np.pi])
@pytest.mark.parametrize("turn", [0.4, -0.4])
@pytest.mark.parametrize("shift", [0, 3, -5])
def test_headings_are_corrected_the_short_way_and_a_view_turned_by_sectors_claims_a_turned_one(
    facing, turn, shift
):
    """As in the optimiser: the heading is that of the match less the shift."""
    claimed = facing - shift * SECTOR
    graph = graph_at([0, 0, facing], [0.1, 0, wrap(claimed + turn)])
    live = LiveFilter()
    live.covariance = np.diag(graph.closure_variance())
    corrected = live.correct(graph, claim(graph, 0, shift), 1.0)
    assert -np.pi < corrected[2] <= np.pi
    assert wrap(corrected[2] - claimed) == pytest.approx(turn / 2)
    assert corrected[:2] == pytest.approx([0.05, 0.0])


# In the map


def ahead(recalled: dict[int, tuple[int, float]], solve_every: int) -> float:
    """How far the newest keyframe lies ahead of the one that it truly lies at, m."""
    settings = {"solve_every": solve_every, "solve_strayed": 1e9, "robust_least": 1e3, "robust_most": 1e4}
    graph = drive(new_map(**settings), recalled, last=LAP + 18).state.unmerged
    newest = graph.count - 1
    return float(between(graph.pose.rows[newest - LAP], graph.pose.rows[newest])[0])


def test_the_map_follows_an_accepted_sequence_between_two_optimisations():
    """The sequence comes to claim that the robot is a step ahead; another that stops before it does not."""
    begun = sequence(LAP + 2, 2, 8, 4.0)
    shifted = begun | sequence(LAP + 10, 11, 8, 4.0)
    assert abs(ahead(begun, 1000)) < 0.1 * STEP
    assert ahead(shifted, 1) > 0.4 * STEP  # each closure optimised
    assert 0.4 * STEP < ahead(shifted, 1000) < STEP


def test_corrections_that_add_up_lead_to_an_optimisation():
    """None is due before `solve_every` where sequences fit; one is where closures claim a step more."""
    fits = sequence(LAP + 2, 2, 16, 4.0)
    strays = sequence(LAP + 2, 2, 8, 4.0) | sequence(LAP + 10, 11, 8, 4.0)
    counts = {}
    for name, recalled in (("fits", fits), ("strays", strays)):
        for strayed in (1e9, 0.1):
            map = new_map(solve_every=1000, solve_strayed=strayed)
            graph, solved = map.state, []
            graph.optimise = lambda solved=solved, do=graph.optimise: solved.append(do())
            drive(map, recalled, last=LAP + 18)
            counts[name, strayed] = len(solved)
    assert counts["fits", 0.1] == counts["fits", 1e9]
    assert counts["strays", 0.1] > counts["strays", 1e9]


STEP_MOTION = np.array([0.2, 0.05, 0.3])
POSES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [50.0, 9.0, -2.0]])


def fit_at(poses: np.ndarray) -> MapFit:
    return MapFit(poses, 0.0, np.zeros(0))


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


def test_steps_before_the_first_keyframe_of_a_piece_lead_to_it() -> None:
    steps = recorded_steps()
    found = steps.poses(fit_at(POSES))
    np.testing.assert_allclose(found[6], POSES[2])
    for k in (4, 5):
        np.testing.assert_allclose(compose(found[k], STEP_MOTION), found[k + 1], atol=1e-12)
    assert steps.first_steps(3).tolist() == [0, 2, 6]
    assert steps.of_keyframes(np.array([7, 8, 9])).tolist() == [7, 7, 8, 8, 9, 9, 9]


def test_until_it_is_taken_they_belong_to_the_keyframe_before() -> None:
    for steps in (pending := recorded_steps(taken=False), settled := recorded_steps(taken=False)):
        if steps is settled:
            steps.settle(2)
        np.testing.assert_allclose(steps.poses(fit_at(POSES[:2]))[5], compose(POSES[1], travelled(2).motion))
        assert steps.of_keyframes(np.array([7, 8])).tolist() == [7, 7, 8, 8, 8, 8]
    pending.arrive(2, travelled(3))
    settled.arrive(2, travelled(3))
    assert pending.of_keyframes(np.arange(3))[5] == 2
    assert settled.of_keyframes(np.arange(3))[5] == 1


@pytest.mark.parametrize("kept", [[0, 2], [2], [0, 1]])
def test_of_a_part_of_the_keyframes_the_steps_that_lead_to_them_remain(kept: list[int]) -> None:
    steps, number = recorded_steps(), np.full(3, -1)
    number[kept] = np.arange(len(kept))
    before = steps.poses(fit_at(POSES))
    remaining = steps.take(number)
    owner = np.array([0, 0, 1, 1, 2, 2, 2])
    assert remaining.tolist() == np.flatnonzero(np.isin(owner, kept)).tolist()
    np.testing.assert_allclose(steps.poses(fit_at(POSES[kept])), before[remaining])
