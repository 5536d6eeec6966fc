"""Two maps: their difference, the sessions that they have in common, and what each keeps in a united map."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.places.difference import LEAST, MapContent, Remembered, difference, overlap, remembered
from ratslam.places.union import Bend, renew_experiences, unite
from tactile.base.se2 import between, compose, correct_heading, wrap
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, drive, new_map, sequence

COUNT = 12
NAMES = [bytes([k]) for k in range(COUNT)]
PATH = np.random.default_rng(5).normal(size=(COUNT, 3))


def content(poses=PATH, names=NAMES, closures=()) -> MapContent:
    return poses, list(names), np.array(closures, int).reshape(-1, 2)


@given(motion=st.tuples(*[st.floats(-3, 3)] * 3))
def test_the_frame_of_a_map_does_not_count(motion) -> None:
    found = difference(
        content(closures=[(5, 1)]), content(compose(np.array(motion), PATH), closures=[(5, 1)])
    )
    assert (found["common"], found["removed"], found["added"]) == (COUNT, 0, 0)
    assert (found["closures_common"], found["closures_removed"], found["closures_added"]) == (1, 0, 0)
    assert max(found["moved_max"], found["turned_max"]) < 1e-9


@given(kept=st.sets(st.integers(0, COUNT - 1)))
def test_places_are_known_by_their_names(kept) -> None:
    rows = sorted(kept)
    found = difference(content(), content(PATH[rows], [NAMES[k] for k in rows]))
    assert (found["common"], found["removed"], found["added"]) == (len(rows), COUNT - len(rows), 0)
    assert np.isnan(found["moved_max"]) == (not rows)
    again = difference(content(PATH[rows], [NAMES[k] for k in rows]), content())
    assert (again["common"], again["removed"], again["added"]) == (len(rows), 0, COUNT - len(rows))
    doubled = difference(content(PATH[:3], [b"a", b"a", b"b"]), content(PATH[:4], [b"a", b"a", b"b", b"a"]))
    assert (doubled["common"], doubled["added"]) == (3, 1)  # places of one name are taken in order
    assert doubled["moved_max"] == pytest.approx(0, abs=1e-9)


def test_closures_count_by_the_places_that_they_join() -> None:
    first, second = [(5, 1), (6, 2), (11, 0)], [(6, 2), (7, 3)]
    found = difference(content(closures=first), content(closures=second))
    assert (found["closures_common"], found["closures_removed"], found["closures_added"]) == (1, 2, 1)
    shifted = content(PATH[3:], NAMES[3:], [(6 - 3, 4 - 3)])
    assert difference(content(closures=[(6, 4)]), shifted)["closures_common"] == 1


def test_the_largest_motion_is_told() -> None:
    line = np.column_stack([np.arange(101.0), np.zeros(101), np.zeros(101)])
    bent = line.copy()
    bent[50] += 0.0, 0.5, 0.2
    names = [str(k).encode() for k in range(101)]
    found = difference(content(line, names), content(bent, names))
    assert found["moved_max"] == pytest.approx(0.5, abs=0.02)
    assert found["turned_max"] == pytest.approx(0.2, abs=0.02)
    assert found["moved_rms"] == pytest.approx(0.5 / np.sqrt(101), abs=0.01)


CLOSED = sequence(LAP + 2, 2, 12, 4.0)


@cache
def made(bias: float = BIAS):
    """Read only."""
    return drive(new_map(), CLOSED, bias=bias)


def shape(poses: np.ndarray) -> np.ndarray:
    return between(poses[0], poses)


@pytest.fixture(scope="module")
def united():
    return unite(made(), made(-BIAS), new_map())


def test_each_part_keeps_its_shape_and_its_closures_and_lies_apart(united):
    for part, bias in ((slice(LAP + 60), BIAS), (slice(LAP + 60, None), -BIAS)):
        error = shape(united.trajectory()[part]) - shape(made(bias).trajectory())
        error[:, 2] = wrap(error[:, 2])
        assert np.abs(error).max() < 0.1 * CELL  # both parts say something of the calibration
    assert np.array_equal(united.pieces(), np.arange(2 * (LAP + 60)) >= LAP + 60)
    alone = made().closures()
    assert len(alone)
    assert np.array_equal(united.closures(), np.concatenate([alone, alone + LAP + 60]))


def test_the_odometry_of_either_is_corrected_as_by_its_own_calibration(united):
    graph = united.state
    for part, bias in ((slice(1, LAP + 60), BIAS), (slice(LAP + 61, None), -BIAS)):
        own = made(bias)
        fit, before = own.solution(), own.state.unmerged
        assert abs(fit.bias - bias) < abs(bias) / 2  # each has found its own
        expected = correct_heading(before.motion.rows[1:], before.length.rows[1:], fit.bias, fit.turn_error)
        found = graph.correct(graph.motion.rows[part], graph.length.rows[part])
        assert np.abs(found - expected).max() < 1e-12


def test_experiences_are_formed_anew_within_pieces(united):
    renew_experiences(united)
    graph = united.graph()
    keyframe = np.array([data["keyframe"] for _, data in graph.nodes(data=True)])
    later = keyframe >= LAP + 60
    assert 0 < later.sum() < len(later)
    assert not [edge for edge in graph.edges if later[edge[0]] != later[edge[1]]]


@given(st.integers(0, 2**32 - 1))
def test_bent_odometry_is_corrected_to_the_same_motion(seed):
    random = np.random.default_rng(seed)
    motion, length = random.normal(0, 0.3, (20, 3)), random.uniform(0, 1, 20)
    old, new = (CalibrationPrior(*random.normal(0, 0.05, 2), 0.0, 0.0) for _ in range(2))
    old, new = (one._replace(turn_error=float(random.normal(0, 0.05))) for one in (old, new))
    bend = Bend(old, new)
    there = correct_heading(bend.motions(motion, length), length, new.bias, new.turn_error)
    expected = correct_heading(motion, length, old.bias, old.turn_error)
    assert np.abs(there - expected).max() < 1e-12
    back = Bend(new, old).motions(bend.motions(motion, length), length)
    assert np.abs(back - motion).max() < 1e-12


def known(names: list[int], step: int = 1) -> Remembered:
    """Keyframes with these names, one each `step` steps."""
    first: dict[bytes, int] = {}
    for number, name in enumerate(names):
        first.setdefault(str(name).encode(), number)
    return first, step * np.arange(len(names))


@given(st.integers(0, 30), st.integers(LEAST, 40), st.integers(0, 30), st.integers(0, 30))
def test_a_part_of_a_session_is_found_wherever_it_stands(before, count, after, other) -> None:
    """Also behind another session, before one, and where rows of a robot at rest are repeated."""
    session = [0] * before + list(range(1, count + 1)) + [0] * after
    part = list(range(100, 100 + other)) + list(range(1, count + 1)) + [200] * after
    found = overlap(known(session, 2), known(part, 3))
    assert found == (count, (2 * before, 2 * (before + count - 1)), (3 * other, 3 * (other + count - 1)))


@given(st.integers(2 * LEAST, 300), st.integers(0, 2**32 - 1))
def test_rows_that_are_equal_in_another_order_are_of_other_sessions(count, seed) -> None:
    shuffled = np.random.default_rng(seed).permutation(count)
    shift = np.unique(shuffled - np.arange(count), return_counts=True)[1]
    found = overlap(known(list(range(count))), known(shuffled.tolist()))
    assert (found is None) == (shift.max() < LEAST)


def test_a_short_session_is_known_by_all_of_it() -> None:
    assert overlap(known([1, 2, 3]), known([9, 9, 9, 1, 2, 3])) == (3, (0, 2), (3, 5))
    assert overlap(known([1, 2, 3, 4]), known([9, 1, 8, 7])) is None
    for common in (LEAST - 1, LEAST):  # few equal rows are chance
        one, other = list(range(50)), [*range(common), *range(100, 150 - common)]
        assert (overlap(known(one), known(other)) is None) == (common < LEAST)


def test_a_united_map_holds_both_sessions(united) -> None:
    together = remembered(united)
    for bias, begin in ((BIAS, 0), (-BIAS, LAP + 60)):
        one = made(bias)
        found = overlap(remembered(one), together)
        assert found is not None
        assert begin <= found[2][0] <= found[2][1] < begin + one.state.unmerged.count
