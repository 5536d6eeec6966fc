"""The scan over calibrations of the odometry equals explicit dead reckoning with each of them, and its bits
do not depend on when it is asked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.appearance import ViewAppearance
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.mapping.keyframe_graph import KeyframeGraph
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

CELL, GUARD, ANGLE, TURN_SD = 0.2, 5, 0.15, 0.08
CONFIG = KeyframeMapConfig(turn_error_sd=TURN_SD)
STRAIGHT = KeyframeMapConfig(turn_error_sd=0.0)
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
    graph = KeyframeGraph(config, CELL, ViewAppearance(6, 6 * ANGLE), GUARD, FULL)
    extend(graph, rows)
    if cut is not None:
        graph.cut.rows[cut] = 0
    return graph


def extend(graph, rows):
    for row in rows:
        graph.append(np.zeros(3), row[:3], row[3], row[4])


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
        covariance = onwards @ covariance @ onwards.T + np.diag(graph.variances(graph.cut)[k])
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


def test_the_grid_holds_every_pair_of_bias_and_turn_error():
    grid = OdometryScan(graph_of(path(0, 3))).grid
    pairs = {(round(bias, 9), round(turn, 9)) for bias in BIASES for turn in TURNS}
    assert {(round(bias, 9), round(turn, 9)) for bias, turn in grid.tolist()} == pairs
    assert len(grid) == len(pairs)


def test_without_turn_errors_the_grid_is_that_of_biases():
    grid = OdometryScan(graph_of(path(0, 3), config=STRAIGHT)).grid
    assert np.array_equal(grid, np.stack([BIASES, np.zeros(BIAS_STEPS)], axis=1))


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


@settings(max_examples=10)
@given(seeds)
def test_without_turn_errors_the_ratios_are_those_of_the_turn_error_zero(seed):
    rows, member = path(seed, 70), np.array([60, 9, 1])
    both, alone = scanned(graph_of(rows), member), scanned(graph_of(rows, config=STRAIGHT), member)
    assert both.reshape(BIAS_STEPS, TURN_STEPS)[:, TURN_STEPS // 2] == pytest.approx(
        alone, rel=1e-4, abs=1e-4
    )


def test_the_covariance_is_that_of_noisy_paths():
    """The reference's covariance, by paths with noise drawn at random."""
    graph, calibration = graph_of(path(3, 60)), (0.1, -0.1)
    poses, stream = reckoned(graph, calibration), np.random.default_rng(0)
    i, j, draws = 10, 50, 40_000
    noise = stream.normal(0, 1, (j + 1, draws, 3)) * np.sqrt(graph.variances(graph.cut)[: j + 1, None])
    at = np.tile(poses[i], (draws, 1))
    for k in range(i + 1, j + 1):
        step = correct_heading(graph.motion.rows[k], graph.length.rows[k], *calibration)
        at = compose(at, np.broadcast_to(step, at.shape)) + noise[k]
    drawn = np.cov((at - poses[j])[:, :2].T)
    expected = propagated(graph, poses, i, j)
    assert drawn == pytest.approx(expected[:2, :2], rel=0.15, abs=0.05 * np.trace(drawn))
    assert np.var(wrap(at - poses[j])[:, 2]) == pytest.approx(expected[2, 2], rel=0.05)


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


def test_poses_of_the_map_do_not_matter():
    graph, member = graph_of(path(1, 80)), np.array([70, 10, 0])
    before = scanned(graph, member)
    graph.pose.rows[:] = np.random.default_rng(0).normal(0, 5, graph.pose.rows.shape)
    graph.bias, graph.turn_error = 0.2, 0.1
    assert np.array_equal(scanned(graph, member), before)


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


def lap(turn, bias, turn_error, count=40):
    """Rows of a circle of radius 1 m, of which every step truly turns by `turn`, measured with a calibration
    that lacks both corrections."""
    step = 2 * np.pi / count
    measured = (turn - bias * step) / (1 + turn_error)
    missing = (measured - turn) / 2
    return np.tile(
        [step * np.cos(missing), step * np.sin(missing), measured, step, abs(measured)], (count, 1)
    )


def test_a_bias_that_leads_back_to_the_place_is_favoured():
    """Laps of a circle, measured with a heading bias: closures of equal places show it."""
    graph = graph_of(np.tile(lap(2 * np.pi / 40, 0.15, 0.0), (3, 1)), config=STRAIGHT)
    biases = OdometryScan(graph).grid[:, 0]
    found = sum(scanned(graph, np.array([j, j - 40 * laps, 0])) for j, laps in [(100, 2), (110, 1)])
    assert biases[found.argmax()] == pytest.approx(0.15, abs=0.02)
    assert found.max() > 1 > found[biases < 0].max()


@pytest.mark.parametrize("bias", [0.0, 0.1])
@pytest.mark.parametrize("turn_error", [-0.12, 0.06])
def test_a_turn_error_is_told_from_a_bias_by_turns_to_both_sides(bias, turn_error):
    """Laps to the left and to the right: a heading bias opens one and shuts the other, a turn error acts on
    both alike."""
    left, right = (lap(side * 2 * np.pi / 40, bias, turn_error) for side in (1, -1))
    graph = graph_of(np.concatenate([left, left, right, right]))
    grid = OdometryScan(graph).grid
    found = sum(scanned(graph, np.array([j, i, 0])) for j, i in [(75, 35), (70, 30), (155, 115), (150, 110)])
    assert grid[found.argmax()] == pytest.approx([bias, turn_error], abs=0.021)
    assert found.max() > 1 > found[grid[:, 1] * turn_error < 0].max()
