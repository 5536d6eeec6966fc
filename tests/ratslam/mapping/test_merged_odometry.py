"""Odometry after keyframes were merged: nothing is lost, nothing is counted twice, poses stay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.appearance import LabelAppearance
from ratslam.mapping.archive import Archive
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.merging import ATTACHED, Merge, merge_keyframes
from ratslam.mapping.odometry_calibration import HeadingNoise
from ratslam.mapping.optimizer import CalibrationPrior, System
from tactile.base.se2 import between, compose, correct_heading, inverse, wrap
from tests.ratslam.mapping.optimizer_cases import apart, miscalibrated

CELL = 0.5
seeds = st.integers(0, 2**32 - 1)


def empty_graph():
    return KeyframeGraph(KeyframeMapConfig(), CELL, LabelAppearance(), 20, FULL)


def random_graph(stream, count, bias=0.0, turn_error=0.0, cuts=0):
    """A graph at random poses whose odometry shows these errors and no others."""
    poses = np.column_stack(
        [np.cumsum(stream.normal(0, 0.3, (count, 2)), axis=0), stream.normal(0, 2, count)]
    )
    poses[:, 2] = wrap(poses[:, 2])
    true = between(poses[:-1], poses[1:])
    length = np.hypot(*true[:, :2].T) * stream.uniform(1, 1.2, count - 1)
    motion = np.vstack([np.zeros(3), miscalibrated(true, length, bias, turn_error)])
    graph = empty_graph()
    for k, (pose, moved) in enumerate(zip(poses, motion, strict=True)):
        graph.append(pose, moved, length[k - 1] if k else 0.0, abs(moved[2]) + 0.1)
    graph.cut.rows[stream.integers(1, count, cuts)] = 0
    graph.bias, graph.turn_error = bias, turn_error
    graph.prior = CalibrationPrior(bias, 0.1, turn_error, 0.1)
    return graph


def random_merge(stream, graph, share=0.5):
    """Merges keyframes other than the first, the newest and those at cuts with older ones that remain."""
    count, pose = graph.count, graph.pose.rows
    gone = stream.random(count) < share
    cut = graph.cut.rows >= 0
    gone &= ~cut & ~np.append(cut[1:], True)
    gone[0] = False
    onto = np.arange(count)
    for frame in np.flatnonzero(gone).tolist():
        onto[frame] = stream.choice(np.flatnonzero(~gone[:frame]))
    offset = np.where(gone[:, None], between(pose[onto], pose), 0.0)
    return merge_with(gone, onto, offset)


def merge_with(gone, onto, offset):
    """Merges the keyframes `gone` [N] with keyframes `onto` [N]."""
    return Merge(np.flatnonzero(~gone), (np.cumsum(~gone) - 1)[onto], offset)


def merge_all(graph, archive, merge):
    archive.merge(merge, graph, ClosureLog())
    merge_keyframes(graph, merge)


@given(seeds, st.integers(2, 40), st.integers(0, 2))
def test_poses_stay_and_the_archive_follows(seed, count, cuts):
    stream = np.random.default_rng(seed)
    graph, archive = random_graph(stream, count, cuts=cuts), Archive(empty_graph())
    before, number = graph.pose.rows.copy(), np.arange(count)
    for _ in range(3):
        merge = random_merge(stream, graph)
        number = number[merge.kept]
        merge_all(graph, archive, merge)
        assert np.array_equal(graph.taken.rows, number)
        assert np.array_equal(graph.pose.rows, before[number])
        assert apart(archive.poses(graph.pose.rows), before) < 1e-9
        assert np.array_equal(archive.row.rows[number], np.arange(graph.count))


@given(seeds, st.integers(2, 25), st.integers(0, 2))
def test_exact_odometry_remains_exact(seed, count, cuts):
    stream = np.random.default_rng(seed)
    graph, archive = random_graph(stream, count, cuts=cuts), Archive(empty_graph())
    length, turn = graph.length.rows.sum(), graph.turn.rows.sum()
    for _ in range(2):
        merge_all(graph, archive, random_merge(stream, graph))
        error = between(*graph.pose.rows[np.stack([graph.links.i, graph.links.j])]) - graph.links.motion
        error[:, 2] = wrap(error[:, 2])
        assert np.abs(error).max(initial=0) < 1e-9
        assert System(graph.problem(ClosureLog(), graph.cut)).robust_cost(graph.fit()) < 1e-9
        assert apart(graph.dead_reckoned(), graph.pose.rows.copy()) < 1e-9
        assert graph.length.rows.sum() == pytest.approx(length)
        assert graph.turn.rows.sum() == pytest.approx(turn)


@given(seeds, st.integers(4, 40), st.integers(0, 3))
def test_links_join_what_odometry_joined(seed, count, cuts):
    """Pieces of the map that odometry connects are those before, and no link crosses a cut."""
    stream = np.random.default_rng(seed)
    graph, archive = random_graph(stream, count, cuts=cuts), Archive(empty_graph())
    merge = random_merge(stream, graph)
    whole = graph.cut.rows < 0
    ends = {(int(merge.onto[k - 1]), int(merge.onto[k])) for k in range(1, count) if whole[k]}
    merge_all(graph, archive, merge)
    chain = {(k - 1, k) for k in range(1, graph.count) if graph.cut.rows[k] < 0 and not graph.seam.rows[k]}
    links = set(zip(graph.links.i.tolist(), graph.links.j.tolist(), strict=True))
    assert chain | links == {(min(a, b), max(a, b)) for a, b in ends if a != b}
    assert all(a < b for a, b in links)
    loose = graph.variances(graph.cut)[1:, 0] > 1e3
    assert np.array_equal(loose, graph.seam.rows[1:] | (graph.cut.rows[1:] >= 0))


def there_and_back(stream, bias=0.0, turn_error=0.0, noise=0.01, turn=0.2):
    """Keyframes a b a b, each pass with its own noise, and one more; those seen again are merged with the
    first ones. The second pass is driven in reverse: from b to a."""
    ends = np.array([[0.0, 0.0, 0.3], [0.2, 0.05, 0.3 + turn]])
    poses = np.vstack([ends[[0, 1, 0, 1]], [[0.5, 0.5, 1.0]]])
    true = between(poses[:-1], poses[1:])
    length = np.hypot(*true[:, :2].T) + 0.05
    motion = miscalibrated(true, length, bias, turn_error) + stream.normal(0, noise, (4, 3))
    graph = empty_graph()
    for k, pose in enumerate(poses):
        moved = motion[k - 1] if k else np.zeros(3)
        graph.append(pose, moved, length[k - 1] if k else 0.0, abs(moved[2]) * (1 + 0.5 * k))
    graph.bias, graph.turn_error = bias, turn_error
    onto = np.array([0, 1, 0, 1, 2])
    return graph, Merge(np.array([0, 1, 4]), onto, np.zeros((5, 3)))


@given(seeds, st.floats(0.5, 4.0), st.sampled_from([0.2, np.pi - 0.002]))
def test_parallel_links_are_fused_by_their_information(seed, factor, turn):
    graph, merge = there_and_back(np.random.default_rng(seed), turn=turn)
    graph.heading_noise = HeadingNoise(float(np.log(factor)))
    plain = graph.own_variances()
    assert np.allclose(plain * [1, 1, factor], graph.variances(graph.cut))
    motion, length = graph.motion.rows.copy(), graph.length.rows.copy()
    merge_keyframes(graph, merge)
    links = graph.links
    assert list(zip(links.i.tolist(), links.j.tolist(), strict=True)) == [(0, 1), (1, 2)]

    attached = (ATTACHED * CELL) ** 2 * np.array([1, 1, 0])
    information = 1 / (plain[2:4] + attached)
    passes = np.stack([inverse(motion[2]), motion[3]])
    assert np.allclose(links.variance[0], 1 / information.sum(axis=0))
    off = passes - passes[0]
    off[:, 2] = wrap(off[:, 2])
    mean = passes[0] + (information * off).sum(axis=0) / information.sum(axis=0)
    assert apart(links.motion[:1].copy(), mean[None]) < 1e-12
    assert abs(links.motion[0, 2]) <= np.pi
    share = information[:, 2] / information[:, 2].sum()
    assert np.isclose(links.length[0], share @ (length[2:4] * [-1, 1]))
    assert np.isclose(links.turn[0], share @ (motion[2:4, 2] * [-1, 1]))
    assert np.allclose(links.motion[1], motion[4])
    assert np.allclose(links.variance[1], plain[4] + attached)
    used = graph.problem(ClosureLog(), graph.cut).links
    assert np.allclose(used.variance, links.variance * [1, 1, factor])


def test_links_of_two_merges_are_fused_as_if_merged_at_once():
    stream = np.random.default_rng(0)
    both, merge = there_and_back(stream)
    stepwise, _ = there_and_back(np.random.default_rng(0))
    merge_keyframes(both, merge)
    first = Merge(np.array([0, 1, 3, 4]), np.array([0, 1, 0, 2, 3]), np.zeros((5, 3)))
    merge_keyframes(stepwise, first)
    assert stepwise.seam.rows.tolist() == [False, False, True, False]
    merge_keyframes(stepwise, Merge(np.array([0, 1, 3]), np.array([0, 1, 1, 2]), np.zeros((4, 3))))
    attached = (ATTACHED * CELL) ** 2
    for name in ("i", "j", "motion", "length", "turn", "variance"):
        assert np.allclose(getattr(both.links, name), getattr(stepwise.links, name)), name
    assert attached < both.links.variance[1, 0]


@given(seeds, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_a_link_driven_in_reverse_is_corrected_as_it_was_driven(seed, bias, turn_error):
    """The only pass over the link is that from b to a."""
    graph, _ = there_and_back(np.random.default_rng(seed), bias, turn_error)
    motion, length = graph.motion.rows[2].copy(), graph.length.rows[2]
    graph.cut.rows[3] = 0  # and so not the one from a to b
    merge_keyframes(graph, Merge(np.array([0, 1, 3, 4]), np.array([0, 1, 0, 2, 3]), np.zeros((5, 3))))
    driven = correct_heading(motion, length, bias, turn_error)
    corrected = graph.fit().corrected_links(graph.links)
    assert graph.links.i.tolist() == [0]
    assert graph.links.j.tolist() == [1]
    assert apart(corrected, inverse(driven)[None]) < 1e-12


@given(seeds, st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.booleans())
def test_links_are_corrected_like_the_odometry_they_are_made_of(seed, bias, turn_error, turned):
    """Up to the bend of the offset, which is short."""
    stream = np.random.default_rng(seed)
    graph = random_graph(stream, 5, bias, turn_error)
    moved, length = graph.motion.rows.copy(), graph.length.rows.copy()
    offset = np.zeros((5, 3))
    offset[2] = [*stream.uniform(-0.05, 0.05, 2), stream.normal(0, 0.2) + np.pi * turned]
    merge_keyframes(graph, Merge(np.array([0, 1, 3, 4]), np.array([0, 1, 0, 2, 3]), offset))
    assert list(zip(graph.links.i.tolist(), graph.links.j.tolist(), strict=True)) == [(0, 1), (0, 2)]
    into, onwards = correct_heading(moved[2:4], length[2:4], bias, turn_error)
    expected = [inverse(compose(into, inverse(offset[2]))), compose(offset[2], onwards)]
    bend = np.abs(bias * length[2:4] + turn_error * moved[2:4, 2])
    found = apart(graph.fit().corrected_links(graph.links), np.array(expected))
    assert found <= bend.max() * np.hypot(*offset[2, :2]) + 1e-12
    if not bend.max() < 1e-3:
        raw = np.stack([inverse(compose(moved[2], inverse(offset[2]))), compose(offset[2], moved[3])])
        assert found < apart(raw, np.array(expected))  # and not as if it were not corrected


def test_merged_odometry_still_shows_the_calibration():
    bias, turn_error, count, again = 0.05, -0.02, 60, 20
    graph, log = random_graph(np.random.default_rng(3), count, bias, turn_error), ClosureLog()
    for k, pose in enumerate(graph.pose.rows[:again].copy()):  # once more over the first keyframes
        true = between(graph.pose.rows[-1], pose)
        length = np.hypot(*true[:2])
        motion = miscalibrated(true[None], np.array([length]), bias, turn_error)[0]
        graph.append(pose, motion, float(length), abs(float(motion[2])))
        log.add(Candidate(count + k, k, 0, 1.0, 9.0), k > 0)
    log.judge(0, Verdict.ACCEPTED)
    frames = np.arange(count + again)
    gone = (frames > count) & (frames < frames[-1] - 4)
    merge = merge_with(gone, np.where(gone, frames - count, frames), np.zeros((len(frames), 3)))
    graph.prior, graph.bias, graph.turn_error = CalibrationPrior(0.0, 1.0, 0.0, 1.0), 0.0, 0.0
    log.merge(gone, merge.onto, merge.turned())
    merge_keyframes(graph, merge)
    fit = graph.solve(log, 50)
    assert fit.bias == pytest.approx(bias, abs=2e-3)
    assert fit.turn_error == pytest.approx(turn_error, abs=2e-3)
