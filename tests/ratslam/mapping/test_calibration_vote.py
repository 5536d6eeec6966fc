"""The vote on the calibration of the odometry equals a sum over all assignments of true and false."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.acceptance import LEAST_TURN_ERROR, SHRINK, vote
from ratslam.mapping.optimizer import CalibrationPrior

LEAST = 1e-3
seeds = st.integers(0, 10_000)


def random_case(seed, sequences=None, points=5):
    """Biases and turn errors [G, 2], a prior, log ratios [R, G] and log odds [R]."""
    stream = np.random.default_rng(seed)
    count = int(stream.integers(0, 6)) if sequences is None else sequences
    grid = stream.uniform(-0.1, 0.1, (points, 2))
    turn_sd = float(stream.uniform(0.01, 0.1)) if stream.random() < 0.7 else 0.0
    prior = CalibrationPrior(*stream.uniform([-0.08, 0.01, -0.08], [0.08, 0.1, 0.08]).tolist(), turn_sd)
    if turn_sd == 0:
        grid[:, 1] = prior.turn_error
    ratios = np.maximum(stream.normal(-2, 5, (count, points)), -60)
    return grid, prior, ratios, stream.normal(-1, 2, count)


def prior_weight(grid, prior):
    """[G] prior probability of each point, not normalised."""
    weight = np.exp(-0.5 * ((grid[:, 0] - prior.bias) / prior.bias_sd) ** 2)
    if prior.turn_error_sd:
        weight = weight * np.exp(-0.5 * ((grid[:, 1] - prior.turn_error) / prior.turn_error_sd) ** 2)
    return weight


def joint_by_assignments(grid, prior, ratios, odds):
    """For each assignment of true and false to the sequences: it, and its weight at every point [G]."""
    for true in product([False, True], repeat=len(odds)):
        weight = prior_weight(grid, prior)
        for r in np.flatnonzero(true):
            weight = weight * np.exp(odds[r] + ratios[r])
        yield np.array(true, bool), weight


def mesh(biases, turns):
    """[B * T, 2] every pair."""
    return np.array(list(product(biases, turns)))


def of_bias(grid, at, width):
    """[1, G] log ratios of a sequence that is true at one bias alone, whatever the turn error."""
    return np.maximum(4 - 0.5 * ((grid[:, 0] - at) / width) ** 2, -60)[None]


def of_turn(grid, at, width):
    """[1, G] log ratios of a sequence that is true at one turn error alone, whatever the bias."""
    return of_bias(grid[:, ::-1], at, width)


@given(seeds)
def test_means_and_odds_equal_the_sum_over_all_assignments(seed):
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
    assert found[1][::2] == pytest.approx(mean, abs=1e-9)
    assert found[2] == pytest.approx(np.log(of_true) - np.log(of_false), rel=1e-6, abs=1e-6)
    spread = np.sqrt(share @ (grid - mean) ** 2)
    wide = np.hypot(spread, mean - found[0][::2])
    expected = np.maximum(wide, (LEAST, LEAST_TURN_ERROR)) * (1, prior.turn_error_sd > 0)
    assert found[0][1::2] == pytest.approx(expected, rel=1e-6)
    off, kept = mean - prior[::2], found[0][::2] - np.array(prior[::2])
    shrunk = off * np.maximum(1 - (SHRINK * spread / np.where(off, off, np.inf)) ** 2, 0)
    assert kept == pytest.approx(shrunk, rel=1e-6, abs=1e-9)


@given(seeds, st.floats(-30, 30))
def test_a_sequence_has_no_vote_on_its_own_odds(seed, change):
    """Its odds by score change its odds by as much, and those of the others through the calibration alone."""
    grid, prior, ratios, odds = random_case(seed, 3)
    changed = odds + [change, 0, 0]
    before, after = (vote(grid, prior, ratios, each, LEAST) for each in (odds, changed))
    assert after[2][0] - before[2][0] == pytest.approx(change, abs=1e-6)
    alone = vote(grid, prior, ratios[:1], odds[:1], LEAST)[2][0]
    weight = prior_weight(grid, prior)
    expected = odds[0] + np.log(weight @ np.exp(ratios[0]) / weight.sum())
    assert alone == pytest.approx(expected, abs=1e-6)


@given(seeds)
def test_order_does_not_matter(seed):
    grid, prior, ratios, odds = random_case(seed, 4)
    stream = np.random.default_rng(seed)
    order, points = stream.permutation(4), stream.permutation(len(grid))
    first = vote(grid, prior, ratios, odds, LEAST)
    second = vote(grid[points], prior, ratios[order][:, points], odds[order], LEAST)
    assert second[2] == pytest.approx(first[2][order], abs=1e-9)
    assert second[1] == pytest.approx(first[1], abs=1e-12)


@given(seeds)
def test_a_sequence_that_favours_no_calibration_leaves_the_others_as_they_are(seed):
    grid, prior, ratios, odds = random_case(seed, 3)
    level = np.full((1, len(grid)), 1.5)
    found = vote(grid, prior, np.vstack([ratios, level]), np.append(odds, 2.0), LEAST)
    without = vote(grid, prior, ratios, odds, LEAST)
    assert found[1] == pytest.approx(without[1], abs=1e-12)
    assert found[2][:3] == pytest.approx(without[2], abs=1e-9)
    assert found[2][3] == pytest.approx(3.5, abs=1e-9)


@pytest.mark.parametrize("mean", [-0.03, 0.0, 0.01])
def test_without_sequences_the_belief_is_the_prior(mean):
    grid, prior = (
        mesh(np.linspace(-0.5, 0.5, 201), np.linspace(-0.5, 0.5, 201)),
        CalibrationPrior(mean, 0.05, -mean / 2, 0.03),
    )
    found = vote(grid, prior, np.zeros((0, len(grid))), np.zeros(0), LEAST)
    assert found[2].shape == (0,)
    assert found[0][::2] == pytest.approx(prior[::2], abs=1e-12)
    assert found[0][1::2] == pytest.approx(prior[1::2], rel=1e-3)


@given(seeds)
def test_without_turn_errors_the_vote_on_the_bias_is_that_with_a_certain_turn_error(seed):
    """A turn error that the prior all but fixes, and one that it fixes, are voted on alike."""
    grid, prior, ratios, odds = random_case(seed, 3)
    prior = prior._replace(turn_error=0.02, turn_error_sd=0.0)
    alone = vote(np.column_stack([grid[:, 0], np.full(5, 0.02)]), prior, ratios, odds, LEAST)
    assert (*alone[0][2:], *alone[1][2:]) == pytest.approx((0.02, 0.0) * 2)
    # The other turn errors are 100 standard deviations of the prior away.
    both = mesh(grid[:, 0], [-0.08, 0.02, 0.12])
    sure = vote(both, prior._replace(turn_error_sd=1e-3), np.repeat(ratios, 3, axis=1), odds, LEAST)
    assert sure[2] == pytest.approx(alone[2], abs=1e-6)
    assert sure[0][:2] == pytest.approx(alone[0][:2], abs=1e-9)


def test_a_vote_on_one_of_them_leaves_the_other_as_the_prior():
    grid, prior = (
        mesh(np.linspace(-0.1, 0.1, 81), np.linspace(-0.1, 0.1, 81)),
        CalibrationPrior(0.01, 0.02, -0.01, 0.02),
    )
    on_bias = vote(grid, prior, of_bias(grid, 0.05, 0.003), np.array([30.0]), LEAST)
    on_turn = vote(grid, prior, of_turn(grid, -0.05, 0.003), np.array([30.0]), LEAST)
    assert on_bias[1].bias == pytest.approx(0.049, abs=0.002)
    assert on_bias[0][2:] == pytest.approx(prior[2:], rel=1e-3)
    assert on_turn[1].turn_error == pytest.approx(-0.049, abs=0.002)
    assert on_turn[0][:2] == pytest.approx(prior[:2], rel=1e-3)


@pytest.mark.parametrize("column", [0, 1])
def test_a_mean_within_two_deviations_is_shrunk_to_the_prior(column):
    fine, coarse = np.linspace(-0.1, 0.1, 401), np.linspace(-0.1, 0.1, 11)
    grid = mesh(*((fine, coarse) if column == 0 else (coarse, fine)))
    prior, peaked = CalibrationPrior(0.0, 0.03, 0.0, 0.03), (of_bias, of_turn)[column]
    near = vote(grid, prior, peaked(grid, 0.01, 0.008), np.array([9.0]), LEAST)
    mean, (kept, sd) = near[1][2 * column], near[0][2 * column :][:2]
    assert mean == pytest.approx(0.01, rel=0.2)
    assert kept == pytest.approx(0.0, abs=1e-15)
    assert sd >= mean  # what was shrunk is added to the spread
    far = vote(grid, prior, peaked(grid, 0.05, 0.002), np.array([30.0]), LEAST)
    mean, (kept, sd) = far[1][2 * column], far[0][2 * column :][:2]
    spread = np.sqrt(sd**2 - (mean - kept) ** 2)
    assert mean == pytest.approx(0.05, rel=0.02)
    assert kept == pytest.approx(mean * (1 - (SHRINK * spread / mean) ** 2), rel=1e-6)
    assert kept > 0.98 * mean


def test_the_belief_is_never_narrower_than_the_least_deviation():
    grid = mesh(np.linspace(-0.1, 0.1, 401), np.linspace(-0.1, 0.1, 41))
    ratios = np.vstack([of_bias(grid, 0.0, 1e-5), of_turn(grid, 0.0, 1e-5)])
    found = vote(grid, CalibrationPrior(0.0, 0.03, 0.0, 0.03), ratios, np.array([30.0, 30.0]), 0.02)
    assert found[0].bias_sd == 0.02
    assert found[0].turn_error_sd == LEAST_TURN_ERROR


def test_sequences_that_agree_outvote_stronger_ones_that_do_not():
    """Each true one leaves a line of biases and turn errors open; only one point is on all of these."""
    grid = mesh(np.linspace(-0.1, 0.1, 101), np.linspace(-0.1, 0.1, 41))
    prior = CalibrationPrior(0.0, 0.03, 0.0, 0.05)

    def along(angle, bias, turn_error):
        off = (grid[:, 0] - bias) * np.cos(angle) + (grid[:, 1] - turn_error) * np.sin(angle)
        return np.maximum(4 - 0.5 * (off / 0.002) ** 2, -60)

    true = [along(angle, 0.04, -0.03) for angle in (0.2, 0.9, 1.7, 2.6)]
    false = [along(angle, *at) for angle, *at in [(0.5, -0.05, 0), (1.2, 0, 0.07), (2.9, 0.01, -0.08)]]
    found = vote(grid, prior, np.vstack(true + false), np.array([0.0] * 4 + [1.0] * 3), LEAST)
    assert found[1][::2] == pytest.approx([0.04, -0.03], abs=0.004)
    assert found[2][:4].min() > 2 > -1 > found[2][4:].max()
