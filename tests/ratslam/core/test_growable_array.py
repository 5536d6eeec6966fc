"""A growable array holds the rows that were appended, one at a time or many at once."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ratslam.core.arrays import GrowableArray


@given(st.lists(st.integers(0, 40), max_size=12))
def test_rows_are_those_appended(counts: list[int]) -> None:
    array, expected = GrowableArray((2,), np.float64), np.zeros((0, 2))
    for number, count in enumerate(counts):
        rows = np.full((count, 2), float(number))
        expected = np.concatenate([expected, rows])
        if count == 1:
            array.append(rows[0])
        else:
            array.extend(rows)
        assert np.array_equal(array.rows, expected)


def test_what_is_appended_is_copied() -> None:
    array, rows = GrowableArray((), np.float64), np.arange(3.0)
    array.extend(rows)
    rows[:] = -1
    assert array.rows.tolist() == [0.0, 1.0, 2.0]
