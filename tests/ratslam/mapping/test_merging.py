"""Which keyframes are merged, and with which."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.appearance import LabelAppearance, ViewMetric
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.merging import FACING, NEAR, REACH, find_merge
from ratslam.recall.memory import NO_LIKENESS
from tactile.base.se2 import between, compose, integrate, wrap

CELL = 0.5
STEP = 0.19
GUARD = 20
LAP = 40
STOOD, NEWEST = 2, 10


class Whiskers(LabelAppearance):
    """Views that are compared turned by half a turn too."""

    def metric(self):
        return ViewMetric(np.pi, 0.0, NO_LIKENESS)


def graph_of(poses, appearance=LabelAppearance, **settings):
    """A graph at these poses [N, 3], whose odometry has no error."""
    settings = {"merge_stood": STOOD, "merge_newest": NEWEST} | settings
    config = KeyframeMapConfig.model_validate(settings)
    graph = KeyframeGraph(config, CELL, appearance(), GUARD, FULL)
    motions = np.vstack([np.zeros(3), between(poses[:-1], poses[1:])])
    for pose, motion in zip(poses, motions, strict=True):
        graph.append(pose, motion, float(np.hypot(*motion[:2])), abs(float(motion[2])))
    return graph


def circle(count):
    """[count, 3] poses on a circle of `LAP` keyframes."""
    turn = 2 * np.pi / LAP
    motion = np.tile([STEP * np.cos(turn / 2), STEP * np.sin(turn / 2), turn], (count - 1, 1))
    return np.vstack([np.zeros(3), integrate(motion)])


def log_of(*sequences, stood=STOOD):
    """Accepted sequences of keyframes that match those a lap before, after `stood` selections."""
    log = ClosureLog()
    for frames in filter(len, sequences):
        for k, frame in enumerate(frames):
            log.add(Candidate(frame, frame - LAP, 0, 1.0, 4.0), k > 0)
        log.judge(log.sequences - 1, Verdict.ACCEPTED)
    for _ in range(stood):
        log.count_selection()
    return log


def merged(graph, log):
    """The numbers of the merged keyframes."""
    merge = find_merge(graph, log, graph.config.merge_newest)
    return [] if merge is None else np.flatnonzero(~merge.is_kept()).tolist()


def test_confirmed_keyframes_are_merged_with_those_of_the_lap_before():
    graph = graph_of(circle(100))
    merge = find_merge(graph, log_of(range(45, 76)), NEWEST)
    assert merged(graph, log_of(range(45, 76))) == list(range(45, 76))
    assert merge.kept[merge.onto[45:76]].tolist() == list(range(5, 36))
    assert np.abs(merge.offset).max() < 1e-9
    assert not merge.turned().any()


def test_keyframes_of_several_laps_are_merged_with_the_first():
    graph = graph_of(circle(130))
    merge = find_merge(graph, log_of(range(45, 110)), NEWEST)
    assert merge.kept[merge.onto[85:105]].tolist() == list(range(5, 25))


@pytest.mark.parametrize("newest", [10, 30, 40, 60])
def test_the_newest_keyframes_are_not_merged(newest):
    graph = graph_of(circle(100), merge_newest=newest)
    assert merged(graph, log_of(range(45, 95))) == list(range(45, min(95, 100 - newest)))


@pytest.mark.parametrize("stood", range(4))
def test_a_sequence_confirms_once_it_has_stood(stood):
    graph = graph_of(circle(100))
    assert bool(merged(graph, log_of(range(45, 76), stood=stood))) == (stood >= STOOD)


def test_a_weak_or_refused_sequence_confirms_nothing():
    graph, log = graph_of(circle(100)), log_of(range(45, 60), range(65, 76))
    log.weigh(np.array([0.5, 0.51]))
    assert merged(graph, log) == list(range(65, 76))
    log.judge(1, Verdict.OPEN)
    assert merged(graph, log) == []


@pytest.mark.parametrize("ahead", [20, 30, 50, 60])
def test_keyframes_are_merged_within_reach_of_confirmed_ones_before_and_after(ahead):
    graph = graph_of(circle(140))
    reach = REACH * CELL / STEP
    near = [k for k in range(50, 50 + ahead + 1) if k - 50 <= reach and 50 + ahead - k <= reach]
    assert merged(graph, log_of([50], [50 + ahead])) == sorted({50, *near, 50 + ahead})


def test_keyframes_at_a_cut_and_before_it_are_not_merged():
    graph = graph_of(circle(100))
    graph.cut.rows[60] = 0
    assert merged(graph, log_of(range(45, 76))) == [*range(45, 59), *range(61, 76)]


@pytest.mark.parametrize("error", [[0.5, 0.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 2 * np.pi]])
def test_keyframes_near_strained_odometry_are_not_merged(error):
    graph = graph_of(circle(100))
    graph.motion.rows[60] += error
    spared = set() if error[2] > np.pi else set(range(54, 66))  # both ends, and 5 more
    assert merged(graph, log_of(range(45, 76))) == sorted(set(range(45, 76)) - spared)


def test_a_turn_near_half_a_turn_is_not_strained():
    poses = circle(100)
    poses[[20, 60], 2] = wrap(poses[[19, 59], 2] + np.pi - 0.001)
    graph = graph_of(poses)
    graph.motion.rows[60, 2] = wrap(graph.motion.rows[60, 2] + 0.002)
    assert abs(graph.motion.rows[60, 2]) > 3.1
    assert merged(graph, log_of(range(45, 76))) == list(range(45, 76))


def test_odometry_at_a_seam_is_not_strained():
    graph = graph_of(circle(100))
    graph.motion.rows[60] += 0.5
    graph.seam.rows[60] = True
    assert merged(graph, log_of(range(45, 76))) == list(range(45, 76))


def test_both_ends_of_a_seam_are_confirmed():
    graph = graph_of(circle(100))
    graph.seam.rows[60] = True
    assert merged(graph, ClosureLog()) == [59, 60]
    graph.seam.rows[70] = True
    assert merged(graph, ClosureLog()) == list(range(59, 71))


def test_keyframes_without_older_ones_are_not_merged():
    graph = graph_of(circle(100))
    graph.seam.rows[[6, GUARD]] = True
    assert merged(graph, ClosureLog()) == []


def test_nothing_is_merged_on_new_ground():
    straight = np.column_stack([STEP * np.arange(100), np.zeros(100), np.zeros(100)])
    assert find_merge(graph_of(straight), log_of(range(45, 76)), NEWEST) is None
    assert find_merge(graph_of(circle(100)), ClosureLog(), NEWEST) is None


@pytest.mark.parametrize(
    ("aside", "turn", "met"),
    [(0.24, 0.0, True), (0.26, 0.0, False), (0.0, 0.24, True), (0.0, 0.28, False), (0.17, -0.25, True)],
)
def test_merged_keyframes_are_near_each_other_and_face_alike(aside, turn, met):
    out = np.column_stack([STEP * np.arange(50), np.zeros(50), np.zeros(50)])
    far = np.column_stack([np.full(30, 50.0), STEP * np.arange(30), np.zeros(30)])
    back = np.array([[STEP * 20, aside, turn]])
    graph = graph_of(np.vstack([out, back, far]))
    graph.motion.rows[50:52] = between(graph.pose.rows[49:51], graph.pose.rows[50:52])
    assert merged(graph, log_of([50])) == ([50] if met else [])


@pytest.mark.parametrize("appearance", [LabelAppearance, Whiskers])
def test_keyframes_that_face_opposite_ways_are_merged_with_whiskers_only(appearance):
    there = np.column_stack([STEP * np.arange(50), np.zeros(50), np.full(50, 0.05)])
    back = np.column_stack([STEP * np.arange(50)[::-1], np.full(50, 0.1), np.full(50, wrap(np.pi - 0.1))])
    merge = find_merge(graph_of(np.vstack([there, back]), appearance), log_of(range(65, 85)), NEWEST)
    if appearance is LabelAppearance:
        assert merge is None
    else:
        assert np.flatnonzero(merge.turned()).tolist() == list(range(65, 85))
        assert merge.kept[merge.onto[65:85]].tolist() == [99 - k for k in range(65, 85)]


@given(st.integers(0, 2**32 - 1), st.booleans(), st.integers(60, 160), st.integers(1, 40))
def test_a_merge_is_one_of_older_kept_keyframes_at_the_same_pose(seed, whiskers, count, newest):
    stream = np.random.default_rng(seed)
    centre = stream.uniform(0, 2, 2)
    poses = np.column_stack([centre + stream.uniform(0, 0.8, (count, 2)), stream.uniform(-9, 9, count)])
    poses[:, 2] = wrap(np.round(poses[:, 2]) + stream.normal(0, 0.05, count))
    graph = graph_of(poses, Whiskers if whiskers else LabelAppearance, merge_newest=newest)
    log = log_of(*np.split(np.arange(LAP, count), np.sort(stream.integers(0, count - LAP, 4))))
    merge = find_merge(graph, log, newest)
    if merge is None:
        return
    kept = merge.is_kept()
    gone = np.flatnonzero(~kept)
    onto, offset = merge.kept[merge.onto], merge.offset
    assert np.array_equal(merge.kept, np.flatnonzero(kept))
    assert np.array_equal(onto[kept], merge.kept)
    assert not offset[kept].any()
    assert len(gone)
    assert gone.min() > GUARD
    assert gone.max() < count - newest
    assert (onto[gone] < gone - GUARD).all()
    assert np.hypot(*offset[gone, :2].T).max() <= NEAR * CELL
    turn = np.abs(offset[gone, 2])
    assert (turn <= FACING).sum() + whiskers * (turn >= np.pi - FACING).sum() == len(gone)
    assert np.array_equal(merge.turned()[gone], turn > 1)
    apart = compose(poses[onto], offset) - poses
    apart[:, 2] = wrap(apart[:, 2])
    assert np.abs(apart).max() < 1e-12
    for frame in gone.tolist():  # with the best of those that it could be merged with
        older = merge.kept[merge.kept < frame - GUARD]
        off = np.abs(wrap(poses[older, 2] - poses[frame, 2]))
        off = np.minimum(off, np.pi - off) if whiskers else off
        far = ((poses[older] - poses[frame])[:, :2] ** 2).sum(axis=1) / (NEAR * CELL) ** 2
        cost = np.where((off <= FACING) & (far <= 1), far + (off / FACING) ** 2, np.inf)
        assert onto[frame] == older[np.argmin(cost)]


def test_all_keyframes_that_can_be_merged_are_merged():
    graph = graph_of(circle(200))
    assert merged(graph, log_of(range(41, 195))) == list(range(41, 190))
