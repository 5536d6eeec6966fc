"""Map hypotheses: several maps side by side find what one map that believes too early cannot."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping import closure_selection
from ratslam.mapping.closure_selection import (
    ACCEPTED_WEIGHT,
    KEPT,
    MapHypotheses,
    SelectionProblem,
    select_closures,
)
from ratslam.mapping.optimizer import CalibrationPrior, MapFit, MapProblem, OdometryChain, System
from tactile.base.se2 import integrate, wrap
from tests.ratslam.mapping.selection_cases import LAP, NOISE, PRIOR, World, closures_of, off, world

TRAPS = [(1, -6, LAP + 2), (3, -6, LAP + 2), (5, -6, LAP + 2), (1, -8, LAP + 12), (2, -8, LAP + 12)]
"""Seed of a world, and how many places its early sequence is wrong, from which frame on."""
MANY = TRAPS[2:]
"""Those in which several maps are left at the end."""


def trap(seed: int, wrong: int, at: int) -> World:
    """A world of bad odometry that begins with a false sequence of much evidence."""
    return world(seed, laps=3, false=60.0, false_at=(at, wrong), noise=3.0)


def part(case: SelectionProblem, sequences: np.ndarray, count: int | None = None) -> SelectionProblem:
    """The problem with only the sequences marked in [R] bool, and the first keyframes up to `count`."""
    problem = case.measurements
    chain = OdometryChain(*(rows[: None if count is None else count - 1] for rows in problem.chain))
    fewer = problem._replace(chain=chain, closures=problem.closures.of_sequences(sequences))
    return case._replace(
        measurements=fewer,
        evidence=case.evidence[sequences],
        first=case.first[sequences],
        last=case.last[sequences],
    )


def numbers(case: SelectionProblem) -> np.ndarray:
    return np.arange(len(case.evidence))


def total(case: SelectionProblem, fit: MapFit) -> float:
    return System(case.measurements).robust_cost(fit) + case.views_cost(fit.poses)


def same(one: list[MapFit], other: list[MapFit]) -> bool:
    return len(one) == len(other) and all(
        np.array_equal(a.poses, b.poses) and (a.bias, a.turn_error) == (b.bias, b.turn_error)
        for a, b in zip(one, other, strict=True)
    )


# The search


@pytest.mark.parametrize("at", TRAPS)
def test_the_beam_escapes_from_a_false_early_sequence(at):
    made = trap(*at)
    trapped = made.case.with_cuts(made.reckoned(), ())
    assert (trapped.fit.weights[made.false] > ACCEPTED_WEIGHT).all()
    assert off(trapped.fit, made.truth) > 0.15
    found = select_closures(made.case, made.starts())
    assert found.cost < trapped.cost
    np.testing.assert_array_equal(found.fit.weights > ACCEPTED_WEIGHT, ~made.false)
    assert off(found.fit, made.truth) < 0.1


@pytest.mark.parametrize("kept", [1, 2, KEPT])
def test_no_more_maps_are_kept_than_wanted(kept, monkeypatch):
    monkeypatch.setattr(closure_selection, "KEPT", kept)
    monkeypatch.setattr(closure_selection, "DOUBTS", 0)
    made = trap(1, -8, LAP + 12)
    hypotheses, most = MapHypotheses(), 0
    for known in numbers(made.case):
        fits = hypotheses.follow(part(made.case, numbers(made.case) <= known), np.arange(known + 1))
        most = max(most, len(fits))
    assert most == kept


def test_a_dear_map_is_kept_if_it_refuses_what_all_cheaper_ones_accept():
    """Weak sequences, taken or left, fill the places of the cheapest; the last map alone refuses the first
    sequence."""
    taken = [[1, a, b, c] for a in (1, 0) for b in (1, 0) for c in (1, 0)] + [[0, 1, 1, 1]]
    maps = [MapFit(np.full((1, 3), float(k)), 0.0, np.array(row, float)) for k, row in enumerate(taken)]
    kept = closure_selection.with_doubts(maps)
    assert [fit.poses[0, 0] for fit in kept] == [0, 1, 2, 3, 4, 8]  # 4 refuses the second sequence


@pytest.mark.parametrize(("at", "views"), [(MANY[0], 200.0), (MANY[1], 0.0), (MANY[2], 200.0)])
def test_the_maps_differ_and_are_sorted_by_their_cost_with_the_views(at, views):
    made = trap(*at)
    seen = made.case._replace(views_cost=lambda poses: views * float(np.hypot(*poses[-1, :2])))
    fits = MapHypotheses().follow(seen, numbers(seen))
    costs = [total(seen, fit) for fit in fits]
    assert len(costs) > 1
    assert costs == sorted(costs)
    for k, fit in enumerate(fits):
        for other in fits[:k]:
            apart = fit.poses - other.poses
            apart[:, 2] = wrap(apart[:, 2])
            deviation = (apart**2 / made.case.measurements.closures.variance).sum(axis=1).max()
            assert deviation >= closure_selection.ALIKE**2


# Two maps that mirror each other

OUT = 20
"""Keyframes that the robot drives out, and back again."""


def fork(evidence: tuple[float, float], prefer: float = 0.0) -> SelectionProblem:
    """A robot that drives straight out and backwards home. One sequence claims that it has turned left on the
    way, another that it has turned right: with the same evidence, the two maps mirror each other.

    Args:
        evidence: of the sequences. prefer: chi-square by which the views prefer the left turn.
    """
    motion = np.zeros((2 * OUT, 3))
    motion[:, 0] = np.repeat([0.05, -0.05], OUT)
    variance = np.tile((3 * NOISE) ** 2, (len(motion), 1))
    frames = np.arange(2 * OUT - 8, 2 * OUT - 2)
    pair = [frames, frames]
    closures = closures_of(pair, [2 * OUT - frames] * 2, np.array(evidence))
    closures = closures._replace(turn=np.repeat([TURN, -TURN], len(frames)))
    problem = MapProblem(OdometryChain(motion, np.abs(motion[:, 0]), variance), closures, PRIOR)
    first, last = frames[[0, 0]], frames[[-1, -1]]
    return SelectionProblem(
        problem, np.array(evidence), first, last, lambda poses: -prefer / 2 * float(np.sign(poses[-1, 2]))
    )


TURN = 0.6


def turned(fit: MapFit) -> float:
    return float(wrap(fit.poses[-5, 2] - fit.poses[5, 2]))


@pytest.mark.parametrize("side", [1, -1])
def test_the_views_decide_between_maps_of_equal_cost(side):
    case = fork((40.0, 40.0), prefer=5.0 * side)
    fits = MapHypotheses().follow(case, np.arange(2))
    left, right = (next(fit for fit in fits if way * turned(fit) > TURN / 2) for way in (1, -1))
    assert turned(left) == pytest.approx(-turned(right), abs=0.01)  # both are kept
    assert total(case, left) + 5.0 * side == pytest.approx(total(case, right), abs=0.05)
    assert turned(fits[0]) == pytest.approx(side * TURN, abs=0.1)
    best = select_closures(case, fits)
    assert turned(best.fit) == pytest.approx(side * TURN, abs=0.1)
    assert best.cost == pytest.approx(System(case.measurements).robust_cost(best.fit) - 2.5)


def test_only_force_finds_the_other_map(monkeypatch):
    case = fork((40.0, 60.0))
    fits = MapHypotheses().follow(case, np.arange(2))
    monkeypatch.setattr(closure_selection, "FITS", 0.0)
    unforced = MapHypotheses().follow(case, np.arange(2))
    assert turned(fits[0]) < 0 < turned(unforced[0])
    assert total(case, fits[0]) < total(case, unforced[0])


# Over time


@pytest.mark.parametrize(("at", "known"), [(TRAPS[0], 1), (TRAPS[2], 3), (TRAPS[4], 6)])
def test_two_calls_follow_as_one_also_of_restored_hypotheses(at, known):
    made = trap(*at)
    hypotheses, restored = MapHypotheses(), MapHypotheses()
    hypotheses.follow(part(made.case, numbers(made.case) < known), np.arange(known))
    restored.restore(hypotheses.arrays())
    for one in (hypotheses, hypotheses, restored):
        assert same(one.follow(made.case, numbers(made.case)), made.hypotheses())


def test_sequences_are_known_by_their_numbers():
    """Sequences of other numbers are new, even if there are as many."""
    made = trap(3, -6, LAP + 2)
    case = part(made.case, made.false | (numbers(made.case) > 3))
    hypotheses = MapHypotheses()
    hypotheses.follow(part(made.case, numbers(made.case) < 2), np.array([0, 1]))
    chosen = np.flatnonzero(made.false | (numbers(made.case) > 3))
    fits = hypotheses.follow(case, chosen)
    assert all(len(fit.weights) == len(chosen) for fit in fits)
    assert not same(fits, hypotheses.follow(made.case, numbers(made.case)))


def test_maps_go_on_by_corrected_odometry():
    made = trap(3, -6, LAP + 2)
    count = LAP + 40
    early = made.case.last < count
    hypotheses = MapHypotheses()
    before = hypotheses.follow(part(made.case, early, count), np.flatnonzero(early))
    after = hypotheses.follow(part(made.case, early), np.flatnonzero(early))
    chain = made.case.measurements.chain
    assert len(before) == len(after) > 1
    for one, two in zip(before, after, strict=True):
        assert np.array_equal(two.poses[:count], one.poses)
        onwards = one.corrected(chain)[count - 1 :]
        assert two.poses[count:] == pytest.approx(integrate(onwards, one.poses[-1]))
        assert two.bias == one.bias != 0


def test_the_first_map_is_odometry_with_the_means_of_the_calibration():
    made = world(2)
    nothing = part(made.case, np.zeros(len(made.case.evidence), bool))
    prior = CalibrationPrior(0.3, 0.02, 0.1, 0.05)
    nothing = nothing._replace(measurements=nothing.measurements._replace(prior=prior))
    (fit,) = MapHypotheses().follow(nothing, np.zeros(0, int))
    assert (fit.bias, fit.turn_error) == (0.3, 0.1)
    assert fit.poses[0] == pytest.approx(np.zeros(3))
    motion = fit.corrected(made.case.measurements.chain)
    assert fit.poses[1:] == pytest.approx(integrate(motion))
