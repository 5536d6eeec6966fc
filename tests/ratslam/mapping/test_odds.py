"""Odds of closure sequences: the scan over calibrations of the odometry, the vote on these and the null of
scores equal slow sums; the bits of the scan do not depend on when it is asked."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.acceptance import (
    LEAST_SCORE,
    LEAST_TURN_ERROR,
    MIN_TRUE,
    PRIOR_COUNT,
    PRIOR_EXCESS,
    PRIOR_KEYFRAMES,
    PRIOR_SEQUENCES,
    SHRINK,
    TRUE_MEAN,
    estimate_null,
    log_odds,
    vote,
)
from ratslam.mapping.appearance import ViewAppearance
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.odometry_scan import (
    BIAS_SPAN,
    BIAS_STEPS,
    REACH,
    TURN_SPAN,
    TURN_STEPS,
    UNLIKELY,
    OdometryScan,
)
from ratslam.mapping.optimizer import CalibrationPrior
from tactile.base.se2 import compose, correct_heading, wrap
from tests.ratslam.mapping.map_cases import add, new_graph

CELL, GUARD, ANGLE, TURN_SD = 0.2, 5, 0.15, 0.08
CONFIG, STRAIGHT = KeyframeMapConfig(turn_error_sd=TURN_SD), KeyframeMapConfig(turn_error_sd=0.0)
BIASES = np.linspace(-BIAS_SPAN, BIAS_SPAN, BIAS_STEPS) / CELL
TURNS = np.linspace(-TURN_SPAN, TURN_SPAN, TURN_STEPS) * TURN_SD
ALL = np.arange(BIAS_STEPS * TURN_STEPS)
seeds = st.integers(0, 1000)


def path(seed, count):
    """[count] rows of motion (3), length and turn; length and turn are at least those of the motion."""
    stream = np.random.default_rng(seed)
    motion = stream.normal([0.3 * CELL, 0, 0.05], [0.1 * CELL, 0.05 * CELL, 0.3], (count, 3))
    motion[0] = 0
    more = stream.uniform(1, 1.3, (count, 2))
    return np.column_stack([motion, np.hypot(*motion[:, :2].T) * more[:, 0], abs(motion[:, 2]) * more[:, 1]])


def graph_of(rows, cut=None, config=CONFIG):
    graph = new_graph(CELL, GUARD, ViewAppearance(6, 6 * ANGLE), turn_error_sd=config.turn_error_sd)
    extend(graph, rows)
    if cut is not None:
        graph.cut.rows[cut] = 0
    return graph


def extend(graph, rows):
    for row in rows:
        add(graph, row[:3], np.zeros(3), row[3], row[4])


def scanned(graph, member):
    """[G] log ratios at all points of the grid."""
    scan = OdometryScan(graph)
    return scan.log_ratios(graph, member, np.arange(len(scan.grid)))


def reckoned(graph, calibration):
    """[N, 3] the path with this bias and turn error, one motion after another."""
    poses = [np.zeros(3)]
    for motion, length in list(zip(graph.motion.rows, graph.length.rows, strict=True))[1:]:
        poses.append(compose(poses[-1], correct_heading(motion, length, *calibration)))
    return np.array(poses)


def propagated(graph, poses, i, j):
    """[3, 3] covariance of the motion from i to j in the frame of the path, step by step."""
    covariance = np.zeros((3, 3))
    for k in range(i + 1, j + 1):
        dx, dy = (poses[k] - poses[k - 1])[:2]
        onwards = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])
        covariance = onwards @ covariance @ onwards.T + np.diag(graph.variances()[k])
    return covariance


def slow_log_ratio(graph, member, calibration):
    j, i, shift = member
    poses = reckoned(graph, calibration)
    gate = np.diag([CONFIG.gate_sd * CELL, CONFIG.gate_sd * CELL, CONFIG.gate_heading]) ** 2
    information = np.linalg.inv(propagated(graph, poses, i, j) + gate)
    density = []
    for pose in poses[: max(j - GUARD, 1)]:
        error = pose + [0, 0, -shift * ANGLE] - poses[j]
        error[2] = wrap(error[2])
        density.append(-error @ information @ error / 2)
    total = np.log(max(np.exp(density).sum(), 1.0))
    return max(np.log(len(density)) + density[i] - total, UNLIKELY)


def test_the_grid_holds_every_pair_of_bias_and_turn_error_if_turns_may_err():
    grid = OdometryScan(graph_of(path(0, 3))).grid
    pairs = {(round(bias, 9), round(turn, 9)) for bias in BIASES for turn in TURNS}
    assert {(round(bias, 9), round(turn, 9)) for bias, turn in grid.tolist()} == pairs
    assert len(grid) == len(pairs)
    straight = OdometryScan(graph_of(path(0, 3), config=STRAIGHT)).grid
    assert np.array_equal(straight, np.stack([BIASES, np.zeros(BIAS_STEPS)], axis=1))


@settings(max_examples=15)
@given(seeds, st.integers(GUARD + 2, 80), st.booleans(), st.sampled_from([CONFIG, STRAIGHT]))
def test_ratios_equal_explicit_dead_reckoning(seed, count, broken, config):
    stream = np.random.default_rng(seed)
    graph = graph_of(path(seed, count), int(stream.integers(1, count)) if broken else None, config)
    scan = OdometryScan(graph)
    j = int(stream.integers(GUARD + 1, count))
    member = np.array([j, stream.integers(0, j - GUARD), stream.integers(-3, 4)])
    found = scanned(graph, member)
    for at in [0, len(found) - 1, *stream.integers(0, len(found), 4)]:
        expected = slow_log_ratio(graph, member.tolist(), scan.grid[at])
        # Positions are kept in single precision.
        assert found[at] == pytest.approx(expected, rel=1e-4, abs=1e-4)


@settings(max_examples=6)
@given(seeds, st.lists(st.integers(1, 90), max_size=12))
def test_any_chunks_give_the_same_bits_as_all_at_once(seed, ends):
    rows = path(seed, 300)
    member, early = np.array([290, 40, 1]), np.array([8, 1, 0])
    at_once = scanned(graph_of(rows), member)
    graph = graph_of(rows[:10])
    scan = OdometryScan(graph)
    first = scan.log_ratios(graph, early, ALL)
    done = 10
    for end in [*np.cumsum([10, *ends]).tolist(), 300]:
        extend(graph, rows[done : min(end, 300)])
        done = max(done, min(end, 300))
        assert np.array_equal(scan.log_ratios(graph, early, ALL), first)
    assert np.array_equal(scan.log_ratios(graph, member, ALL), at_once)
    scan.clear()
    assert np.array_equal(scan.log_ratios(graph, member, ALL), at_once)


def test_a_cut_counts_from_the_next_question_on():
    graph, member = graph_of(path(1, 80)), np.array([70, 10, 0])
    scan = OdometryScan(graph)
    whole = scan.log_ratios(graph, member, ALL)
    graph.cut.rows[40] = 0
    cut = scan.log_ratios(graph, member, ALL)
    assert np.array_equal(cut, scanned(graph, member))
    assert not np.array_equal(cut, whole)
    assert cut == pytest.approx(np.zeros(len(ALL)), abs=0.01)  # odometry says nothing across the cut
    graph.cut.rows[40] = -1
    assert np.array_equal(scan.log_ratios(graph, member, ALL), whole)


@given(st.floats(-0.4, 0.4), st.floats(1e-6, 0.2), st.sampled_from([0.01, 0.05, 0.5]), st.booleans())
@settings(max_examples=40)
def test_what_lies_beyond_the_reach_is_left_out(mean, sd, turn_sd, turning):
    """Bias and turn error together, except that three biases always stay."""
    graph, member = graph_of(path(2, 60), config=CONFIG if turning else STRAIGHT), np.array([50, 12, 0])
    scan = OdometryScan(graph)
    prior = CalibrationPrior(mean, sd, 0.01, turn_sd) if turning else CalibrationPrior(mean, sd)
    near, wide = scan.near(prior), scan.near(prior, 5.0)
    widest = sorted(abs(BIASES - mean))[2]
    for at, (bias, turn_error) in enumerate(scan.grid.tolist()):
        off = ((bias - mean) / max(sd, widest / REACH)) ** 2
        off += ((turn_error - 0.01) / turn_sd) ** 2 if turning else 0.0
        if abs(off - REACH**2) > 1e-6:
            assert (at in near) == (off < REACH**2)
    assert np.isin(near, wide).all()
    assert turning or len(near) >= 3
    found, every = (
        scan.log_ratios(graph, member, near),
        scan.log_ratios(graph, member, np.arange(len(scan.grid))),
    )
    assert found[near] == pytest.approx(every[near], rel=1e-9, abs=1e-9)
    assert np.isnan(np.delete(found, near)).all()


LEAST = 1e-3


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


nulls = st.tuples(st.floats(0.05, 500), st.floats(0.5, 0.9 * TRUE_MEAN))


@given(st.lists(st.floats(-20, 200), min_size=1, max_size=40).map(np.array), st.integers(1, 3000), seeds)
def test_the_null_of_a_sequence_follows_from_the_others_above_the_least_score(scores, keyframes, seed):
    scores[0] = LEAST_SCORE if seed % 3 else scores[0]
    false = np.random.default_rng(seed).uniform(0, 1, len(scores))
    found = estimate_null(scores, false, keyframes)
    for k in range(len(scores)):
        others = [n for n in range(len(scores)) if n != k and scores[n] >= LEAST_SCORE]
        count = sum(false[n] for n in others)
        above = sum(false[n] * (scores[n] - LEAST_SCORE) for n in others)
        mean = (above + PRIOR_COUNT * PRIOR_EXCESS) / (count + PRIOR_COUNT)
        rate = (PRIOR_SEQUENCES + count) / (PRIOR_KEYFRAMES + keyframes)
        assert found[0][k] == pytest.approx(keyframes * rate, rel=1e-9)
        assert found[1][k] == pytest.approx(min(mean, TRUE_MEAN), rel=1e-9, abs=1e-9)


@given(st.floats(0, 100), nulls, st.floats(0, 500))
def test_odds_are_true_over_false_sequences_per_score(score, null, known):
    true = max(known, MIN_TRUE) * np.exp(-score / TRUE_MEAN) / TRUE_MEAN
    false = null[0] * np.exp(-(score - LEAST_SCORE) / null[1]) / null[1]
    expected = np.log(true) - np.log(false)
    assert log_odds(np.array([score]), *null, known)[0] == pytest.approx(expected, abs=1e-9)
