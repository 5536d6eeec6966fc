"""Closure selection: the set of sequences with the least cost, and cuts where the odometry broke."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest

from ratslam.keyframes import closure_selection
from ratslam.keyframes.closure_selection import (
    ACCEPTED_WEIGHT,
    CUT,
    STEPS,
    SelectionProblem,
    select_closures,
    select_closures_and_cuts,
)
from ratslam.keyframes.optimizer import (
    CalibrationPrior,
    LoopClosures,
    MapFit,
    MapProblem,
    OdometryChain,
    robust_cost,
    solve,
)
from tactile.base.se2 import between, compose, fit_rigid_motion, integrate, wrap

LAP = 60
STEP = 0.03
NOISE = np.array([0.006, 0.006, 0.012])  # of odometry, at each frame
SPREAD = np.array([0.03, 0.03, 0.08])  # of closures
PRIOR = CalibrationPrior(0.0, 0.02)
RUN = 12


class World(NamedTuple):
    """A robot on a loop: true poses [N, 3], and the sequences to select from."""

    truth: np.ndarray
    case: SelectionProblem

    def reckoned(self) -> MapFit:
        poses = integrate(self.case.measurements.chain.motion, self.truth[0])
        return MapFit(np.vstack([self.truth[:1], poses]), 0.0, np.zeros(0))

    def starts(self) -> list[MapFit]:
        path = self.reckoned()
        chain, closures = self.case.measurements.chain, self.case.measurements.closures
        return [solve(MapFit(path.poses, 0.0, np.zeros(0)), MapProblem(chain, closures, PRIOR), STEPS), path]

    def find_cut(self, poses, onwards, carried, since):
        """The frame from which the carried poses are nearer to the truth, as ideal views would show."""
        frames = np.arange(since + 1, since + 1 + len(onwards))
        truth = compose(fit_rigid_motion(self.truth[:LAP], poses[:LAP]), self.truth[frames])
        stays, goes = (
            np.minimum(np.hypot(*(rows - truth)[:, :2].T) / 0.1, 1.0)
            for rows in (onwards, compose(carried, onwards))
        )
        cost = np.concatenate([[0], np.cumsum(stays)[:-1]]) + np.cumsum(goes[::-1])[::-1]
        return int(frames[len(cost) - 1 - np.argmin(cost[::-1])])


def lap_poses(place: np.ndarray) -> np.ndarray:
    """[n, 3] the poses at places (in frames) along a lap that is not a circle."""
    at = 2 * np.pi * np.arange(LAP) / LAP
    x, y = 0.35 * np.cos(at) + 0.06 * np.cos(3 * at), 0.25 * np.sin(at)
    along = np.stack([x, y], axis=1)
    step = np.roll(along, -1, axis=0) - along
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([along, heading])[place % LAP]


def world(
    seed: int,
    laps: int = 4,
    jumps: tuple[tuple[int, int], ...] = (),
    false: float = 0.0,
    least: float = 25.0,
    most: float = 40.0,
) -> World:
    """Laps with noise, and true sequences of closures with the first lap, every 20 frames.

    Args:
        jumps: (frame, places) by which the robot is carried ahead before a frame. false: evidence of one
        sequence
            more, that joins places half a lap apart. least, most: evidence of the true sequences.
    """
    stream = np.random.default_rng(seed)
    count = laps * LAP
    place = np.arange(count)
    steps = between(lap_poses(place[:-1]), lap_poses(place[1:]))
    for frame, places in jumps:
        place[frame:] += places
    truth = lap_poses(place)
    true = between(truth[:-1], truth[1:])
    for frame, _ in jumps:
        true[frame - 1] = steps[frame - 1]  # odometry does not measure the jump
    motion = true + stream.normal(0, NOISE, true.shape)
    motion[:, 2] = wrap(motion[:, 2])
    chain = OdometryChain(motion, np.hypot(motion[:, 0], motion[:, 1]), np.tile(NOISE**2, (count - 1, 1)))

    edges = sorted({*range(LAP, count + 1, 20), *(frame for frame, _ in jumps)})
    spans = [(first + int(stream.integers(0, 4)), end) for first, end in pairwise(edges)]
    sequences = [np.arange(first, min(first + RUN, end)) for first, end in spans if end - first >= 8]
    match = [place[frames] % LAP for frames in sequences]
    evidence = stream.uniform(least, most, len(sequences))
    if false:
        sequences.append(np.arange(2 * LAP + 6, 2 * LAP + 6 + RUN))
        match.append((place[sequences[-1]] + LAP // 2) % LAP)
        evidence = np.append(evidence, false)
    members = np.array([len(frames) for frames in sequences])
    closures = LoopClosures(
        i=np.concatenate(match), j=np.concatenate(sequences), turn=np.zeros(members.sum()),
        sequence=np.repeat(np.arange(len(sequences)), members), variance=SPREAD**2,
        scale=2 * (evidence - 6) / members, score=evidence,
        cost_limit=np.maximum(6.0, 3 * (evidence - 6) / members),
    )  # fmt: skip
    first, last = np.array([[frames[0], frames[-1]] for frames in sequences]).T
    return World(truth, SelectionProblem(MapProblem(chain, closures, PRIOR), evidence, first, last))


def rescaled(case: SelectionProblem, by: float) -> SelectionProblem:
    """The problem with all robust scales multiplied by a factor."""
    closures = case.measurements.closures
    closures = closures._replace(scale=closures.scale * by)
    return case._replace(measurements=case.measurements._replace(closures=closures))


def off(fit: MapFit, truth: np.ndarray) -> float:
    """Largest distance from the truth, m."""
    aligned = compose(fit_rigid_motion(fit.poses, truth), fit.poses)
    return float(np.hypot(*(aligned - truth)[:, :2].T).max())


# Selection


@pytest.mark.parametrize("seed", range(6))
def test_true_sequences_are_all_accepted(seed):
    made = world(seed)
    case, starts = made.case, made.starts()
    judged = select_closures_and_cuts(case, starts, made.find_cut)
    assert (judged.fit.weights > ACCEPTED_WEIGHT).all()
    assert judged.cuts == ()
    plain = solve(starts[0], case.measurements, STEPS, closure_selection.FINE)
    assert np.array_equal(judged.fit.poses, plain.poses)
    assert judged.cost == robust_cost(plain, case.measurements)
    assert off(judged.fit, made.truth) < 0.1
    assert off(made.reckoned(), made.truth) > 2 * off(judged.fit, made.truth)


@pytest.mark.parametrize("evidence", [20.0, 40.0])
@pytest.mark.parametrize("seed", range(6))
def test_a_false_sequence_is_refused(seed, evidence):
    made = world(seed, false=evidence)
    judged = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    assert judged.fit.weights[-1] < ACCEPTED_WEIGHT
    assert (judged.fit.weights[:-1] > ACCEPTED_WEIGHT).all()
    assert judged.cuts == ()
    assert off(judged.fit, made.truth) < 0.1
    within = world(seed).starts()[0]
    assert (
        np.abs(compose(fit_rigid_motion(judged.fit.poses, within.poses), judged.fit.poses) - within.poses)[
            :, :2
        ].max()
        < 0.05
    )


def test_a_false_sequence_with_much_evidence_is_refused():
    made = world(0, false=60.0)
    judged = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    assert judged.fit.weights[-1] < ACCEPTED_WEIGHT


@pytest.mark.parametrize("seed", range(6))
def test_a_map_bent_by_a_false_sequence_is_corrected(seed):
    """The present map is not the only start of the search."""
    made = world(seed, false=40.0)
    closures = made.case.measurements.closures
    wrong = np.arange(len(made.case.evidence)) == len(made.case.evidence) - 1
    believing = closures._replace(scale=np.where(wrong, 1e12, 1e-3))
    path = made.reckoned()
    bent = solve(
        MapFit(path.poses, 0.0, np.zeros(0)), MapProblem(made.case.measurements.chain, believing, PRIOR), 40
    )
    judged = select_closures_and_cuts(made.case, [bent, path], made.find_cut)
    assert off(bent, made.truth) > 2 * off(judged.fit, made.truth)
    assert judged.fit.weights[-1] < ACCEPTED_WEIGHT
    assert off(judged.fit, made.truth) < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_a_present_map_of_high_cost_is_replaced(seed):
    made = world(seed)
    stream = np.random.default_rng(seed)
    lost = made.reckoned()._replace(poses=stream.uniform(-2, 2, made.truth.shape))
    judged = select_closures_and_cuts(made.case, [lost, made.reckoned()], made.find_cut)
    assert (judged.fit.weights > ACCEPTED_WEIGHT).all()
    assert off(judged.fit, made.truth) < 0.1


def test_a_sequence_with_more_evidence_may_strain_the_map_more():
    made = world(0)
    case = made.case
    strict, lenient = (rescaled(case, by) for by in (0.1, 10))
    weights = [
        select_closures_and_cuts(one, made.starts(), made.find_cut).fit.weights
        for one in (strict, case, lenient)
    ]
    assert (weights[0] < weights[1]).all()
    assert (weights[1] < weights[2]).all()


# The cost


@pytest.mark.parametrize("seed", range(10))
def test_the_cost_is_never_above_that_of_the_present_map(seed):
    jumps = ((150, 25),) if seed % 2 else ()
    made = world(seed, jumps=jumps, false=40.0 * (seed % 3))
    case = made.case
    stream = np.random.default_rng(seed)
    present = made.starts()[0]
    present = present._replace(
        poses=present.poses + stream.normal(0, 0.02, present.poses.shape) * [1, 1, 0.2]
    )
    judged = select_closures_and_cuts(case, [present, made.reckoned()], made.find_cut)
    assert judged.cost <= robust_cost(present, case.measurements)
    again = select_closures_and_cuts(case, [judged.fit, made.reckoned()], made.find_cut, judged.cuts)
    assert again.cost <= judged.cost + 0.5  # solver steps, not another map
    severed = closure_selection.cut_odometry(case.measurements, judged.cuts)
    whole = robust_cost(judged.fit, severed) + CUT * len(judged.cuts)
    assert judged.cost == pytest.approx(whole, rel=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_the_order_of_sequences_does_not_matter(seed):
    made = world(seed, jumps=((150, 25),) if seed % 2 else (), false=45.0)
    case, closures = made.case, made.case.measurements.closures
    order = np.random.default_rng(seed).permutation(len(case.evidence))
    number = np.argsort(order)
    among = np.random.default_rng(seed + 1).permutation(len(closures.sequence))
    renamed = SelectionProblem(
        case.measurements._replace(closures=closures._replace(
            i=closures.i[among], j=closures.j[among], turn=closures.turn[among],
            sequence=number[closures.sequence[among]], scale=closures.scale[order],
            score=closures.score[order], cost_limit=np.asarray(closures.cost_limit)[order],
        )),
        case.evidence[order], case.first[order], case.last[order],
    )  # fmt: skip
    one, two = (select_closures_and_cuts(c, made.starts(), made.find_cut) for c in (case, renamed))
    assert two.cost == pytest.approx(one.cost, rel=1e-6)
    assert np.allclose(two.fit.poses, one.fit.poses, atol=1e-6)
    assert np.allclose(two.fit.weights, one.fit.weights[order], atol=1e-6)
    assert [(frame, order[sequence]) for frame, sequence in two.cuts] == list(one.cuts)


# Cuts


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_that_is_never_carried_keeps_its_odometry(seed):
    """Without cuts, the selection is that of the same search; where a robot was carried, it costs more."""
    carried = ((2 * LAP + 10, 25),) if seed % 2 else ()
    made = world(seed, jumps=carried, false=40.0)
    plain = select_closures(made.case, made.starts())
    cut = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    assert plain.cuts == ()
    assert plain.cost == robust_cost(plain.fit, made.case.measurements)
    if carried:
        assert cut.cost < plain.cost
    else:
        assert cut.cost == plain.cost
        assert np.array_equal(cut.fit.poses, plain.fit.poses)


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_cut_without_a_jump(seed):
    made = world(seed, false=50.0 * (seed % 2))
    assert select_closures_and_cuts(made.case, made.starts(), made.find_cut).cuts == ()


@pytest.mark.parametrize("seed", range(8))
def test_the_odometry_is_cut_where_the_robot_was_carried(seed):
    stream = np.random.default_rng(seed)
    jump = int(stream.integers(2 * LAP + 5, 3 * LAP)), int(stream.integers(15, 45))
    made = world(seed, jumps=(jump,))
    judged = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    assert [frame for frame, _ in judged.cuts] == [jump[0]]
    assert made.case.first[judged.cuts[0][1]] >= jump[0]
    assert (judged.fit.weights > ACCEPTED_WEIGHT).all()
    assert off(judged.fit, made.truth) < 0.1


@pytest.mark.parametrize("seed", range(8))
def test_two_cuts_are_made_for_a_robot_carried_away_and_back(seed):
    """The visit alone contradicts the other sequences, which agree."""
    stream = np.random.default_rng(seed)
    away, stay, places = 2 * LAP + 5 + 20 * int(stream.integers(3)), 60, int(stream.integers(15, 45))
    made = world(seed, laps=5, jumps=((away, places), (away + stay, -places)), least=35.0)
    judged = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    assert sorted(frame for frame, _ in judged.cuts) == [away, away + stay]
    assert (judged.fit.weights > ACCEPTED_WEIGHT).all()
    assert off(judged.fit, made.truth) < 0.1


def test_a_visit_is_cut_out_for_sequences_of_any_evidence():
    jumps = ((2 * LAP + 45, 34), (2 * LAP + 85, -34))
    made = world(0, laps=5, jumps=jumps, least=44.0, most=45.0)
    judged = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    whole = closure_selection.optimise_with_cuts(
        made.case, MapFit(made.truth.copy(), 0.0, np.zeros(0)), ((jumps[0][0], 5), (jumps[1][0], 7))
    )
    assert judged.cost <= whole.cost + 1


@pytest.mark.parametrize("seed", range(4))
def test_an_earlier_cut_is_kept(seed):
    made = world(seed, jumps=((150, 25),))
    first = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    again = select_closures_and_cuts(made.case, [first.fit, made.reckoned()], made.find_cut, first.cuts)
    assert again.cuts == first.cuts
    assert np.allclose(again.fit.poses, first.fit.poses, atol=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_a_useless_cut_is_removed(seed):
    made = world(seed)
    plain = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    judged = select_closures_and_cuts(made.case, made.starts(), made.find_cut, ((150, 4),))
    assert judged.cuts == ()
    assert judged.cost == pytest.approx(plain.cost, rel=1e-3)
