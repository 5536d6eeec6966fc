"""Pieces of a map: where they lie, what joins and what parts them; experiences: groups of keyframes."""

import networkx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.core.backend import NO_CLOSURE
from ratslam.core.estimates import Action
from ratslam.mapping.acceptance import AcceptByEvidence, AcceptByOdds
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.experiences import Experiences
from ratslam.mapping.loop_closures import Candidate
from ratslam.mapping.map_solution import DOUBTED
from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.mapping.pieces import APART, number_pieces, piece_start, placed_pieces
from tactile.base.se2 import between, compose, wrap
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, STEP, drive, new_map, sequence, with_log
from tests.ratslam.mapping.optimizer_cases import apart as poses_apart


@st.composite
def cuts_and_closures(draw):
    """Cuts [N] and closures [M, 2]."""
    count = draw(st.integers(1, 30))
    frame = st.integers(0, count - 1)
    cut = np.array([False, *draw(st.lists(st.booleans(), min_size=count - 1, max_size=count - 1))])
    closures = draw(st.lists(st.tuples(frame, frame), max_size=12))
    return cut, np.array(closures, int).reshape(-1, 2)


@given(cuts_and_closures())
def test_pieces_are_the_connected_components_in_order(found):
    cut, closures = found
    assert number_pieces(cut[:0], closures[:0]).tolist() == []
    graph = networkx.Graph()
    graph.add_nodes_from(range(len(cut)))
    graph.add_edges_from((k - 1, k) for k in np.flatnonzero(~cut).tolist() if k)
    graph.add_edges_from(closures.tolist())
    piece = number_pieces(cut, closures)
    components = sorted(networkx.connected_components(graph), key=min)
    assert [set(np.flatnonzero(piece == k).tolist()) for k in range(len(components))] == components


SMALL = 0.2


