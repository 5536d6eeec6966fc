"""Closure selection: the set of sequences with the least cost, cuts where the odometry broke, and a fresh
selection where a map needs much noise in its odometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.maps.scenarios import ten_circuits
from evaluation.papers.maps.stored_maps import store_map
from ratslam.mapping.closure_selection import (
    ACCEPTED_WEIGHT,
    CUT,
    FINE,
    STEPS,
    Selection,
    SelectionProblem,
    select_closures,
    select_closures_and_cuts,
)
from ratslam.mapping.map_solution import reselect
from ratslam.mapping.odometry_calibration import HeadingNoise
from ratslam.mapping.optimizer import MapFit, System, solve
from tactile.base.se2 import compose
from tests.ratslam.mapping.selection_cases import LAP, World, off, world


def select(made: World, present: MapFit | None = None, earlier=()) -> Selection:
    """The selection with cuts that starts from this map, by default the present one, and the hypotheses."""
    starts = [made.present() if present is None else present, *made.hypotheses()]
    return select_closures_and_cuts(made.case, starts, made.find_cut, earlier)


def assert_right(made: World, judged: Selection, *cuts: int) -> None:
    """True sequences are accepted, false ones refused, the odometry is cut there, and the map is true."""
    np.testing.assert_array_equal(judged.fit.weights > ACCEPTED_WEIGHT, ~made.false)
    assert sorted(frame for frame, _ in judged.cuts) == list(cuts)
    assert off(judged.fit, made.truth) < 0.1


# Selection


@pytest.mark.parametrize("seed", range(2))
def test_true_sequences_are_all_accepted(seed):
    made = world(seed)
    judged, plain = select(made), solve(made.present(), made.case.measurements, STEPS, FINE)
    assert_right(made, judged)
    assert np.allclose(judged.fit.weights, plain.weights, atol=1e-4)
    assert off(judged.fit, compose(np.array([1.0, 2.0, 0.5]), plain.poses)) < 1e-3
    assert judged.cost == pytest.approx(System(made.case.measurements).robust_cost(plain), rel=1e-6)
    assert off(made.reckoned(), made.truth) > 2 * off(judged.fit, made.truth)


@pytest.mark.parametrize(
    ("seed", "evidence"), [(0, 20.0), (1, 20.0), (2, 40.0), (3, 40.0), (4, 20.0), (5, 40.0), (0, 50.0)]
)
def test_a_false_sequence_is_refused(seed, evidence):
    made = world(seed, false=evidence)
    assert_right(made, select(made))


@pytest.mark.parametrize("seed", range(3))
def test_a_map_bent_by_a_false_sequence_is_corrected(seed):
    """The present map is not the only start of the search."""
    made = world(seed, false=40.0)
    bent = believing(made, made.case)
    judged = select(made, bent)
    assert off(bent, made.truth) > 2 * off(judged.fit, made.truth)
    assert_right(made, judged)


def believing(made: World, case: SelectionProblem) -> MapFit:
    """A map that believes the false sequence alone."""
    closures = case.measurements.closures
    scale = np.where(made.false, 1e12, 1e-3)
    return solve(made.reckoned(), case.measurements._replace(closures=closures._replace(scale=scale)), 40)


def test_a_sequence_with_more_evidence_may_strain_the_map_more():
    made, weights = world(0), []
    for by in (0.1, 1, 10):
        problem = made.case.measurements
        closures = problem.closures._replace(scale=problem.closures.scale * by)
        case = made.case._replace(measurements=problem._replace(closures=closures))
        weights.append(select_closures_and_cuts(case, made.starts(), made.find_cut).fit.weights)
    assert (np.diff(weights, axis=0) > 0).all()


# The cost


@pytest.mark.parametrize("seed", range(4))
def test_the_cost_is_never_above_that_of_the_present_map(seed):
    made = world(seed, jumps=((150, 25),) if seed % 2 else (), false=40.0 * (seed % 3))
    case, present, stream = made.case, made.present(), np.random.default_rng(seed)
    noise = stream.normal(0, 0.02, present.poses.shape) * [1, 1, 0.2]
    present = present._replace(poses=present.poses + noise)
    judged = select(made, present)
    assert judged.cost <= System(case.measurements).robust_cost(present)
    again = select(made, judged.fit, judged.cuts)
    assert again.cost <= judged.cost + 0.5  # solver steps, not another map
    severed = case.measurements.cut_at([frame for frame, _ in judged.cuts])
    whole = System(severed).robust_cost(judged.fit) + CUT * len(judged.cuts)
    assert judged.cost == pytest.approx(whole, rel=1e-9)


# Cuts


@pytest.mark.parametrize("seed", range(2))
def test_a_robot_that_is_never_carried_keeps_its_odometry(seed):
    """Without cuts, the selection is that of the same search; where a robot was carried, it costs more."""
    made = world(seed, jumps=((2 * LAP + 10, 25),) if seed else (), false=40.0)
    plain, cut = select_closures(made.case, made.starts()), select(made)
    assert plain.cuts == ()
    assert plain.cost == System(made.case.measurements).robust_cost(plain.fit)
    assert cut.cost < plain.cost if seed else cut.cost == plain.cost
    assert np.array_equal(cut.fit.poses, plain.fit.poses) == (not seed)


@pytest.mark.parametrize("seed", range(5))
def test_the_odometry_is_cut_where_the_robot_was_carried(seed):
    stream = np.random.default_rng(seed)
    jump = int(stream.integers(2 * LAP + 5, 3 * LAP)), int(stream.integers(15, 45))
    made = world(seed, jumps=(jump,))
    judged = select(made)
    assert_right(made, judged, jump[0])
    assert made.case.first[judged.cuts[0][1]] >= jump[0]
    again = select(made, judged.fit, judged.cuts)
    assert again.cuts == judged.cuts
    assert np.allclose(again.fit.poses, judged.fit.poses, atol=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_two_cuts_are_made_for_a_robot_carried_away_and_back(seed):
    """The visit alone contradicts the other sequences, which agree."""
    stream = np.random.default_rng(seed)
    away, stay, places = 2 * LAP + 5 + 20 * int(stream.integers(3)), 60, int(stream.integers(15, 45))
    made = world(seed, laps=5, jumps=((away, places), (away + stay, -places)), least=35.0)
    assert_right(made, select(made), away, away + stay)


@pytest.mark.parametrize("seed", range(2))
def test_a_useless_cut_is_removed(seed):
    made = world(seed)
    judged = select(made, earlier=((150, 4),))
    assert judged.cuts == ()
    assert judged.cost == pytest.approx(select(made).cost, rel=1e-3)


# Afresh, where a map needs much noise

MORE = 100.0
"""Factor on the variance of headings in a map that needs too much of it."""


def learned(factor: float) -> HeadingNoise:
    return HeadingNoise(float(np.log(factor)), 0.1)


@pytest.mark.parametrize("seed", range(2))
def test_a_map_bent_by_a_false_sequence_gives_way(seed: int) -> None:
    """With its noise the bent map is the cheapest."""
    made = world(seed, false=60.0)
    case = made.case._replace(measurements=made.case.measurements.with_heading_noise(MORE))
    found = select_closures(case, [believing(made, case)])
    assert (found.fit.weights[made.false] > ACCEPTED_WEIGHT).all()
    assert off(found.fit, made.truth) > 0.5
    assert_right(made, reselect(case, found, made.reckoned(), learned(MORE), learned(1.0)))


@pytest.mark.parametrize(("noise", "seed"), [(2.0, 0), (5.0, 2)])
def test_odometry_that_is_noisier_than_at_the_start_keeps_its_closures(noise: float, seed: int) -> None:
    """Refusing all of them would explain it with little noise."""
    made = world(seed, noise=noise)
    found = select_closures(made.case, [made.present()])
    again = reselect(made.case, found, made.reckoned(), learned(1.0), learned(noise**-2))
    np.testing.assert_array_equal(again.fit.weights > ACCEPTED_WEIGHT, found.fit.weights > ACCEPTED_WEIGHT)
    assert off(again.fit, made.truth) < 1.1 * off(found.fit, made.truth)


@pytest.mark.soak
def test_two_halves_of_a_maze_that_look_alike_stay_two(tmp_path: Path) -> None:
    """This maze is the same after half a turn: the first half of a circuit fits the second one."""
    assert store_map(ten_circuits(31009), tmp_path).arrays.em < 0.05
