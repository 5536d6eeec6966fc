"""A session that begins a new piece of its map where the robot was carried, and knows it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from evaluation.metrics.run_metrics import energy_within_pieces
from ratslam.core.session import Session, Step
from ratslam.mapping.keyframe_graph import APART
from ratslam.mapping.pose_graph import read_json
from tactile.base.types import Observation
from tests.helpers.g2o import read_g2o
from tests.ratslam.runs.touch_walks import (
    WIDE,
    Walk,
    empty_merging_session,
    empty_session,
    follow,
    kidnap,
    metric,
    simulate_walk,
    true_share,
)

CARRIED = 240
"""Step before which the robot is carried: not the start of a chunk of the session, nor of a keyframe's."""
LEARNED = CARRIED + 16
"""Step at which the odds of the first piece are learned and the second one is not tied to it yet."""


@cache
def carried(seed: int = 4) -> Walk:
    return kidnap(simulate_walk(seed, maze=WIDE), CARRIED, 45)


def replay(session: Session, readings: Sequence[Observation], begin: int = CARRIED) -> list[Step]:
    steps = list(session.replay(readings[:begin]))
    session.begin_piece()
    return [*steps, *session.replay(readings[begin:])]


@cache
def replayed() -> tuple[list[Step], dict[str, np.ndarray]]:
    session = empty_session()
    steps = replay(session, carried().readings)
    return steps, session.arrays()


@cache
def begun() -> tuple[list[Step], dict[str, np.ndarray]]:
    """The steps of a replay of `carried` to some steps after the beginning of the piece, and the session."""
    session = empty_session()
    steps = replay(session, carried().readings[: CARRIED + 12])
    return steps, session.arrays()


def begun_session() -> Session:
    _, arrays = begun()
    session = empty_session()
    session.restore(arrays)
    return session


def same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    assert one.keys() == other.keys()
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in one)


def test_a_new_piece_lies_apart_until_closures_join_it() -> None:
    walk, session = carried(), begun_session()
    pieces = session.map.pieces()
    assert pieces.tolist() == [0] * CARRIED + [1] * 12
    path = session.map.trajectory()
    apart = np.hypot(*(path[:CARRIED, None, :2] - path[None, CARRIED:, :2]).transpose(2, 0, 1))
    assert apart.min() > APART / 2 * session.map.cell
    assert not any(piece[0] != piece[1] for piece in pieces[session.map.closures()])
    follow(session, walk.readings[CARRIED + 12 :])
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
    steps, _ = replayed()
    first = next(step for step in steps[CARRIED:] if int(step.evidence.keyframe) >= 0)
    assert first is steps[CARRIED]  # the next view becomes a keyframe
    assert float(first.evidence.novelty) > 0.5
    assert int(first.estimate.previous) == -1


@pytest.mark.soak
def test_live_gives_the_bits_of_a_replay() -> None:
    expected, whole = replayed()
    walk, session = carried(), empty_session()
    for k, reading in enumerate(walk.readings):
        if k == CARRIED:
            session.begin_piece()
        assert np.array_equal(session.step(reading).pose, expected[k].pose), k
    assert same(session.arrays(), whole)


@pytest.mark.parametrize(
    "stop",
    [
        pytest.param(CARRIED, marks=pytest.mark.soak),
        pytest.param(CARRIED + 5, marks=pytest.mark.soak),
        LEARNED,
        pytest.param(CARRIED + 60, marks=pytest.mark.soak),
    ],
)
def test_a_checkpoint_continues_as_the_uninterrupted_session(stop: int) -> None:
    _, whole = replayed()
    walk, session = carried(), empty_session()
    replay(session, walk.readings[:stop])
    saved = session.arrays()
    session = empty_session()
    session.restore(saved)
    list(session.replay(walk.readings[stop:]))
    assert same(session.arrays(), whole)


@pytest.mark.soak
@pytest.mark.parametrize("stop", [LEARNED + 1, CARRIED + 60])
def test_a_piece_that_stays_untied_continues_from_a_checkpoint(stop: int) -> None:
    first, other = carried(), simulate_walk(5, maze=WIDE | {"seed": 31002})
    readings = [*first.readings[:CARRIED], *other.readings[:100]]
    whole = empty_session()
    replay(whole, readings)
    assert np.unique(whole.map.pieces()).tolist() == [0, 1]
    assert len(whole.arrays()["map/tie_odds/ground"]) == 1
    expected, path = whole.arrays(), whole.map.trajectory()
    session = empty_session()
    replay(session, readings[:stop])
    saved = session.arrays()
    session = empty_session()
    session.restore(saved)
    list(session.replay(readings[stop:]))
    assert same(session.arrays(), expected)
    assert np.array_equal(session.map.trajectory(), path)


def test_no_link_leads_from_one_piece_to_the_next() -> None:
    session, (steps, _) = begun_session(), begun()
    graph = session.map.graph()
    before = {int(step.estimate.place) for step in steps[:CARRIED]}
    after = {int(step.estimate.place) for step in steps[CARRIED:]}
    assert before.isdisjoint(after)
    assert not [edge for edge in graph.edges if (edge[0] in before) != (edge[1] in before)]
    edges, first = session.map.edges(), int(session.map.arrays()["graph/begins"].argmax())
    assert not ((edges.i < first) != (edges.j < first)).any()


@pytest.mark.soak
def test_a_piece_of_a_map_that_merges_keyframes_is_joined_and_merged() -> None:
    walk, session = carried(), empty_merging_session(2)
    replay(session, walk.readings)
    arrays = session.arrays()
    assert arrays["map/graph/begins"].sum() == 1
    assert len(arrays["map/graph/taken"]) < len(arrays["map/archive/graph/taken"])
    assert not session.map.pieces().any()
    assert metric(session.map.trajectory(), walk.truth) < 0.1


def test_files_of_the_map_know_its_pieces(tmp_path: Path) -> None:
    session = begun_session()
    for name, write in session.map.files().items():
        write(tmp_path / name)
    nodes = read_json(tmp_path / "map.json").nodes
    pieces = [nodes[k]["piece"] for k in range(len(nodes))]
    assert sorted(set(pieces)) == [0, 1]
    assert pieces == sorted(pieces)
    first = int(session.arrays()["map/graph/begins"].argmax())
    text = (tmp_path / "map.g2o").read_text()
    assert [line for line in text.splitlines() if line.startswith("FIX")] == ["FIX 0", f"FIX {first}"]
    _, edges = read_g2o(tmp_path / "map.g2o")
    assert len(edges.i)
    assert not ((edges.i < first) != (edges.j < first)).any()