@st.composite
def maps(draw):
    """Poses [N, 3] of stretches that lie apart, and the closures between them, each true at one place."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lengths = draw(st.lists(st.integers(1, 6), min_size=1, max_size=6))
    stretch, count = np.repeat(np.arange(len(lengths)), lengths), sum(lengths)
    truth = random.normal(0, 2, (count, 3))
    starts, first = np.array([piece_start(k, SMALL) for k in stretch]), np.searchsorted(stretch, stretch)
    poses, begins = compose(starts, between(truth[first], truth)), np.diff(stretch, prepend=0) > 0
    pairs = draw(st.lists(st.tuples(st.integers(0, count - 1), st.integers(0, count - 1)), max_size=5))
    i, j = np.array(pairs, int).reshape(-1, 2).T
    return poses, (begins, i, j, random.uniform(-np.pi, np.pi, len(i)))


@given(maps(), st.integers(0, 2**32 - 1))
def test_pieces_keep_their_shape_and_lie_apart_unless_a_closure_brings_them_to_where_it_claims(found, seed):
    poses, joints = found
    placed, stretch = placed_pieces(poses, *joints, SMALL), np.cumsum(joints[0])
    first = np.searchsorted(stretch, stretch)  # of the stretch of each keyframe
    assert poses_apart(between(placed[first], placed), between(poses[first], poses)) < 1e-9
    piece = number_pieces(joints[0], np.column_stack([joints[2], joints[1]]))
    for number in np.unique(piece):
        at = np.flatnonzero(piece == number)[0]
        assert np.allclose(placed[at], piece_start(int(stretch[at]), SMALL) if number else poses[0])
    apart = np.hypot(*(placed[:, None, :2] - placed[None, :, :2]).transpose(2, 0, 1))
    assert (apart[piece[:, None] != piece] > APART / 2 * SMALL).all()
    assert np.abs(placed_pieces(placed, *joints, SMALL) - placed).max() < 1e-9
    random, none = np.random.default_rng(seed), np.zeros(0, int)
    i, j = random.integers(len(poses), size=(2, 1))
    turn = random.uniform(-3, 3, 1)
    placed = placed_pieces(poses, joints[0], i, j, turn, SMALL)
    if stretch[i] != stretch[j]:
        assert poses_apart(placed[j], placed[i] + [0.0, 0.0, turn[0]]) < 1e-9
    # A map without beginnings is left as it is.
    assert placed_pieces(poses, np.zeros(len(poses), bool), none, none, np.zeros(0), SMALL) is poses


RULES, NOTHING = pytest.mark.parametrize("rule", [lambda *_: AcceptByEvidence(), AcceptByOdds]), {}
TIE = [Candidate(LAP + k, k, 0, 1.0, 4.0) for k in range(2, 14)]


def driven(rule, recalled=NOTHING, find_tie=None, last=LAP + 60):
    """A lap and a part of the next one, which begins a piece."""
    map = drive(new_map(rule, find_tie=find_tie), {}, last=LAP)
    map.begin_piece()
    return drive(map, recalled, first=LAP, last=last)


def apart(map, place):
    """Distance between a keyframe of the first lap and that of the same place in the second one, cells."""
    pose = map.solution().pose.rows
    return np.hypot(*(pose[LAP + place] - pose[place])[:2]) / CELL


def assert_apart(map):
    assert np.array_equal(map.pieces(), np.arange(LAP + 60) >= LAP)
    assert apart(map, 8) > APART / 2


@RULES
def test_a_tie_joins_two_pieces_until_it_is_undone_and_no_sequence_of_recall_does(rule):
    # The tie of the second lap to the first is there once the views that show it are.
    map = driven(rule, find_tie=lambda graph, odds: (20.0, TIE) if graph.total > LAP + 14 else None)
    assert map.final_doubt() < DOUBTED
    assert not map.pieces().any()
    assert len(map.closures()) == len(TIE)
    assert apart(map, 8) < 1
    assert apart(map, 50) < 2
    map.undo(0)
    assert_apart(map)
    strong = sequence(LAP + 2, 2, 40, 5.0)
    assert len(drive(new_map(rule), strong).closures()) == 40
    map = driven(rule, strong)
    assert len(map.closures()) == 0
    assert_apart(map)


@RULES
@pytest.mark.parametrize("stands", [False, True])
def test_a_tie_is_undone_below_half_the_log_odds_that_it_needs(rule, stands):
    later = 0.5 * KeyframeMapConfig().tie_log_odds + (0.1 if stands else -0.1)

    def tie_once(graph, odds):
        return (20.0 if graph.total < LAP + 40 else later, TIE) if graph.total > LAP + 14 else None

    assert not driven(rule, find_tie=tie_once, last=LAP + 38).pieces().any()
    map = driven(rule, find_tie=tie_once)
    assert np.array_equal(map.pieces(), (np.arange(LAP + 60) >= LAP) & (not stands))
    assert (len(map.closures()) > 0) == stands


@RULES
def test_odometry_of_a_piece_does_not_count_before_it(rule):
    map = driven(rule)
    reckoned = map.state.unmerged.dead_reckoned()
    assert np.allclose(reckoned[LAP], (APART * CELL, 0.0, 0.0))
    assert np.allclose(map.trajectory(), reckoned)
    assert map.covariance()[0, 0] < CELL**2 * 100  # of the newest keyframe from the first of its piece


@RULES
@pytest.mark.parametrize("begin", [40, None])
def test_a_piece_without_an_accepted_closure_is_its_odometry(rule, begin):
    """To the bit where the map begins with it; also where the views show another bias."""
    map = drive(new_map(rule), {}, last=40)
    if begin:
        map.begin_piece()
    with_log(map.state, map.state.log).adopt_prior(CalibrationPrior(0.3, 0.01))
    drive(map, {}, first=40, last=80)
    odometry = np.zeros((80, 3))
    for k in range(79):
        odometry[k + 1] = compose(odometry[k], np.array([STEP, 0.0, 2 * np.pi / LAP - BIAS * STEP]))
    for found in (map.trajectory(), map.map_trajectory(), map.online_trajectory()):
        assert np.array_equal(found[:begin], odometry[:begin])
        assert np.allclose(between(found[40], found[40:]), between(odometry[40], odometry[40:]))
    assert np.isnan([map.doubt(), map.final_doubt()]).all()
    assert (map.unjudged(), "calibration.yaml" in map.files()) == (NO_CLOSURE, False)
    ends, poses = map.edges(), map.kept_solution().pose.rows
    assert np.allclose(between(poses[ends.i], poses[ends.j]), ends.motion)


def test_the_kernel_is_told_where_the_next_piece_starts():
    map = new_map()
    map.begin_piece()  # a map without keyframes begins with its first one
    assert map.feedback().start is None
    assert not drive(map, {}, last=30).pieces().any()
    map.begin_piece()
    assert np.array_equal(map.feedback().start, (APART * CELL, 0.0, 0.0))
    drive(map, {}, first=30, last=31)
    assert map.feedback().start is None
    assert np.array_equal(map.feedback().poses[-1], (APART * CELL, 0.0, 0.0))


RADIUS, HEADING = 1.0, 0.5


def walk(*frames):
    """Folds frames (x, y, heading, matched, sure); returns experiences, changes and poses."""
    world, poses = Experiences(RADIUS, HEADING), np.array([frame[:3] for frame in frames], float)
    return world, [world.arrive(poses[: k + 1], k, *frames[k][3:]) for k in range(len(frames))], poses


NONE, CREATE, LINK, SET = Action.NONE, Action.CREATE, Action.LINK, Action.SET


def at(x, y=0.0, heading=0.0, matched=-1, sure=False):
    return (x, y, heading, matched, sure)


THREE = [at(0), at(5), at(10)]
STAYS = [at(0.9), at(0, 0.9), at(0, 0, 0.4)]
LEAVES = [at(1.1), at(0, 0, -0.6), at(0.8, 0, 0.4)]
"""The last: each deviation alone is within reach, both together are not."""


@pytest.mark.parametrize(("to", "stays"), [(to, to in STAYS) for to in STAYS + LEAVES])
@pytest.mark.parametrize("facing", [0.0, 3.0, -3.1])  # also across the wrap of angles
def test_an_experience_reaches_as_far_as_its_radius(to, stays, facing):
    there = (*to[:2], wrap(to[2] + facing), *to[3:])
    assert Experiences(RADIUS, HEADING).current == -1
    world, changes, _ = walk(at(0, 0, facing), there)
    assert changes[0] == (0, -1, CREATE)
    assert world.current == changes[1][0]
    assert changes[1] == ((0, 0, NONE) if stays else (1, 0, CREATE))


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        # A matched frame reaches its experience at any distance: by the link from 1 to 2, backwards.
        ([*THREE, at(15.2, matched=1)], [(1, 2, SET)]),
        ([*THREE, at(15.2, matched=1), at(20), at(15, matched=1)], [(3, 1, CREATE), (1, 3, SET)]),
        ([at(0), at(0.5), at(5), at(10), at(0, matched=1)], [(1, 0, CREATE), (2, 1, CREATE), (0, 2, LINK)]),
        # The radius is around the first frame.
        ([at(0), at(0.7), at(1.4)], [(0, -1, CREATE), (0, 0, NONE), (1, 0, CREATE)]),
        # A new connection is a link, and later a set.
        ([*THREE, at(0, matched=0), at(10, matched=2)], [(0, 2, LINK), (2, 0, SET)]),
        ([*THREE, at(0, matched=0), at(10, matched=2), at(0, matched=0)], [(2, 0, SET), (0, 2, SET)]),
        ([*THREE, at(0, matched=0), at(0.1, matched=0)], [(0, 2, LINK), (0, 0, NONE)]),
        # Only a reliable pose finds known experiences.
        ([*THREE, at(0.9, sure=True)], [(0, 2, LINK)]),
        ([*THREE, at(0.9)], [(3, 2, CREATE)]),
        ([*THREE, at(1.1, sure=True)], [(3, 2, CREATE)]),
        # The nearest experience, unless the current one is in reach.
        ([at(0), at(1.5), at(8), at(0.9, sure=True)], [(1, 2, SET)]),
        ([at(0), at(1.5), at(0.7, sure=True), at(0.8, sure=True)], [(1, 1, NONE), (1, 1, NONE)]),
    ],
)  # fmt: skip
def test_frames_reach_known_experiences(frames, expected):
    _, changes, _ = walk(*frames)
    assert changes[-len(expected) :] == expected


coordinates = [st.floats(-3, 3)] * 3
frames = st.lists(st.tuples(*coordinates, st.integers(-30, 39), st.booleans()), min_size=1, max_size=40)


@given(frames, st.integers(0, 39))
def test_the_graph_follows_from_the_changes(steps, cut):
    steps = [(*s[:3], s[3] if 0 <= s[3] < k else -1, s[4]) for k, s in enumerate(steps)]
    cut = min(cut, len(steps) - 1)
    world, changes, poses = walk(*steps)
    made, ways, previous = [], {}, -1
    for frame, (place, before, action) in enumerate(changes):
        assert before == previous
        created = place == len(made)
        if created:
            made.append(frame)
        assert 0 <= place < len(made)
        known = (before, place) in ways or (place, before) in ways
        reached = NONE if place == before else SET if known else LINK
        assert action == (CREATE if created else reached)
        if steps[frame][3] >= 0:
            assert place == changes[steps[frame][3]][0]
        if place != before and before >= 0:
            ways[before, place] = ways.get((before, place), 0) + 1
        previous = place
    moved = poses + [1.0, 2.0, 0.0]  # the map is deformed after the frames were grouped
    graph = world.graph(moved, np.arange(len(moved)), np.zeros(len(moved), int))
    assert list(graph.nodes) == list(range(len(made)))
    assert [graph.nodes[place]["keyframe"] for place in graph] == made
    assert {(a, b): data["traversals"] for a, b, data in graph.edges(data=True)} == ways
    stands = np.array([[node["x"], node["y"], node["heading"]] for node in graph.nodes.values()])
    np.testing.assert_allclose(stands, moved[made], rtol=0, atol=1e-12)
    for a, b, way in graph.edges(data=True):
        reached = compose(stands[[a]], np.array([way["dx"], way["dy"], way["dtheta"]]))
        assert poses_apart(reached, stands[[b]]) < 1e-9

    half, _, _ = walk(*steps[: cut + 1])
    again, _, _ = walk(at(0), at(9))  # its state before is replaced
    again.restore(half.arrays())
    for k in range(cut + 1, len(steps)):
        assert again.arrive(poses[: k + 1], k, *steps[k][3:]) == changes[k]
    assert again.current == world.current
    assert all(np.array_equal(again.arrays()[name], rows) for name, rows in world.arrays().items())


def test_an_experience_keeps_its_pose_when_its_frame_is_merged_with_one_that_faces_back():
    world, _, poses = walk(at(0.0), at(5.0), at(5.02, 0.01, np.pi), at(0.0, 0.0, np.pi))
    poses = poses - [0.0, 0.0, 0.1]
    before = world.graph(poses, np.arange(4), np.zeros(4, int))
    kept, onto = np.array([0, 1]), np.array([0, 1, 1, 0])
    world.merge(kept, onto, between(poses[kept[onto]], poses))
    after = world.graph(poses[kept], kept, np.zeros(len(kept), int))
    assert len(after) == len(before) == 4
    for place in before:
        for key in ("x", "y", "heading"):
            assert after.nodes[place][key] == pytest.approx(before.nodes[place][key], abs=1e-12)
    # The robot comes back the other way and finds the experience, not the one of its merged frame.
    assert world.arrive(np.vstack([poses[kept], poses[2]]), 2, -1, True)[0] == 2
