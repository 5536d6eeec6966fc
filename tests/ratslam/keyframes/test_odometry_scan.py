"""The scan over heading biases equals explicit dead reckoning with each of them, and its bits do not depend
on when it is asked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.keyframes.appearance import ViewAppearance
from ratslam.keyframes.bias_scan import REACH, SPAN, STEPS, UNLIKELY, BiasScan
from ratslam.keyframes.config import FULL, KeyframeMapConfig
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.optimizer import BiasPrior
from tactile.base.se2 import compose, correct_heading_bias, wrap

CELL, GUARD, ANGLE = 0.2, 5, 0.15
CONFIG = KeyframeMapConfig()
WIDE = BiasPrior(0.0, 1.0)
seeds = st.integers(0, 1000)


def path(seed, count):
    """[count] rows of motion (3), length and turn; length and turn are at least those of the motion."""
    stream = np.random.default_rng(seed)
    motion = stream.normal([0.3 * CELL, 0, 0.05], [0.1 * CELL, 0.05 * CELL, 0.3], (count, 3))
    motion[0] = 0
    more = stream.uniform(1, 1.3, (count, 2))
    return np.column_stack([motion, np.hypot(*motion[:, :2].T) * more[:, 0], abs(motion[:, 2]) * more[:, 1]])


def graph_of(rows, cut=None):
    graph = KeyframeGraph(CONFIG, CELL, ViewAppearance(6, 6 * ANGLE), GUARD, FULL)
    extend(graph, rows)
    if cut is not None:
        graph.cut.rows[cut] = 0
    return graph


def extend(graph, rows):
    for row in rows:
        graph.append(np.zeros(3), row[:3], row[3], row[4])


def reckoned(graph, bias):
    """[N, 3] the path with this bias, one motion after another."""
    poses = [np.zeros(3)]
    for motion, length in list(zip(graph.motion.rows, graph.length.rows, strict=True))[1:]:
        poses.append(compose(poses[-1], correct_heading_bias(motion, length, bias)))
    return np.array(poses)


def propagated(graph, poses, i, j):
    """[3, 3] covariance of the motion from i to j in the frame of the path, step by step."""
    covariance = np.zeros((3, 3))
    for k in range(i + 1, j + 1):
        dx, dy = (poses[k] - poses[k - 1])[:2]
        onwards = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])
        covariance = onwards @ covariance @ onwards.T + np.diag(graph.variances(graph.cut)[k])
    return covariance


def slow_log_ratio(graph, member, bias):
    j, i, shift = member
    poses = reckoned(graph, bias)
    gate = np.diag([CONFIG.gate_sd * CELL, CONFIG.gate_sd * CELL, CONFIG.gate_heading]) ** 2
    information = np.linalg.inv(propagated(graph, poses, i, j) + gate)
    density = []
    for pose in poses[: max(j - GUARD, 1)]:
        error = pose + [0, 0, -shift * ANGLE] - poses[j]
        error[2] = wrap(error[2])
        density.append(-error @ information @ error / 2)
    total = np.log(max(np.exp(density).sum(), 1.0))
    return max(np.log(len(density)) + density[i] - total, UNLIKELY)


@settings(max_examples=15)
@given(seeds, st.integers(GUARD + 2, 80), st.booleans())
def test_ratios_equal_explicit_dead_reckoning(seed, count, broken):
    stream = np.random.default_rng(seed)
    graph = graph_of(path(seed, count), int(stream.integers(1, count)) if broken else None)
    scan = BiasScan(graph)
    j = int(stream.integers(GUARD + 1, count))
    member = np.array([j, stream.integers(0, j - GUARD), stream.integers(-3, 4)])
    found = scan.log_ratios(member, WIDE)
    assert scan.grid == pytest.approx(np.linspace(-SPAN, SPAN, STEPS) / CELL)
    for at in (0, 60, 120, 197, 240):
        expected = slow_log_ratio(graph, member.tolist(), scan.grid[at])
        assert found[at] == pytest.approx(expected, rel=1e-5, abs=1e-5)


def test_the_covariance_is_that_of_noisy_paths():
    """The reference's covariance, by paths with noise drawn at random."""
    graph, bias = graph_of(path(3, 60)), 0.1
    poses, stream = reckoned(graph, bias), np.random.default_rng(0)
    i, j, draws = 10, 50, 40_000
    noise = stream.normal(0, 1, (j + 1, draws, 3)) * np.sqrt(graph.variances(graph.cut)[: j + 1, None])
    at = np.tile(poses[i], (draws, 1))
    for k in range(i + 1, j + 1):
        step = correct_heading_bias(graph.motion.rows[k], graph.length.rows[k], bias)
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
    at_once = BiasScan(graph_of(rows)).log_ratios(member, WIDE)
    graph = graph_of(rows[:10])
    scan = BiasScan(graph)
    first = scan.log_ratios(early, WIDE)
    done = 10
    for end in [*np.cumsum([10, *ends]).tolist(), 300]:
        extend(graph, rows[done : min(end, 300)])
        done = max(done, min(end, 300))
        assert np.array_equal(scan.log_ratios(early, WIDE), first)
    assert np.array_equal(scan.log_ratios(member, WIDE), at_once)
    scan.clear()
    assert np.array_equal(scan.log_ratios(member, WIDE), at_once)


