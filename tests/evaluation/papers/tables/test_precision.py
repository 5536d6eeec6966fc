"""float32 is as accurate as float64, with a given confidence."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.papers.tables import chaos, precision
from tactile.base.random_streams import stream


@pytest.mark.parametrize("count", [9, 20, 33])
@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_the_median_lies_in_its_interval_as_often_as_promised(count, level):
    """For a skewed distribution, whose mean differs from its median."""
    draws, random = 4000, stream(0, "tests.precision.median")
    intervals = [precision.median_interval(row, level) for row in random.exponential(1.0, (draws, count))]
    held = np.mean([low <= np.log(2) <= high for low, high in intervals])
    assert held >= level - 4 * np.sqrt(level * (1 - level) / draws)


def test_too_few_values_give_an_infinite_interval():
    assert precision.median_interval(np.arange(4.0), 0.95) == (-np.inf, np.inf)


def test_a_shift_of_all_seeds_is_refused_and_small_changes_are_accepted():
    random = stream(0, "tests.precision.shift")
    before = random.normal(0, 1, 20)
    shifted = precision.difference(before + 2 * precision.MARGIN, before)
    scattered = precision.difference(before + random.normal(0, 1e-4, 20), before)
    wild = precision.difference(random.normal(0, 1, 20), before)
    same = precision.difference(before, before)
    assert same.equal == 1
    assert precision.is_accepted([same, scattered])
    assert not precision.is_accepted([same, shifted])
    assert not precision.is_accepted([same, wild])
    assert not precision.is_accepted([precision.difference(before[:4], before[:4] + 1e-3)])


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("backend", precision.BACKENDS)
def test_float32_maps_as_well_as_float64(backend):
    """Over 20 seeds. Were a figure's median off by more than the margin, one such table in 200 would pass."""
    seeds = range(precision.FIRST_SEED, precision.FIRST_SEED + precision.SEEDS)
    found = precision.measure_arms(seeds, backend)
    print("\n" + "\n".join(precision.render_arms(backend, found)))
    assert precision.is_accepted(precision.differences(found["float32"], found["float64"]))


@pytest.mark.soak
def test_networks_that_differ_by_rounding_agree_for_a_thousand_steps():
    """No test may require much more: `python -m ratslam reproduce tables chaos` shows when they separate."""
    walk = chaos.walk(0, 1000)
    assert chaos.separation(*chaos.PAIRS["one-cell"], walk).max() < 1e-10
    assert chaos.separation(*chaos.PAIRS["window, dense"], walk).max() < 1e-10
    assert chaos.separation(*chaos.PAIRS["float64, float32"], walk).max() < 1e-2
