"""Which keyframes are merged, and with which; of their odometry nothing is lost and nothing counted twice."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.appearance import LabelAppearance, ViewMetric
from ratslam.mapping.keyframe_merger import archive_merge
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.merging import ATTACHED, FACING, NEAR, REACH, find_merge, merge_keyframes
from ratslam.mapping.odometry_calibration import HeadingNoise
from ratslam.mapping.optimizer import CalibrationPrior, System
from ratslam.recall.memory import NO_LIKENESS, MergedRows
from tactile.base.se2 import between, compose, correct_heading, integrate, inverse, wrap
from tests.ratslam.mapping.map_cases import add, new_graph, with_log
from tests.ratslam.mapping.optimizer_cases import apart, miscalibrated

CELL, STEP, GUARD, LAP, STOOD, NEWEST = 0.5, 0.19, 20, 40, 2, 10


class Whiskers(LabelAppearance):
    """Views that are compared turned by half a turn too."""

    def metric(self):
        return ViewMetric(np.pi, 0.0, NO_LIKENESS)


def graph_of(poses, appearance=LabelAppearance, **settings):
    """A graph at these poses [N, 3], whose odometry has no error."""
    settings = {"merge_stood": STOOD, "merge_newest": NEWEST} | settings
    graph = new_graph(CELL, GUARD, appearance(), **settings)
    for pose, motion in zip(poses, np.vstack([np.zeros(3), between(poses[:-1], poses[1:])]), strict=True):
        add(graph, motion, pose)
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
        log.add_accepted(Candidate(frame, frame - LAP, 0, 1.0, 4.0) for frame in frames)
    for _ in range(stood):
        log.count_selection()
    return log


def line(count):
    """[count, 3] poses straight ahead."""
    return STEP * np.outer(np.arange(count), [1.0, 0.0, 0.0])


def merged(graph, *sequences, stood=STOOD):
    """The numbers of the merged keyframes."""
    merge = find_merge(with_log(graph, log_of(*sequences, stood=stood)), graph.config.merge_newest)
    return [] if merge is None else np.flatnonzero(~merge.is_kept()).tolist()


def test_confirmed_keyframes_but_the_newest_are_merged_with_those_of_the_first_lap():
    merge = find_merge(with_log(graph_of(circle(130)), log_of(range(45, 110))), NEWEST)
    gone = np.flatnonzero(~merge.is_kept())
    assert gone.tolist() == list(range(45, 110))
    assert merge.source[merge.onto[gone]].tolist() == [frame % LAP for frame in range(45, 110)]
    assert np.abs(merge.offset).max() < 1e-9
    assert not merge.turned().any()
    for newest in (10, 40):
        graph = graph_of(circle(100), merge_newest=newest)
        assert merged(graph, range(45, 95)) == list(range(45, min(95, 100 - newest)))


def test_sequences_that_stood_and_weigh_and_both_ends_of_a_seam_confirm():
    graph = graph_of(circle(100))
    assert merged(graph, range(45, 76), stood=STOOD - 1) == []
    log = log_of(range(45, 60), range(65, 76))
    log.weigh(np.array([0.5, 0.51]))
    merge = find_merge(with_log(graph, log), NEWEST)
    assert np.flatnonzero(~merge.is_kept()).tolist() == list(range(65, 76))
    log.judge(1, Verdict.OPEN)
    assert find_merge(with_log(graph, log), NEWEST) is None
    assert merged(graph_of(line(100)), range(45, 76)) == merged(graph) == []
    for seams, confirmed in (([6, GUARD], []), ([60], [59, 60]), ([60, 70], [*range(59, 71)])):
        graph.seam.rows[:] = np.isin(np.arange(100), seams)
        assert merged(graph) == confirmed


@pytest.mark.parametrize("ahead", [20, 50, 60])
def test_keyframes_are_merged_within_reach_of_confirmed_ones_before_and_after(ahead):
    reach = REACH * CELL / STEP
    near = [k for k in range(50, 50 + ahead + 1) if k - 50 <= reach and 50 + ahead - k <= reach]
    assert merged(graph_of(circle(140)), [50], [50 + ahead]) == sorted({50, *near, 50 + ahead})


@pytest.mark.parametrize("error", [[0.5, 0.0, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 2 * np.pi]])
def test_keyframes_near_strained_odometry_or_a_cut_are_not_merged(error):
    graph = graph_of(circle(100))
    graph.motion.rows[60] += error
    spared = set() if error[2] > np.pi else set(range(54, 66))  # both ends, and 5 more
    assert merged(graph, range(45, 76)) == sorted(set(range(45, 76)) - spared)
    graph.seam.rows[60] = True  # where no odometry joins them
    assert merged(graph, range(45, 76)) == list(range(45, 76))
    graph = graph_of(circle(100))
    graph.cut.rows[60] = 0
    assert merged(graph, range(45, 76)) == [*range(45, 59), *range(61, 76)]
    poses = circle(100)  # a turn near half a turn is not strained
    poses[[20, 60], 2] = wrap(poses[[19, 59], 2] + np.pi - 0.001)
    graph = graph_of(poses)
    graph.motion.rows[60, 2] = wrap(graph.motion.rows[60, 2] + 0.002)
    assert abs(graph.motion.rows[60, 2]) > 3.1
    assert merged(graph, range(45, 76)) == list(range(45, 76))


@pytest.mark.parametrize(
    ("aside", "turn", "met"),
    [(0.24, 0.0, True), (0.26, 0.0, False), (0.0, 0.24, True), (0.0, 0.28, False), (0.17, -0.25, True)],
)
def test_merged_keyframes_are_near_each_other_and_face_alike(aside, turn, met):
    far = np.array([50.0, 0.0, 0.0]) + line(30)[:, [1, 0, 2]]
    graph = graph_of(np.vstack([line(50), [STEP * 20, aside, turn], far]))
    graph.motion.rows[50:52] = between(graph.pose.rows[49:51], graph.pose.rows[50:52])
    assert merged(graph, [50]) == ([50] if met else [])


def test_keyframes_that_face_opposite_ways_are_merged_with_whiskers_only():
    there = line(50) + [0.0, 0.0, 0.05]
    poses, log = np.vstack([there, line(50)[::-1] + [0.0, 0.1, wrap(np.pi - 0.1)]]), log_of(range(65, 85))
    assert find_merge(with_log(graph_of(poses), log), NEWEST) is None
    merge = find_merge(with_log(graph_of(poses, Whiskers), log), NEWEST)
    assert np.flatnonzero(merge.turned()).tolist() == list(range(65, 85))
    assert merge.source[merge.onto[65:85]].tolist() == [99 - k for k in range(65, 85)]


@given(st.integers(0, 2**32 - 1), st.booleans(), st.integers(60, 160), st.integers(1, 40))
def test_a_merge_is_one_of_older_kept_keyframes_at_the_same_pose(seed, whiskers, count, newest):
    stream = np.random.default_rng(seed)
    centre = stream.uniform(0, 2, 2)
    poses = np.column_stack([centre + stream.uniform(0, 0.8, (count, 2)), stream.uniform(-9, 9, count)])
    poses[:, 2] = wrap(np.round(poses[:, 2]) + stream.normal(0, 0.05, count))
    graph = graph_of(poses, Whiskers if whiskers else LabelAppearance, merge_newest=newest)
    log = log_of(*np.split(np.arange(LAP, count), np.sort(stream.integers(0, count - LAP, 4))))
    merge = find_merge(with_log(graph, log), newest)
    if merge is None:
        return
    kept, onto, offset = merge.is_kept(), merge.source[merge.onto], merge.offset
    gone = np.flatnonzero(~kept)
    assert np.array_equal(merge.source, np.flatnonzero(kept))
    assert np.array_equal(onto[kept], merge.source)
    assert not offset[kept].any()
    assert GUARD < gone.min() <= gone.max() < count - newest
    assert (onto[gone] < gone - GUARD).all()
    assert np.hypot(*offset[gone, :2].T).max() <= NEAR * CELL
    turn = np.abs(offset[gone, 2])
    assert (turn <= FACING).sum() + whiskers * (turn >= np.pi - FACING).sum() == len(gone)
    assert np.array_equal(merge.turned()[gone], turn > 1)
    assert apart(compose(poses[onto], offset), poses) < 1e-12
    for frame in gone.tolist():  # with the best of those that it could be merged with
        older = merge.source[merge.source < frame - GUARD]
        off = np.abs(wrap(poses[older, 2] - poses[frame, 2]))
        off = np.minimum(off, np.pi - off) if whiskers else off
        far = ((poses[older] - poses[frame])[:, :2] ** 2).sum(axis=1) / (NEAR * CELL) ** 2
        cost = np.where((off <= FACING) & (far <= 1), far + (off / FACING) ** 2, np.inf)
        assert onto[frame] == older[np.argmin(cost)]


seeds = st.integers(0, 2**32 - 1)


def random_graph(stream, count, bias=0.0, turn_error=0.0, cuts=0):
    """A graph at random poses whose odometry shows these errors and no others."""
    position, heading = np.cumsum(stream.normal(0, 0.3, (count, 2)), axis=0), stream.normal(0, 2, count)
    poses = np.column_stack([position, wrap(heading)])
    true = between(poses[:-1], poses[1:])
    length = np.hypot(*true[:, :2].T) * stream.uniform(1, 1.2, count - 1)
    motion = np.vstack([np.zeros(3), miscalibrated(true, length, bias, turn_error)])
    graph = new_graph(CELL, GUARD)
    for k, (pose, moved) in enumerate(zip(poses, motion, strict=True)):
        add(graph, moved, pose, length[k - 1] if k else 0.0, abs(moved[2]) + 0.1)
    graph.cut.rows[stream.integers(1, count, cuts)] = 0
    graph.bias, graph.turn_error = bias, turn_error
    graph.prior = CalibrationPrior(bias, 0.1, turn_error, 0.1)
    return graph


def random_merge(stream, graph):
    """Merges keyframes other than the first, the newest and those at cuts with older ones that remain."""
    count, pose, cut = graph.count, graph.pose.rows, graph.cut.rows >= 0
    gone = (stream.random(count) < 0.5) & ~cut & ~np.append(cut[1:], True)
    gone[0] = False
    onto = np.arange(count)
    for frame in np.flatnonzero(gone):
        onto[frame] = stream.choice(np.flatnonzero(~gone[:frame]))
    offset = np.where(gone[:, None], between(pose[onto], pose), 0.0)
    return MergedRows(np.flatnonzero(~gone), (np.cumsum(~gone) - 1)[onto], offset)


def merge_all(graph, merge):
    archive_merge(merge, graph, graph.archive)
    merge_keyframes(graph, merge)


@given(seeds, st.integers(2, 30), st.integers(0, 2))
def test_poses_stay_the_archive_follows_and_exact_odometry_remains_exact(seed, count, cuts):
    stream = np.random.default_rng(seed)
    graph = random_graph(stream, count, cuts=cuts)
    before, number = graph.pose.rows.copy(), np.arange(count)
    length, turn = graph.length.rows.sum(), graph.turn.rows.sum()
    for _ in range(3):
        merge = random_merge(stream, graph)
        number = number[merge.source]
        merge_all(graph, merge)
        assert np.array_equal(graph.taken.rows, number)
        assert np.array_equal(graph.pose.rows, before[number])
        assert apart(graph.unmerged_poses(), before) < 1e-9
        assert np.array_equal(graph.archive.row.rows[number], np.arange(graph.count))
        ends = graph.pose.rows[np.stack([graph.links.i, graph.links.j])]
        assert apart(between(*ends), graph.links.motion) < 1e-9
        assert System(with_log(graph, ClosureLog(), graph.cut).problem()).robust_cost(graph.fit()) < 1e-9
        assert apart(graph.dead_reckoned(), graph.pose.rows.copy()) < 1e-9
        assert graph.length.rows.sum() == pytest.approx(length)
        assert graph.turn.rows.sum() == pytest.approx(turn)


@given(seeds, st.integers(4, 40), st.integers(0, 3))
def test_links_join_what_odometry_joined(seed, count, cuts):
    stream = np.random.default_rng(seed)
    graph = random_graph(stream, count, cuts=cuts)
    merge = random_merge(stream, graph)
    whole = graph.cut.rows < 0
    ends = {(int(merge.onto[k - 1]), int(merge.onto[k])) for k in range(1, count) if whole[k]}
    merge_all(graph, merge)
    chain = {(k - 1, k) for k in range(1, graph.count) if graph.cut.rows[k] < 0 and not graph.seam.rows[k]}
    links = set(zip(graph.links.i.tolist(), graph.links.j.tolist(), strict=True))
    assert chain | links == {(min(a, b), max(a, b)) for a, b in ends if a != b}
    assert all(a < b for a, b in links)
    loose = graph.variances()[1:, 0] > 1e3
    assert np.array_equal(loose, graph.seam.rows[1:] | (graph.cut.rows[1:] >= 0))


NO_OFFSET = np.zeros((5, 3))


def there_and_back(stream, bias=0.0, turn_error=0.0, noise=0.01, turn=0.2):
    """Keyframes a b a b, each pass with its own noise, and one more; those seen again are merged with the
    first ones. The second pass is driven in reverse: from b to a."""
    ends = np.array([[0.0, 0.0, 0.3], [0.2, 0.05, 0.3 + turn]])
    poses = np.vstack([ends[[0, 1, 0, 1]], [[0.5, 0.5, 1.0]]])
    true = between(poses[:-1], poses[1:])
    length = np.hypot(*true[:, :2].T) + 0.05
    motion = miscalibrated(true, length, bias, turn_error) + stream.normal(0, noise, (4, 3))
    graph = new_graph(CELL, GUARD)
    for k, pose in enumerate(poses):
        moved = motion[k - 1] if k else np.zeros(3)
        add(graph, moved, pose, length[k - 1] if k else 0.0, abs(moved[2]) * (1 + 0.5 * k))
    graph.bias, graph.turn_error = bias, turn_error
    return graph, MergedRows(np.array([0, 1, 4]), np.array([0, 1, 0, 1, 2]), NO_OFFSET)


def third_with_first(offset=NO_OFFSET):
    return MergedRows(np.array([0, 1, 3, 4]), np.array([0, 1, 0, 2, 3]), offset)


@given(seeds, st.floats(0.5, 4.0), st.sampled_from([0.2, np.pi - 0.002]))
def test_parallel_links_are_fused_by_their_information(seed, factor, turn):
    graph, merge = there_and_back(np.random.default_rng(seed), turn=turn)
    graph.heading_noise = HeadingNoise(float(np.log(factor)))
    plain = graph.own_variances()
    assert np.allclose(plain * [1, 1, factor], graph.variances())
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
    used = with_log(graph, ClosureLog(), graph.cut).problem().links
    assert np.allclose(used.variance, links.variance * [1, 1, factor])


def test_links_of_two_merges_are_fused_as_if_merged_at_once():
    both, merge = there_and_back(np.random.default_rng(0))
    stepwise, _ = there_and_back(np.random.default_rng(0))
    merge_keyframes(both, merge)
    merge_keyframes(stepwise, third_with_first())
    assert stepwise.seam.rows.tolist() == [False, False, True, False]
    merge_keyframes(stepwise, MergedRows(np.array([0, 1, 3]), np.array([0, 1, 1, 2]), np.zeros((4, 3))))
    for name in ("i", "j", "motion", "length", "turn", "variance"):
        assert np.allclose(getattr(both.links, name), getattr(stepwise.links, name)), name
    assert both.links.variance[1, 0] > (ATTACHED * CELL) ** 2


@given(seeds, st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.booleans())
def test_links_are_corrected_like_the_odometry_they_are_made_of(seed, bias, turn_error, turned):
    """Up to the bend of the offset, which is short."""
    stream = np.random.default_rng(seed)
    graph = random_graph(stream, 5, bias, turn_error)
    moved, length = graph.motion.rows.copy(), graph.length.rows.copy()
    offset = np.zeros((5, 3))
    offset[2] = [*stream.uniform(-0.05, 0.05, 2), stream.normal(0, 0.2) + np.pi * turned]
    merge_keyframes(graph, third_with_first(offset))
    assert list(zip(graph.links.i.tolist(), graph.links.j.tolist(), strict=True)) == [(0, 1), (0, 2)]
    into, onwards = correct_heading(moved[2:4], length[2:4], bias, turn_error)
    expected = [inverse(compose(into, inverse(offset[2]))), compose(offset[2], onwards)]
    bend = np.abs(bias * length[2:4] + turn_error * moved[2:4, 2])
    found = apart(graph.fit().corrected_links(graph.links), np.array(expected))
    assert found <= bend.max() * np.hypot(*offset[2, :2]) + 1e-12
    if not bend.max() < 1e-3:
        raw = np.stack([inverse(compose(moved[2], inverse(offset[2]))), compose(offset[2], moved[3])])
        assert found < apart(raw, np.array(expected))  # and not as if it were not corrected
    # The only pass over the link is that from b to a.
    graph, _ = there_and_back(np.random.default_rng(seed), bias, turn_error)
    motion, length = graph.motion.rows[2].copy(), graph.length.rows[2]
    graph.cut.rows[3] = 0  # and so not the one from a to b
    merge_keyframes(graph, third_with_first())
    driven = correct_heading(motion, length, bias, turn_error)
    assert (graph.links.i.tolist(), graph.links.j.tolist()) == ([0], [1])
    assert apart(graph.fit().corrected_links(graph.links), inverse(driven)[None]) < 1e-12


def test_merged_odometry_still_shows_the_calibration():
    bias, turn_error, count, again = 0.05, -0.02, 60, 20
    graph, log = random_graph(np.random.default_rng(3), count, bias, turn_error), ClosureLog()
    for k, pose in enumerate(graph.pose.rows[:again].copy()):  # once more over the first keyframes
        true = between(graph.pose.rows[-1], pose)
        length = np.hypot(*true[:2])
        motion = miscalibrated(true[None], np.array([length]), bias, turn_error)[0]
        add(graph, motion, pose, float(length))
        log.add(Candidate(count + k, k, 0, 1.0, 9.0), k > 0)
    log.judge(0, Verdict.ACCEPTED)
    frames = np.arange(count + again)
    gone = (frames > count) & (frames < frames[-1] - 4)
    onto = (np.cumsum(~gone) - 1)[np.where(gone, frames - count, frames)]
    merge = MergedRows(np.flatnonzero(~gone), onto, np.zeros((len(frames), 3)))
    graph.prior, graph.bias, graph.turn_error = CalibrationPrior(0.0, 1.0, 0.0, 1.0), 0.0, 0.0
    log.merge(gone, merge.onto, merge.turned())
    merge_keyframes(graph, merge)
    fit = with_log(graph, log).solve(50)
    assert (fit.bias, fit.turn_error) == pytest.approx((bias, turn_error), abs=2e-3)
