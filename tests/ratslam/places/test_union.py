"""Two maps: their difference, common sessions, what each keeps in a united one; what a crop leaves."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend, RecallState
from ratslam.places import difference as differing
from ratslam.places.crop import crop_map, keyframes_in_box, keyframes_of_piece, keyframes_of_steps
from ratslam.places.difference import LEAST, MapContent, difference, keyframe_content, overlap, remembered
from ratslam.places.union import Bend, renew_experiences, unite
from tactile.base.se2 import between, compose, correct_heading
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, STEP, TRUE, drive, new_map, sequence
from tests.ratslam.mapping.merging_cases import Drive, circles
from tests.ratslam.mapping.optimizer_cases import apart
from tests.ratslam.recall.test_observation_model import BOTH, CAPACITY, SIZE, random_memory
from tests.ratslam.recall.test_observation_model import COUNT as ROWS

COUNT, END = 12, LAP + 60
NAMES = [bytes([k]) for k in range(COUNT)]
PATH = np.random.default_rng(5).normal(size=(COUNT, 3))


def content(poses=PATH, names=NAMES, closures=()) -> MapContent:
    return poses, list(names), np.array(closures, int).reshape(-1, 2)


def counts(found, of=""):
    return tuple(found[of + name] for name in ("common", "removed", "added"))


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.sets(st.integers(0, COUNT - 1)))
def test_places_are_known_by_their_names_whatever_the_frame_of_the_map(motion, kept) -> None:
    moved = content(compose(np.array(motion), PATH), closures=[(5, 1)])
    found = difference(content(closures=[(5, 1)]), moved)
    assert (counts(found), counts(found, "closures_")) == ((COUNT, 0, 0), (1, 0, 0))
    assert max(found["moved_max"], found["turned_max"]) < 1e-9
    rows = sorted(kept)
    part = content(PATH[rows], [NAMES[k] for k in rows])
    found = difference(content(), part)
    assert counts(found) == (len(rows), COUNT - len(rows), 0)
    assert np.isnan(found["moved_max"]) == (not rows)
    assert counts(difference(part, content())) == (len(rows), 0, COUNT - len(rows))
    doubled = difference(content(PATH[:3], [b"a", b"a", b"b"]), content(PATH[:4], [b"a", b"a", b"b", b"a"]))
    assert counts(doubled) == (3, 0, 1)  # places of one name are taken in order
    assert doubled["moved_max"] == pytest.approx(0, abs=1e-9)


def test_closures_count_by_the_places_that_they_join_and_the_largest_motion_is_told() -> None:
    found = difference(content(closures=[(5, 1), (6, 2), (11, 0)]), content(closures=[(6, 2), (7, 3)]))
    assert counts(found, "closures_") == (1, 2, 1)
    shifted = content(PATH[3:], NAMES[3:], [(6 - 3, 4 - 3)])
    assert difference(content(closures=[(6, 4)]), shifted)["closures_common"] == 1
    line, names = np.outer(np.arange(101), [1.0, 0.0, 0.0]), [str(k).encode() for k in range(101)]
    bent = line + np.outer(np.arange(101) == 50, [0.0, 0.5, 0.2])
    found = difference(content(line, names), content(bent, names))
    assert found["moved_max"] == pytest.approx(0.5, abs=0.02)
    assert found["turned_max"] == pytest.approx(0.2, abs=0.02)
    assert found["moved_rms"] == pytest.approx(0.5 / np.sqrt(101), abs=0.01)


@cache
def made(bias: float = BIAS):
    """Read only."""
    return drive(new_map(), TRUE, bias=bias)


@pytest.fixture(scope="module")
def united():
    return unite(made(), made(-BIAS), new_map())


def test_each_part_keeps_its_shape_and_closures_lies_apart_and_is_corrected_by_its_own_calibration(united):
    for part, bias in ((slice(END), BIAS), (slice(END, None), -BIAS)):
        one, other = united.trajectory()[part], made(bias).trajectory()
        # Both parts say something of the calibration.
        assert apart(between(one[0], one), between(other[0], other)) < 0.1 * CELL
    assert np.array_equal(united.pieces(), np.arange(2 * (END)) >= END)
    alone = made().closures()
    assert len(alone)
    assert np.array_equal(united.closures(), np.concatenate([alone, alone + END]))
    graph = united.state
    for part, bias in ((slice(1, END), BIAS), (slice(LAP + 61, None), -BIAS)):
        fit, before = made(bias).solution(), made(bias).state.unmerged
        assert abs(fit.bias - bias) < abs(bias) / 2  # each has found its own
        expected = correct_heading(before.motion.rows[1:], before.length.rows[1:], fit.bias, fit.turn_error)
        found = graph.correct(graph.motion.rows[part], graph.length.rows[part])
        assert np.abs(found - expected).max() < 1e-12


def test_experiences_are_formed_anew_within_pieces(united):
    renew_experiences(united)
    graph = united.graph()
    later = np.array([data["keyframe"] >= END for _, data in graph.nodes(data=True)])
    assert 0 < later.sum() < len(later)
    assert not [edge for edge in graph.edges if later[edge[0]] != later[edge[1]]]


@given(st.integers(0, 2**32 - 1))
def test_bent_odometry_is_corrected_to_the_same_motion(seed):
    random = np.random.default_rng(seed)
    motion, length = random.normal(0, 0.3, (20, 3)), random.uniform(0, 1, 20)
    old, new = (CalibrationPrior(bias, 0.01, turn, 0.0) for bias, turn in random.normal(0, 0.05, (2, 2)))
    bent = Bend(old, new).motions(motion, length)
    there = correct_heading(bent, length, new.bias, new.turn_error)
    assert np.abs(there - correct_heading(motion, length, old.bias, old.turn_error)).max() < 1e-12
    assert np.abs(Bend(new, old).motions(bent, length) - motion).max() < 1e-12


def known(names: list[int], step: int = 1) -> differing.Remembered:
    """Keyframes with these names, one each `step` steps; the first of equal names counts."""
    first = {str(name).encode(): k for k, name in reversed([*enumerate(names)])}
    return first, step * np.arange(len(names))


@given(st.integers(0, 30), st.integers(LEAST, 40), st.integers(0, 30), st.integers(0, 30))
def test_a_part_of_a_session_is_found_wherever_it_stands(before, count, after, other) -> None:
    """Also behind another session, before one, and where rows of a robot at rest are repeated."""
    session = [0] * before + [*range(1, count + 1)] + [0] * after
    part = [*range(100, 100 + other), *range(1, count + 1)] + [200] * after
    found = overlap(known(session, 2), known(part, 3))
    assert found == (count, (2 * before, 2 * (before + count - 1)), (3 * other, 3 * (other + count - 1)))


@given(st.integers(2 * LEAST, 300), st.integers(0, 2**32 - 1))
def test_rows_that_are_equal_in_another_order_are_of_other_sessions(count, seed) -> None:
    shuffled = np.random.default_rng(seed).permutation(count)
    shift = np.unique(shuffled - np.arange(count), return_counts=True)[1]
    found = overlap(known(list(range(count))), known(shuffled.tolist()))
    assert (found is None) == (shift.max() < LEAST)


def test_a_short_session_is_known_by_all_of_it_and_a_united_map_holds_both_sessions(united) -> None:
    assert overlap(known([1, 2, 3]), known([9, 9, 9, 1, 2, 3])) == (3, (0, 2), (3, 5))
    assert overlap(known([1, 2, 3, 4]), known([9, 1, 8, 7])) is None
    for common in (LEAST - 1, LEAST):  # few equal rows are chance
        one, other = list(range(50)), [*range(common), *range(100, 150 - common)]
        assert (overlap(known(one), known(other)) is None) == (common < LEAST)
    together = remembered(united)
    for bias, begin in ((BIAS, 0), (-BIAS, END)):
        _, _, (first, last) = overlap(remembered(made(bias)), together)
        assert begin <= first <= last < begin + END


MERGED = {"select_every": 30, "merge_stood": 2, "merge_newest": 60, "solve_every": 1}
RECALLED = sequence(LAP, 0, 60, 4.0)
"""Recall of the first keyframes in the second lap."""


@cache
def driven(recalled: bool) -> dict[str, np.ndarray]:
    return drive(new_map(), RECALLED if recalled else {}).arrays()


def restored(arrays):
    map = new_map()
    map.restore(arrays)
    return map


@pytest.fixture
def joined():
    """A lap and 60 keyframes of the next one, joined by one sequence."""
    return restored(driven(True))


def cropped(joined, inside):
    before = joined.trajectory()
    return crop_map(joined, new_map(), inside), before


def test_a_crop_of_everything_changes_nothing(joined) -> None:
    before, arrays = keyframe_content(joined), joined.arrays()
    rows, path = cropped(joined, np.ones(END, bool))
    found = difference(before, keyframe_content(joined))
    assert counts(found) == (END, 0, 0)
    assert counts(found, "closures_") == (len(joined.closures()), 0, 0)
    assert len(joined.closures()) > 40
    assert np.abs(joined.trajectory() - path).max() < 1e-9
    assert joined.arrays().keys() == arrays.keys()
    assert rows.left.all()
    np.testing.assert_array_equal(rows.rows.source, np.arange(END))
    assert (rows.length, rows.turn, *rows.motion) == (0, 0, 0, 0, 0)


def test_steps_keep_their_keyframes_closures_and_experiences(joined) -> None:
    graph, steps = joined.graph(), joined.keyframe_steps()
    rows, path = cropped(joined, keyframes_of_steps(joined, 30, END))
    count = END - 30
    assert rows.rows.rows == count == joined.state.count
    np.testing.assert_array_equal(joined.keyframe_steps(), steps[:count])
    closures = joined.closures()
    assert 0 < len(closures) <= 30
    assert 0 <= closures.min() <= closures.max() < count
    np.testing.assert_array_equal(closures[:, 0] - closures[:, 1], LAP)
    assert not joined.pieces().any()
    moved = np.hypot(*(joined.trajectory() - path[30:])[:, :2].T)
    assert moved.max() < 0.1 * np.ptp(path[:, 0]), "solved without the first closures"
    after = joined.graph()
    assert len(after) == len(graph), "the second lap saw the places of the keyframes that are gone"
    places = np.array([[node["x"], node["y"]] for node in after.nodes.values()])
    apart = np.hypot(*(places[:, None] - joined.trajectory()[None, :, :2]).transpose(2, 0, 1)).min(axis=1)
    assert apart.max() < 0.05 * STEP, "every experience lies on the way"
    assert all(data["traversals"] > 0 for *_, data in after.edges(data=True))


def test_where_keyframes_are_left_out_only_closures_join(joined) -> None:
    unjoined = restored(driven(False))
    for map, pieces in ((joined, 1), (unjoined, 2)):
        ends, places = keyframes_of_steps(map, 0, 60) | keyframes_of_steps(map, LAP, END), len(map.graph())
        cropped(map, ends)
        assert 0 < len(map.graph()) < places
        assert len(map.trajectory()) == 120
        assert len(np.unique(map.pieces())) == pieces
    crop_map(unjoined, new_map(), keyframes_of_piece(unjoined, 1))
    assert len(unjoined.trajectory()) == 60
    assert len(np.unique(unjoined.pieces())) == 1


def test_a_box_keeps_what_lies_in_it(joined) -> None:
    path = joined.trajectory()
    (left, low, _), (_, high, _), middle = path.min(axis=0) - 1, path.max(axis=0) + 1, np.median(path[:, 0])
    inside = keyframes_in_box(joined, (left, low, float(middle), high))
    np.testing.assert_array_equal(inside, path[:, 0] <= middle)
    cropped(joined, inside)
    assert len(joined.trajectory()) == inside.sum()
    with pytest.raises(ValueError, match="no keyframe remains"):
        cropped(joined, keyframes_of_steps(joined, END, END + 5))


def test_the_robot_stays_where_it_was_and_drives_on(joined) -> None:
    # Without noise and closures, odometry says where the robot is.
    alone = restored(driven(False))
    pose = alone.pose(None)
    rows, _ = cropped(alone, keyframes_of_steps(alone, 0, 100))
    np.testing.assert_allclose(alone.pose(None), pose, atol=1e-9)
    np.testing.assert_allclose(compose(alone.trajectory()[-1], rows.motion), pose, atol=1e-9)
    assert rows.length == pytest.approx((END - 100) * STEP)
    cropped(joined, keyframes_of_steps(joined, 30, END))
    drive(joined, RECALLED, first=END - 30, last=END)
    assert len(joined.trajectory()) == END
    assert len(joined.closures()) > 30


@pytest.mark.parametrize("seed", range(2))
def test_the_memory_keeps_the_rows_that_remain_and_belief_in_others_is_novelty_at_once(seed: int) -> None:
    stream = np.random.default_rng(seed)
    memory, inside = random_memory(np.random.default_rng(seed), BOTH), np.arange(ROWS) % 3 > 0
    rows = crop_map(drive(new_map(), {}, last=ROWS), new_map(), inside)
    view, count, kept = np.asarray(memory.view).T[:ROWS][inside], int(inside.sum()), np.flatnonzero(inside)
    rows = rows._replace(rows=rows.rows._replace(view=view))
    after = memory.crop_rows(rows)
    assert int(after.count) == int(after.distinct) == count, "each keyframe has a label of its own"
    np.testing.assert_array_equal(np.asarray(after.view)[:, :count].T, view)
    for name in ("x", "y", "heading", "cosine", "sine"):
        np.testing.assert_array_equal(np.asarray(getattr(after, name))[:count], getattr(memory, name)[kept])

    settings = {"recall": {"sector_fov": "whiskers", "guard": 3}, "pose_cells": {"cells_xy": 9}}
    backend = RecallBackend(RecallBackendConfig.model_validate(settings), (1, SIZE, 1))
    mass = np.zeros((2, CAPACITY), np.float32)
    mass[:, :ROWS] = stream.dirichlet(np.ones(2 * ROWS + 1))[:-1].reshape(2, ROWS)
    belief = backend.no_belief(CAPACITY)._replace(mass=mass)
    belief = belief._replace(activity=np.full(belief.activity.shape, mass.sum() / belief.activity.size))
    left = backend.crop_rows(RecallState(belief, memory, np.zeros(3), np.ones(())), rows).belief
    np.testing.assert_allclose(np.asarray(left.mass)[:, :count], mass[:, :ROWS][:, inside])
    assert not np.asarray(left.mass)[:, count:].any()
    recalled = mass[:, :ROWS][:, inside][:, : count - 3]
    assert 0.1 < recalled.sum() == pytest.approx(float(left.activity.sum()), abs=1e-6)


def test_merged_keyframes_are_restored_and_merged_anew() -> None:
    route, count, taken = circles(4, size=80), 320, 192
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
    ended = Drive(route, **MERGED).go(taken).map.map_trajectory()
    assert np.hypot(*(whole.map_trajectory() - ended)[:, :2].T).max() < CELL / 2  # a session that ended there
    assert whole.merge().rows < taken


def test_pieces_stay_pieces_and_a_robot_in_one_that_is_gone_begins_another() -> None:
    map = drive(new_map(), {}, last=60)
    map.begin_piece()
    drive(map, {}, first=60, last=100)
    assert map.pieces().tolist() == [0] * 60 + [1] * 40
    both, other = restored(map.arrays()), restored(map.arrays())
    rows = crop_map(both, new_map(), (np.arange(100) % 60 > 4))
    assert not rows.elsewhere
    assert both.pieces().tolist() == [0] * 55 + [1] * 35, "without the first keyframe of either"
    rows = crop_map(other, new_map(), keyframes_of_piece(other, 0))
    assert rows.elsewhere
    assert (rows.length, rows.turn) == (0, 0)
    other.begin_piece()
    drive(other, {}, first=60, last=70)
    assert other.pieces().tolist() == [0] * 60 + [1] * 10
