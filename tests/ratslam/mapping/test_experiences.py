"""Laws of experiences as groups of keyframes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.core.estimates import Action
from ratslam.mapping.experiences import Experiences
from tactile.base.se2 import between, compose, wrap

RADIUS, HEADING = 1.0, 0.5


def walk(*frames, world=None):
    """Folds frames (x, y, heading, matched, sure); returns experiences, changes and poses."""
    world = world or Experiences(RADIUS, HEADING)
    poses = np.array([frame[:3] for frame in frames], float)
    return world, [world.arrive(poses[: k + 1], k, *frames[k][3:]) for k in range(len(frames))], poses


def at(x, y=0.0, heading=0.0, matched=-1, sure=False):
    return (x, y, heading, matched, sure)


@pytest.mark.parametrize(
    ("to", "stays"),
    [
        (at(0.9), True),
        (at(1.1), False),
        (at(0, 0.9), True),
        (at(0, 0, 0.4), True),
        (at(0, 0, -0.6), False),
        (at(0.8, 0, 0.4), False),  # each deviation alone is within reach, both together are not
    ],
)
@pytest.mark.parametrize("facing", [0.0, 3.0, -3.1])  # also across the wrap of angles
def test_an_experience_reaches_as_far_as_its_radius(to, stays, facing):
    there = (*to[:2], wrap(to[2] + facing), *to[3:])
    assert Experiences(RADIUS, HEADING).current == -1
    world, changes, _ = walk(at(0, 0, facing), there)
    assert changes[0] == (0, -1, Action.CREATE)
    assert world.current == changes[1][0]
    assert changes[1] == ((0, 0, Action.NONE) if stays else (1, 0, Action.CREATE))


NONE, CREATE, LINK, SET = Action.NONE, Action.CREATE, Action.LINK, Action.SET
THREE = [at(0), at(5), at(10)]


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


frames = st.lists(
    st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3), st.integers(-30, 39), st.booleans()),
    min_size=1,
    max_size=40,
)


@given(frames, st.integers(0, 39))
def test_the_graph_follows_from_the_changes(steps, cut):
    steps = [(*s[:3], s[3] if s[3] < k else -1, s[4]) for k, s in enumerate(steps)]
    steps = [(*s[:3], max(s[3], -1), s[4]) for s in steps]
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
        reached = Action.NONE if place == before else Action.SET if known else Action.LINK
        assert action == (Action.CREATE if created else reached)
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
    stands = [np.array([node["x"], node["y"], node["heading"]]) for node in graph.nodes.values()]
    np.testing.assert_allclose(stands, moved[made], rtol=0, atol=1e-12)
    for a, b, way in graph.edges(data=True):
        gap = compose(stands[a], np.array([way["dx"], way["dy"], way["dtheta"]])) - stands[b]
        assert np.allclose([*gap[:2], wrap(gap[2])], 0, atol=1e-9)

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
    offset = between(poses[kept[onto]], poses)
    world.merge(kept, onto, offset)
    after = world.graph(poses[kept], kept, np.zeros(len(kept), int))
    assert len(after) == len(before) == 4
    for place in before:
        for key in ("x", "y", "heading"):
            assert after.nodes[place][key] == pytest.approx(before.nodes[place][key], abs=1e-12)
    # The robot comes back the other way and finds the experience, not the one of its merged frame.
    assert world.arrive(np.vstack([poses[kept], poses[2]]), 2, -1, True)[0] == 2
