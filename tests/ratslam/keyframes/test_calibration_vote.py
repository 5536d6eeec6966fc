"""The vote on the heading bias equals a sum over all assignments of true and false."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.keyframes.bias_vote import SHRINK, vote
from ratslam.keyframes.optimizer import BiasPrior

LEAST = 1e-3
seeds = st.integers(0, 10_000)


def random_case(seed, sequences=None, biases=5):
    """Biases [B], a prior, log ratios [R, B] and log odds [R]."""
    stream = np.random.default_rng(seed)
    count = int(stream.integers(0, 6)) if sequences is None else sequences
    grid = np.sort(stream.uniform(-0.1, 0.1, biases))
    prior = BiasPrior(float(stream.uniform(-0.08, 0.08)), float(stream.uniform(0.01, 0.1)))
    ratios = np.maximum(stream.normal(-2, 5, (count, biases)), -60)
    return grid, prior, ratios, stream.normal(-1, 2, count)


def joint_by_assignments(grid, prior, ratios, odds):
    """For each assignment of true and false to the sequences: it, and its weight at every bias [B]."""
    for true in product([False, True], repeat=len(odds)):
        weight = np.exp(-0.5 * ((grid - prior.mean) / prior.sd) ** 2)
        for r in np.flatnonzero(true):
            weight = weight * np.exp(odds[r] + ratios[r])
        yield np.array(true, bool), weight


@given(seeds)
def test_mean_and_odds_equal_the_sum_over_all_assignments(seed):
    case = random_case(seed)
    grid, prior, _, odds = case
    total, of_true, of_false = np.zeros(len(grid)), np.zeros(len(odds)), np.zeros(len(odds))
    for true, weight in joint_by_assignments(*case):
        total += weight
        of_true += true * weight.sum()
        of_false += ~true * weight.sum()
    share = total / total.sum()
    mean = share @ grid
    found = vote(*case, LEAST)
    assert found.mean == pytest.approx(mean, abs=1e-9)
    assert found.odds == pytest.approx(np.log(of_true) - np.log(of_false), rel=1e-6, abs=1e-6)
    spread = np.sqrt(share @ (grid - mean) ** 2)
    wide = np.hypot(spread, mean - found.belief.mean)
    assert found.belief.sd == pytest.approx(max(wide, LEAST), rel=1e-6)
    assert abs(found.belief.mean - prior.mean) <= abs(mean - prior.mean) + 1e-12


@given(seeds, st.floats(-30, 30))
def test_a_sequence_has_no_vote_on_its_own_odds(seed, change):
    """Its odds by score change its odds by as much, and those of the others through the bias alone."""
    grid, prior, ratios, odds = random_case(seed, 3)
    changed = odds + [change, 0, 0]
    before, after = (vote(grid, prior, ratios, each, LEAST) for each in (odds, changed))
    assert after.odds[0] - before.odds[0] == pytest.approx(change, abs=1e-6)
    alone = vote(grid, prior, ratios[:1], odds[:1], LEAST).odds[0]
    weight = np.exp(-0.5 * ((grid - prior.mean) / prior.sd) ** 2)
    expected = odds[0] + np.log(weight @ np.exp(ratios[0]) / weight.sum())
    assert alone == pytest.approx(expected, abs=1e-6)


@given(seeds)
def test_order_does_not_matter(seed):
    grid, prior, ratios, odds = random_case(seed, 4)
    order = np.random.default_rng(seed).permutation(4)
    first, second = (
        vote(grid, prior, ratios, odds, LEAST),
        vote(grid, prior, ratios[order], odds[order], LEAST),
    )
    assert second.odds == pytest.approx(first.odds[order], abs=1e-9)
    assert second.mean == pytest.approx(first.mean, abs=1e-12)


@given(seeds)
def test_a_sequence_that_favours_no_bias_leaves_the_others_as_they_are(seed):
    grid, prior, ratios, odds = random_case(seed, 3)
    level = np.full((1, len(grid)), 1.5)
    found = vote(grid, prior, np.vstack([ratios, level]), np.append(odds, 2.0), LEAST)
    without = vote(grid, prior, ratios, odds, LEAST)
    assert found.mean == pytest.approx(without.mean, abs=1e-12)
    assert found.odds[:3] == pytest.approx(without.odds, abs=1e-9)
    assert found.odds[3] == pytest.approx(3.5, abs=1e-9)


@pytest.mark.parametrize("mean", [-0.03, 0.0, 0.01])
def test_without_sequences_the_belief_is_the_prior(mean):
    grid, prior = np.linspace(-0.5, 0.5, 2001), BiasPrior(mean, 0.05)
    found = vote(grid, prior, np.zeros((0, 2001)), np.zeros(0), LEAST)
    assert found.odds.shape == (0,)
    assert found.belief.mean == pytest.approx(mean, abs=1e-12)
    assert found.belief.sd == pytest.approx(0.05, rel=1e-3)


def peaked(grid, at, width):
    """[1, B] log ratios of a sequence that is true at one bias alone."""
    return np.maximum(4 - 0.5 * ((grid - at) / width) ** 2, -60)[None]


def test_a_mean_within_two_deviations_is_shrunk_to_the_prior():
    grid, prior = np.linspace(-0.1, 0.1, 401), BiasPrior(0.0, 0.03)
    near = vote(grid, prior, peaked(grid, 0.01, 0.008), np.array([9.0]), LEAST)
    assert near.mean == pytest.approx(0.01, rel=0.2)
    assert near.belief.mean == 0.0
    assert near.belief.sd >= near.mean  # what was shrunk is added to the spread
    far = vote(grid, prior, peaked(grid, 0.05, 0.002), np.array([30.0]), LEAST)
    spread = np.sqrt(far.belief.sd**2 - (far.mean - far.belief.mean) ** 2)
    assert far.mean == pytest.approx(0.05, rel=0.02)
    assert far.belief.mean == pytest.approx(far.mean * (1 - (SHRINK * spread / far.mean) ** 2), rel=1e-6)
    assert far.belief.mean > 0.98 * far.mean


def test_the_belief_is_never_narrower_than_the_least_deviation():
    grid = np.linspace(-0.1, 0.1, 401)
    found = vote(grid, BiasPrior(0.0, 0.03), peaked(grid, 0.0, 1e-5), np.array([30.0]), 0.02)
    assert found.belief.sd == 0.02


def test_sequences_that_agree_outvote_stronger_ones_that_do_not():
    grid, prior = np.linspace(-0.1, 0.1, 401), BiasPrior(0.0, 0.03)
    true, false = peaked(grid, 0.04, 0.002), [peaked(grid, at, 0.002) for at in (-0.05, -0.02, 0.01)]
    ratios = np.vstack([true] * 4 + false)
    found = vote(grid, prior, ratios, np.array([0.0] * 4 + [1.0] * 3), LEAST)
    assert found.mean == pytest.approx(0.04, abs=0.002)
    assert found.odds[:4].min() > 2 > -1 > found.odds[4:].max()
