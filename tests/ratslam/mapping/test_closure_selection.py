"""Closure selection: the set of sequences with the least cost, and cuts where the odometry broke."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping import closure_selection
from ratslam.mapping.closure_selection import (
    ACCEPTED_WEIGHT,
    CUT,
    STEPS,
    SelectionProblem,
    select_closures,
    select_closures_and_cuts,
)
from ratslam.mapping.optimizer import MapFit, System, solve
from tactile.base.se2 import compose, fit_rigid_motion
from tests.ratslam.mapping.selection_cases import LAP, off, world


def rescaled(case: SelectionProblem, by: float) -> SelectionProblem:
    """The problem with all robust scales multiplied by a factor."""
    closures = case.measurements.closures
    closures = closures._replace(scale=closures.scale * by)
    return case._replace(measurements=case.measurements._replace(closures=closures))


# Selection


@pytest.mark.parametrize(
    "seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(3, 6))]
)
def test_true_sequences_are_all_accepted(seed):
    made = world(seed)
    case, starts = made.case, made.starts()
    judged = select_closures_and_cuts(case, starts, made.find_cut)
    assert (judged.fit.weights > ACCEPTED_WEIGHT).all()
    assert judged.cuts == ()
    plain = solve(starts[0], case.measurements, STEPS, closure_selection.FINE)
    assert np.allclose(judged.fit.weights, plain.weights, atol=1e-4)
    assert off(judged.fit, compose(np.array([1.0, 2.0, 0.5]), plain.poses)) < 1e-3
    assert judged.cost == pytest.approx(System(case.measurements).robust_cost(plain), rel=1e-6)
    assert judged.cost <= System(case.measurements).robust_cost(plain)
    assert off(judged.fit, made.truth) < 0.1
    assert off(made.reckoned(), made.truth) > 2 * off(judged.fit, made.truth)


@pytest.mark.parametrize("evidence", [20.0, 40.0])
@pytest.mark.parametrize("seed", range(6))
def test_a_false_sequence_is_refused(seed, evidence):
    made = world(seed, false=evidence)
    judged = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    assert (judged.fit.weights[made.false] < ACCEPTED_WEIGHT).all()
    assert (judged.fit.weights[~made.false] > ACCEPTED_WEIGHT).all()
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
    assert (judged.fit.weights[made.false] < ACCEPTED_WEIGHT).all()


@pytest.mark.parametrize("seed", range(6))
def test_a_map_bent_by_a_false_sequence_is_corrected(seed):
    """The present map is not the only start of the search."""
    made = world(seed, false=40.0)
    closures = made.case.measurements.closures
    believing = closures._replace(scale=np.where(made.false, 1e12, 1e-3))
    path = made.reckoned()
    bent = solve(path, made.case.measurements._replace(closures=believing), 40)
    judged = select_closures_and_cuts(made.case, [bent, *made.hypotheses()], made.find_cut)
    assert off(bent, made.truth) > 2 * off(judged.fit, made.truth)
    assert (judged.fit.weights[made.false] < ACCEPTED_WEIGHT).all()
    assert off(judged.fit, made.truth) < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_a_present_map_of_high_cost_is_replaced(seed):
    made = world(seed)
    stream = np.random.default_rng(seed)
    lost = made.reckoned()._replace(poses=stream.uniform(-2, 2, made.truth.shape))
    judged = select_closures_and_cuts(made.case, [lost, *made.hypotheses()], made.find_cut)
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
    judged = select_closures_and_cuts(case, [present, *made.hypotheses()], made.find_cut)
    assert judged.cost <= System(case.measurements).robust_cost(present)
    again = select_closures_and_cuts(case, [judged.fit, *made.hypotheses()], made.find_cut, judged.cuts)
    assert again.cost <= judged.cost + 0.5  # solver steps, not another map
    severed = case.measurements.cut_at([frame for frame, _ in judged.cuts])
    whole = System(severed).robust_cost(judged.fit) + CUT * len(judged.cuts)
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
        case.evidence[order], case.first[order], case.last[order], case.views_cost,
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
    assert plain.cost == System(made.case.measurements).robust_cost(plain.fit)
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
    start = MapFit(made.truth.copy(), 0.0, np.zeros(0))
    whole = made.case.with_cuts(start, ((jumps[0][0], 5), (jumps[1][0], 7)))
    assert judged.cost <= whole.cost + 1


@pytest.mark.parametrize("seed", range(4))
def test_an_earlier_cut_is_kept(seed):
    made = world(seed, jumps=((150, 25),))
    first = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    again = select_closures_and_cuts(made.case, [first.fit, *made.hypotheses()], made.find_cut, first.cuts)
    assert again.cuts == first.cuts
    assert np.allclose(again.fit.poses, first.fit.poses, atol=0.01)


@pytest.mark.parametrize("seed", range(4))
def test_a_useless_cut_is_removed(seed):
    made = world(seed)
    plain = select_closures_and_cuts(made.case, made.starts(), made.find_cut)
    judged = select_closures_and_cuts(made.case, made.starts(), made.find_cut, ((150, 4),))
    assert judged.cuts == ()
    assert judged.cost == pytest.approx(plain.cost, rel=1e-3)
