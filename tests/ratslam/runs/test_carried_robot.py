"""Touch maps of a robot that was carried: the odometry is cut there if it may be, or a new piece begins."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from evaluation.metrics.run_metrics import energy_within_pieces
from ratslam.core.session import Session, Step
from ratslam.mapping.pieces import APART
from ratslam.mapping.pose_graph import read_json
from tactile.base.types import Observation
from tests.helpers.g2o import read_g2o
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
    same_arrays,
    simulate_walk,
    true_share,
)

CARRIED = 240
"""Step before which the robot is carried: not the start of a chunk of the session, nor of a keyframe's."""
SEED = 4
LEARNED = CARRIED + 16
"""Step at which the odds of the first piece are learned and the second one is not tied to it yet."""


@cache
def carried(seed: int) -> Walk:
    return kidnap(simulate_walk(seed, maze=WIDE), CARRIED, 45)


def replay(session: Session, readings: Sequence[Observation], begin: int = CARRIED) -> list[Step]:
    """Begins a piece there."""
    steps = list(session.replay(readings[:begin]))
    session.begin_piece()
    return [*steps, *session.replay(readings[begin:])]


@cache
def uninterrupted(seed: int) -> tuple[MappedWalk, dict[str, np.ndarray]]:
    """The map of the whole walk, and the arrays of its session."""
    session = empty_carried_session()
    return follow(session, carried(seed).readings), session.arrays()


@pytest.mark.parametrize(
    ("seeds", "least"), [(range(2, 5), (2, 3)), pytest.param(range(8), (5, 7), marks=pytest.mark.soak)]
)
def test_the_odometry_is_cut_where_the_robot_was_kidnapped(seeds: range, least: tuple[int, int]) -> None:
    """In so many sessions at least, the cut is near and the map right."""
    found = []
    for seed in seeds:
        walk = carried(seed)
        made, _ = uninterrupted(seed)
        assert true_share(made, walk.truth) >= 0.95
        near = len(made.cuts) == 1 and abs(made.cuts[0] - CARRIED) <= 5
        right = metric(made.path, walk.truth) < 0.25 * metric(dead_reckoning(walk.readings), walk.truth)
        found.append([near, right])
    assert (np.sum(found, axis=0) >= least).all()


@pytest.mark.soak
def test_a_carried_map_with_merged_keyframes_is_the_same_whichever_part_is_read_first() -> None:
    session = empty_merging_session(1, may_be_carried=True)
    assert follow(session, carried(SEED).readings).cuts
    made = session.map
    taken, whole, kept = made.state.taken.rows, made.solution(), made.kept_solution()
    assert len(taken) < made.state.unmerged.count
    session.restore(session.arrays())
    for part, rows in ((kept, taken), (made.kept_solution(), taken), (made.solution(), slice(None))):
        assert np.array_equal(part.pose.rows, whole.pose.rows[rows])
        assert np.array_equal(part.cut.rows, whole.cut.rows[rows])


@pytest.mark.parametrize(
    "stop", [330, *(pytest.param(stop, marks=pytest.mark.soak) for stop in (250, 300, 320))]
)
def test_a_restored_map_with_cuts_continues_as_the_uninterrupted_one(stop: int) -> None:
    readings, (expected, whole), session = (
        carried(SEED).readings,
        uninterrupted(SEED),
        empty_carried_session(),
    )
    follow(session, readings[:stop])
    saved = session.arrays()
    assert (saved["map/graph/cut"] >= 0).any() == (stop > 320)
    session = empty_carried_session()
    follow(session, readings[:50])
    session.restore(saved)
    found = follow(session, readings[stop:])
    assert np.array_equal(found.path, expected.path)
    assert found.cuts == expected.cuts != []
    assert same_arrays(session.arrays(), whole)


@cache
def replayed(steps: int = -1) -> tuple[list[Step], dict[str, np.ndarray]]:
    """The steps of a replay of `carried` with a piece begun, and the session."""
    session = empty_session()
    return replay(session, carried(SEED).readings[:steps]), session.arrays()


BEGUN = CARRIED + 12
"""Steps after which the second piece has begun and is not joined yet."""


