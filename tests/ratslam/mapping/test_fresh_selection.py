"""Closures are selected afresh where a map needs much noise in its odometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.maps.scenarios import ten_circuits
from evaluation.papers.maps.stored_maps import store_map
from ratslam.mapping.closure_selection import ACCEPTED_WEIGHT, STEPS, SelectionProblem, select_closures
from ratslam.mapping.map_solution import reselect
from ratslam.mapping.odometry_calibration import HeadingNoise
from ratslam.mapping.optimizer import solve
from tests.ratslam.mapping.selection_cases import off, world

MORE = 100.0
"""Factor on the variance of headings in a map that needs too much of it."""


def with_noise(case: SelectionProblem, factor: float) -> SelectionProblem:
    return case._replace(measurements=case.measurements.with_heading_noise(factor))


def learned(factor: float) -> HeadingNoise:
    return HeadingNoise(float(np.log(factor)), 0.1)


@pytest.mark.parametrize("seed", range(3))
def test_a_map_bent_by_a_false_sequence_gives_way(seed: int) -> None:
    """With its noise the bent map is the cheapest."""
    made = world(seed, false=60.0)
    case = with_noise(made.case, MORE)
    closures = case.measurements.closures
    believing = closures._replace(scale=np.where(made.false, 1e12, 1e-3))
    bent = solve(made.reckoned(), case.measurements._replace(closures=believing), STEPS)
    found = select_closures(case, [bent])
    assert (found.fit.weights[made.false] > ACCEPTED_WEIGHT).all()
    assert off(found.fit, made.truth) > 0.5

    again = reselect(case, found, made.reckoned(), learned(MORE), learned(1.0))
    np.testing.assert_array_equal(again.fit.weights > ACCEPTED_WEIGHT, ~made.false)
    assert off(again.fit, made.truth) < 0.1


@pytest.mark.parametrize(("noise", "seed"), [(2.0, 0), (3.0, 1), (4.0, 1), (5.0, 2)])
def test_odometry_that_is_noisier_than_at_the_start_keeps_its_closures(noise: float, seed: int) -> None:
    """Refusing all of them would explain it with little noise."""
    made = world(seed, noise=noise)
    found = select_closures(made.case, [made.present()])
    start = learned(noise**-2)
    again = reselect(made.case, found, made.reckoned(), learned(1.0), start)
    np.testing.assert_array_equal(again.fit.weights > ACCEPTED_WEIGHT, found.fit.weights > ACCEPTED_WEIGHT)
    assert off(again.fit, made.truth) < 1.1 * off(found.fit, made.truth)


@pytest.mark.soak
def test_two_halves_of_a_maze_that_look_alike_stay_two(tmp_path: Path) -> None:
    """This maze is the same after half a turn: the first half of a circuit fits the second one."""
    assert store_map(ten_circuits(31009), tmp_path).arrays.em < 0.05