def test_a_cut_counts_from_the_next_question_on():
    graph, member = graph_of(path(1, 80)), np.array([70, 10, 0])
    scan = BiasScan(graph)
    whole = scan.log_ratios(member, WIDE)
    graph.cut.rows[40] = 0
    cut = scan.log_ratios(member, WIDE)
    assert np.array_equal(cut, BiasScan(graph).log_ratios(member, WIDE))
    assert not np.array_equal(cut, whole)
    assert cut == pytest.approx(np.zeros(STEPS), abs=0.01)  # odometry says nothing across the cut
    graph.cut.rows[40] = -1
    assert np.array_equal(scan.log_ratios(member, WIDE), whole)


def test_poses_of_the_map_do_not_matter():
    graph, member = graph_of(path(1, 80)), np.array([70, 10, 0])
    before = BiasScan(graph).log_ratios(member, WIDE)
    graph.pose.rows[:] = np.random.default_rng(0).normal(0, 5, graph.pose.rows.shape)
    graph.bias = 0.2
    assert np.array_equal(BiasScan(graph).log_ratios(member, WIDE), before)


@given(st.floats(-0.4, 0.4), st.floats(1e-6, 0.2))
@settings(max_examples=25)
def test_biases_beyond_the_prior_are_left_out(mean, sd):
    graph, member = graph_of(path(2, 60)), np.array([50, 12, 0])
    scan = BiasScan(graph)
    wide, found = scan.log_ratios(member, WIDE), scan.log_ratios(member, BiasPrior(mean, sd))
    inside = abs(scan.grid - mean) < REACH * sd
    nearest = np.argsort(abs(scan.grid - mean), kind="stable")[:3]
    known = inside if inside.sum() >= 3 else np.isin(np.arange(STEPS), nearest)
    assert found[known] == pytest.approx(wide[known], rel=1e-9, abs=1e-9)
    assert (found[~known] == UNLIKELY).all()


def test_a_bias_that_leads_back_to_the_place_is_favoured():
    """Laps of a circle, measured with a heading bias: closures of equal places show it."""
    count, radius, bias = 120, 1.0, 0.15
    step = 2 * np.pi * radius / 40
    rows = np.tile([step, 0.0, step / radius - bias * step, step, step / radius], (count, 1))
    graph = graph_of(rows)
    scan = BiasScan(graph)
    found = sum(scan.log_ratios(np.array([j, j - 40 * laps, 0]), WIDE) for j, laps in [(100, 2), (110, 1)])
    assert scan.grid[found.argmax()] == pytest.approx(bias, abs=0.02)
    assert found.max() > 1 > found[scan.grid < 0].max()
