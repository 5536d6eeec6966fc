"""Touch maps of a robot that was carried: the odometry is cut there, only if it may be."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tests.ratslam.runs.touch_walks import (
    WIDE,
    MappedWalk,
    Walk,
    dead_reckoning,
    empty_carried_session,
    empty_merging_session,
    empty_session,
    follow,
    kidnap,
    metric,
    simulate_walk,
    true_share,
)


@pytest.mark.parametrize(
    ("seeds", "least"), [(range(2, 5), (2, 3)), pytest.param(range(8), (5, 7), marks=pytest.mark.soak)]
)
def test_the_odometry_is_cut_where_the_robot_was_kidnapped(seeds: range, least: tuple[int, int]) -> None:
    """In so many sessions at least, the cut is near and the map right."""
    found = []
    for seed in seeds:
        walk = kidnap(simulate_walk(seed, maze=WIDE), 240, 45)
        found_map = follow(empty_carried_session(), walk.readings)
        assert true_share(found_map, walk.truth) >= 0.95
        near = len(found_map.cuts) == 1 and abs(found_map.cuts[0] - 240) <= 5
        right = metric(found_map.path, walk.truth) < 0.25 * metric(dead_reckoning(walk.readings), walk.truth)
        found.append([near, right])
    assert (np.sum(found, axis=0) >= least).all()


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.soak)])
def test_the_odometry_of_a_robot_that_is_never_carried_is_not_cut(seed: int) -> None:
    session = empty_session()
    walk = kidnap(simulate_walk(seed, maze=WIDE), 240, 45)
    for start in range(0, len(walk.readings), 50):
        assert follow(session, walk.readings[start : start + 50]).cuts == []
        assert (session.map.arrays()["graph/cut"] == -1).all()
        assert not session.map.pieces().any()


@cache
def kidnapped() -> Walk:
    return kidnap(simulate_walk(4, maze=WIDE), 240, 45)


@cache
def uninterrupted() -> tuple[MappedWalk, dict[str, np.ndarray]]:
    """The map of the whole walk, and the arrays of its session."""
    session = empty_carried_session()
    return follow(session, kidnapped().readings), session.arrays()


@pytest.mark.soak
@pytest.mark.parametrize("every", [41, 7])
def test_reading_the_map_does_not_change_it(every: int) -> None:
    walk = kidnapped()
    expected, saved = uninterrupted()
    session = empty_carried_session()
    for start in range(0, len(walk.readings), every):
        list(session.replay(walk.readings[start : start + every]))
        session.map.trajectory()
        session.map.closures()
        session.map.graph()
        session.map.edges()
    found = follow(session, [])
    assert np.array_equal(found.path, expected.path)
    assert np.array_equal(found.closures, expected.closures)
    again = session.arrays()
    assert again.keys() == saved.keys()
    assert all(np.array_equal(again[name], saved[name], equal_nan=True) for name in saved)


@pytest.mark.soak
def test_a_map_with_merged_keyframes_is_the_same_whichever_part_is_read_first() -> None:
    walk = kidnapped()
    session = empty_merging_session(1, may_be_carried=True)
    found = follow(session, walk.readings)
    made = session.map
    taken, whole, kept = made.kept_keyframes().taken.rows, made.solution(), made.kept_solution()
    assert len(taken) < made.keyframes().count
    assert found.cuts
    assert np.array_equal(kept.fit.poses, whole.fit.poses[taken])
    assert np.array_equal(kept.cut.rows, whole.cut.rows[taken])
    session.restore(session.arrays())
    again = made.kept_solution(), made.solution()
    for one, other in zip((kept, whole), again, strict=True):
        assert np.array_equal(one.fit.poses, other.fit.poses)
        assert np.array_equal(one.cut.rows, other.cut.rows)


@pytest.mark.parametrize(
    "stop", [*(pytest.param(stop, marks=pytest.mark.soak) for stop in (250, 300, 320)), 330]
)
def test_a_restored_map_with_cuts_continues_as_the_uninterrupted_one(stop: int) -> None:
    walk = kidnapped()
    expected, whole = uninterrupted()
    assert expected.cuts
    session = empty_carried_session()
    follow(session, walk.readings[:stop])
    saved = session.arrays()
    assert (saved["map/graph/cut"] >= 0).any() == (stop > 320)
    session = empty_carried_session()
    follow(session, walk.readings[:50])
    session.restore(saved)
    found = follow(session, walk.readings[stop:])
    assert np.array_equal(found.path, expected.path)
    assert found.cuts == expected.cuts
    again = session.arrays()
    assert all(np.array_equal(again[name], whole[name], equal_nan=True) for name in whole)