def begun_session() -> Session:
    session = empty_session()
    session.restore(replayed(BEGUN)[1])
    return session


def test_a_new_piece_lies_apart_until_closures_join_it() -> None:
    walk, session = carried(SEED), begun_session()
    pieces = session.map.pieces()
    assert pieces.tolist() == [0] * CARRIED + [1] * 12
    path = session.map.trajectory()
    apart = np.hypot(*(path[:CARRIED, None, :2] - path[None, CARRIED:, :2]).transpose(2, 0, 1))
    assert apart.min() > APART / 2 * session.map.cell
    assert not any(piece[0] != piece[1] for piece in pieces[session.map.closures()])
    follow(session, walk.readings[BEGUN:])
    assert not session.map.pieces().any()
    assert metric(session.map.trajectory(), walk.truth) < 0.1


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.soak) for seed in (1, 2))])
def test_pieces_are_right_within(seed: int) -> None:
    walk, session = carried(seed), empty_session()
    replay(session, walk.readings)
    found = follow(session, [])
    assert true_share(found, walk.truth) > 0.95
    assert energy_within_pieces(found.path, walk.truth, session.map.pieces()).total < 0.1


def test_the_robot_is_unknown_where_a_piece_begins() -> None:
    first = replayed(BEGUN)[0][CARRIED]
    assert int(first.evidence.keyframe) >= 0  # the next view becomes a keyframe
    assert float(first.evidence.novelty) > 0.5
    assert int(first.estimate.previous) == -1


@pytest.mark.parametrize(
    "stop", [LEARNED, *(pytest.param(CARRIED + k, marks=pytest.mark.soak) for k in (0, 5, 60))]
)
def test_a_piece_continues_from_a_checkpoint_as_uninterrupted(stop: int) -> None:
    check_continued(carried(SEED).readings[:-1], stop, replayed()[1])


def check_continued(readings: Sequence[Observation], stop: int, expected: dict[str, np.ndarray]) -> Session:
    session = empty_session()
    replay(session, readings[:stop])
    saved = session.arrays()
    session = empty_session()
    session.restore(saved)
    list(session.replay(readings[stop:]))
    assert same_arrays(session.arrays(), expected)
    return session


@pytest.mark.soak
@pytest.mark.parametrize("stop", [LEARNED + 1, CARRIED + 60])
def test_a_piece_that_stays_untied_continues_from_a_checkpoint(stop: int) -> None:
    other, whole = simulate_walk(5, maze=WIDE | {"seed": 31002}), empty_session()
    readings = [*carried(SEED).readings[:CARRIED], *other.readings[:100]]
    replay(whole, readings)
    assert np.unique(whole.map.pieces()).tolist() == [0, 1]
    expected, path = whole.arrays(), whole.map.trajectory()
    assert len(expected["map/tie_odds/ground"]) == 1
    assert np.array_equal(check_continued(readings, stop, expected).map.trajectory(), path)


def test_no_link_leads_from_one_piece_to_the_next_and_files_know_both(tmp_path: Path) -> None:
    session, (steps, _) = begun_session(), replayed(BEGUN)
    graph, places = session.map.graph(), [int(step.estimate.place) for step in steps]
    before = {*places[:CARRIED]}
    assert before.isdisjoint(places[CARRIED:])
    assert not [edge for edge in graph.edges if (edge[0] in before) != (edge[1] in before)]
    for name, write in session.map.files().items():
        write(tmp_path / name)
    nodes = read_json(tmp_path / "map.json").nodes
    pieces = [nodes[k]["piece"] for k in range(len(nodes))]
    assert sorted(set(pieces)) == [0, 1]
    assert pieces == sorted(pieces)
    first = int(session.map.arrays()["graph/begins"].argmax())
    text = (tmp_path / "map.g2o").read_text()
    assert [line for line in text.splitlines() if line.startswith("FIX")] == ["FIX 0", f"FIX {first}"]
    for edges in (session.map.edges(), read_g2o(tmp_path / "map.g2o")[1]):
        assert len(edges.i)
        assert not ((edges.i < first) != (edges.j < first)).any()
