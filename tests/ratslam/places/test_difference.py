"""Differences of maps: common places, closures, and how far places moved."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.places.difference import MapContent, difference
from tactile.base.se2 import compose

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


def test_closures_count_by_the_places_that_they_join() -> None:
    first, second = [(5, 1), (6, 2), (11, 0)], [(6, 2), (7, 3)]
    found = difference(content(closures=first), content(closures=second))
    assert (found["closures_common"], found["closures_removed"], found["closures_added"]) == (1, 2, 1)
    shifted = content(PATH[3:], NAMES[3:], [(6 - 3, 4 - 3)])
    assert difference(content(closures=[(6, 4)]), shifted)["closures_common"] == 1


def test_places_of_one_name_are_taken_in_order() -> None:
    found = difference(content(PATH[:3], [b"a", b"a", b"b"]), content(PATH[:4], [b"a", b"a", b"b", b"a"]))
    assert (found["common"], found["added"]) == (3, 1)
    assert found["moved_max"] == pytest.approx(0, abs=1e-9)


def test_the_largest_motion_is_told() -> None:
    line = np.column_stack([np.arange(101.0), np.zeros(101), np.zeros(101)])
    bent = line.copy()
    bent[50] += 0.0, 0.5, 0.2
    names = [str(k).encode() for k in range(101)]
    found = difference(content(line, names), content(bent, names))
    assert found["moved_max"] == pytest.approx(0.5, abs=0.02)
    assert found["turned_max"] == pytest.approx(0.2, abs=0.02)
    assert found["moved_rms"] == pytest.approx(0.5 / np.sqrt(101), abs=0.01)
