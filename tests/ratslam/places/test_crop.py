"""Cropped maps: what remains, where odometry is interrupted, and that the session goes on."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend, RecallState
from ratslam.places.crop import crop_map, keyframes_in_box, keyframes_of_piece, keyframes_of_steps
from ratslam.places.difference import difference, keyframe_content
from tactile.base.se2 import compose
from tests.ratslam.mapping.map_cases import CELL, LAP, STEP, drive, new_map
from tests.ratslam.mapping.merging_cases import Drive, circles
from tests.ratslam.recall.test_merged_rows import CAPACITY, COUNT, SIZE, TOUCH, random_memory

END = LAP + 60
ROUND, LAPS = 80, 4
"""Keyframes of a lap, and laps, of the merged map."""
MERGED = {"select_every": 30, "merge_stood": 2, "merge_newest": 60, "solve_every": 1}
TRUE = {k: (k - LAP, 4.0) for k in range(LAP, END)}
"""Recall of the first keyframes in the second lap."""


@cache
def driven(recalled: bool) -> dict[str, np.ndarray]:
    return drive(new_map(), TRUE if recalled else {}).arrays()


def restored(recalled: bool):
    map = new_map()
    map.restore(driven(recalled))
    return map


@pytest.fixture
def made():
    """A lap and 60 keyframes of the next one, joined by one sequence."""
    return restored(True)


def cropped(made, inside):
    before = made.trajectory()
    return crop_map(made, new_map(), inside), before


def test_a_crop_of_everything_changes_nothing(made) -> None:
    before, arrays = keyframe_content(made), made.arrays()
    rows, path = cropped(made, np.ones(END, bool))
    found = difference(before, keyframe_content(made))
    assert (found["common"], found["removed"], found["added"]) == (END, 0, 0)
    assert (found["closures_removed"], found["closures_added"]) == (0, 0)
    assert found["closures_common"] == len(made.closures()) > 40
    assert np.abs(made.trajectory() - path).max() < 1e-9
    assert made.arrays().keys() == arrays.keys()
    assert rows.left.all()
    np.testing.assert_array_equal(rows.rows.source, np.arange(END))
    assert (rows.length, rows.turn, *rows.motion) == (0, 0, 0, 0, 0)


def test_steps_keep_their_keyframes_closures_and_experiences(made) -> None:
    graph, steps = made.graph(), made.keyframe_steps()
    rows, path = cropped(made, keyframes_of_steps(made, 30, END))
    count = END - 30
    assert rows.rows.rows == count == made.state.count
    np.testing.assert_array_equal(made.keyframe_steps(), steps[:count])
    closures = made.closures()
    assert 0 < len(closures) <= 30
    assert closures.min() >= 0
    assert closures.max() < count
    np.testing.assert_array_equal(closures[:, 0] - closures[:, 1], LAP)
    assert len(np.unique(made.pieces())) == 1
    moved = np.hypot(*(made.trajectory() - path[30:])[:, :2].T)
    assert moved.max() < 0.1 * np.ptp(path[:, 0]), "solved without the first closures"
    after = made.graph()
    assert len(after) == len(graph), "the second lap saw the places of the keyframes that are gone"
    places = np.array([[node["x"], node["y"]] for node in after.nodes.values()])
    apart = np.hypot(*(places[:, None] - made.trajectory()[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
    assert apart.max() < 0.05 * STEP, "every experience lies on the way"
    assert all(data["traversals"] > 0 for *_, data in after.edges(data=True))


def test_where_keyframes_are_left_out_only_closures_join(made) -> None:
    unjoined = restored(False)
    for map, pieces in ((made, 1), (unjoined, 2)):
        ends, places = keyframes_of_steps(map, 0, 60) | keyframes_of_steps(map, LAP, END), len(map.graph())
        cropped(map, ends)
        assert 0 < len(map.graph()) < places
        assert len(map.trajectory()) == 120
        assert len(np.unique(map.pieces())) == pieces
    crop_map(unjoined, new_map(), keyframes_of_piece(unjoined, 1))
    assert len(unjoined.trajectory()) == 60
    assert len(np.unique(unjoined.pieces())) == 1


def test_a_box_keeps_what_lies_in_it(made) -> None:
    path = made.trajectory()
    middle = float(np.median(path[:, 0]))
    inside = keyframes_in_box(
        made, (path[:, 0].min() - 1, path[:, 1].min() - 1, middle, path[:, 1].max() + 1)
    )
    np.testing.assert_array_equal(inside, path[:, 0] <= middle)
    cropped(made, inside)
    assert len(made.trajectory()) == inside.sum()
    with pytest.raises(ValueError, match="no keyframe remains"):
        cropped(made, keyframes_of_steps(made, END, END + 5))


def test_the_robot_stays_where_it_was_and_drives_on(made) -> None:
    # Without noise and closures, odometry says where the robot is.
    alone = restored(False)
    pose = alone.pose(None)
    rows, _ = cropped(alone, keyframes_of_steps(alone, 0, 100))
    np.testing.assert_allclose(alone.pose(None), pose, atol=1e-9)
    newest = alone.trajectory()[-1]
    np.testing.assert_allclose(compose(newest, rows.motion), pose, atol=1e-9)
    assert rows.length == pytest.approx((END - 100) * STEP)
    cropped(made, keyframes_of_steps(made, 30, END))
    drive(made, {k: (k - LAP, 4.0) for k in range(END - 30, END)}, first=END - 30, last=END)
    assert len(made.trajectory()) == END
    assert len(made.closures()) > 30


@pytest.mark.parametrize("seed", range(2))
def test_the_memory_keeps_the_rows_that_remain_and_belief_in_others_is_novelty_at_once(seed: int) -> None:
    stream = np.random.default_rng(seed)
    memory, inside = random_memory(np.random.default_rng(seed), TOUCH), np.arange(COUNT) % 3 > 0
    rows = crop_map(drive(new_map(), {}, last=COUNT), new_map(), inside)
    view, count, kept = np.asarray(memory.view).T[:COUNT][inside], int(inside.sum()), np.flatnonzero(inside)
    rows = rows._replace(rows=rows.rows._replace(view=view))
    after = memory.crop_rows(rows)
    assert int(after.count) == count
    assert int(after.distinct) == count, "each keyframe has a label of its own"
    np.testing.assert_array_equal(np.asarray(after.view)[:, :count].T, view)
    for name in ("x", "y", "heading", "cosine", "sine"):
        np.testing.assert_array_equal(np.asarray(getattr(after, name))[:count], getattr(memory, name)[kept])

    recall = {"sector_fov": "whiskers", "guard": 3}
    config = RecallBackendConfig.model_validate({"recall": recall, "pose_cells": {"cells_xy": 9}})
    backend = RecallBackend(config, (1, SIZE, 1))
    mass = np.zeros((2, CAPACITY), np.float32)
    mass[:, :COUNT] = stream.dirichlet(np.ones(2 * COUNT + 1))[:-1].reshape(2, COUNT)
    belief = backend.no_belief(CAPACITY)._replace(mass=mass)
    belief = belief._replace(activity=np.full(belief.activity.shape, mass.sum() / belief.activity.size))
    left = backend.crop_rows(RecallState(belief, memory, np.zeros(3), np.ones(())), rows).belief
    np.testing.assert_allclose(np.asarray(left.mass)[:, :count], mass[:, :COUNT][:, inside])
    assert not np.asarray(left.mass)[:, count:].any()
    recalled = mass[:, :COUNT][:, inside][:, : count - 3]
    assert 0.1 < recalled.sum() == pytest.approx(float(left.activity.sum()), abs=1e-6)


def test_merged_keyframes_are_restored_and_merged_anew() -> None:
    route, count, taken = circles(LAPS, size=ROUND), LAPS * ROUND, 6 * LAPS * ROUND // 10
    whole = Drive(route, **MERGED).go(count).map
    assert whole.state.count < count
    row, own = whole.state.archive.row.rows.copy(), whole.state.taken.rows.copy()
    rows = crop_map(whole, Drive(route, **MERGED).map, np.arange(count) < taken)
    assert whole.config == Drive(route, **MERGED).map.config
    assert whole.state.count == rows.rows.rows == taken == len(whole.trajectory())
    np.testing.assert_array_equal(rows.rows.label, np.arange(taken))
    np.testing.assert_array_equal(rows.rows.source, row[:taken])
    np.testing.assert_array_equal(rows.left, own < taken)
    np.testing.assert_array_equal(rows.rows.onto[rows.left], own[own < taken])
    ended = Drive(route, **MERGED).go(taken).map.map_trajectory()  # given or doubted
    apart = np.hypot(*(whole.map_trajectory() - ended)[:, :2].T)
    assert apart.max() < CELL / 2, "the map is that of a session that ended there"
    merged = whole.merge()
    assert merged is not None
    assert merged.rows < taken


def test_pieces_stay_pieces_and_a_robot_in_one_that_is_gone_begins_another() -> None:
    map = drive(new_map(), {}, last=60)
    map.begin_piece()
    drive(map, {}, first=60, last=100)
    pieces = map.pieces()
    assert pieces.tolist() == [0] * 60 + [1] * 40
    both, other = new_map(), new_map()
    for copy in (both, other):
        copy.restore(map.arrays())
    rows = crop_map(both, new_map(), (np.arange(100) % 60 > 4))
    assert not rows.elsewhere
    assert both.pieces().tolist() == [0] * 55 + [1] * 35, "without the first keyframe of either"
    rows = crop_map(other, new_map(), keyframes_of_piece(other, 0))
    assert rows.elsewhere
    assert (rows.length, rows.turn) == (0, 0)
    other.begin_piece()
    drive(other, {}, first=60, last=70)
    assert other.pieces().tolist() == [0] * 60 + [1] * 10
