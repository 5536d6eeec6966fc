"""Sessions that two maps have in common."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.places.difference import LEAST, Remembered, overlap, remembered
from ratslam.places.union import unite
from tests.ratslam.mapping.map_cases import BIAS, LAP, drive, new_map, sequence

law = settings(derandomize=True, deadline=None, max_examples=60)


def known(names: list[int], step: int = 1) -> Remembered:
    """Keyframes with these names, one each `step` steps."""
    first: dict[bytes, int] = {}
    for number, name in enumerate(names):
        first.setdefault(str(name).encode(), number)
    return first, step * np.arange(len(names))


@law
@given(st.integers(0, 30), st.integers(LEAST, 40), st.integers(0, 30), st.integers(0, 30))
def test_a_part_of_a_session_is_found_wherever_it_stands(before, count, after, other) -> None:
    """Also behind another session, before one, and where rows of a robot at rest are repeated."""
    session = [0] * before + list(range(1, count + 1)) + [0] * after
    part = list(range(100, 100 + other)) + list(range(1, count + 1)) + [200] * after
    found = overlap(known(session, 2), known(part, 3))
    assert found == (count, (2 * before, 2 * (before + count - 1)), (3 * other, 3 * (other + count - 1)))


@law
@given(st.integers(2 * LEAST, 300), st.integers(0, 2**32 - 1))
def test_rows_that_are_equal_in_another_order_are_of_other_sessions(count, seed) -> None:
    shuffled = np.random.default_rng(seed).permutation(count)
    shift = np.unique(shuffled - np.arange(count), return_counts=True)[1]
    found = overlap(known(list(range(count))), known(shuffled.tolist()))
    assert (found is None) == (shift.max() < LEAST)


@law
@given(st.integers(0, LEAST - 1), st.integers(LEAST + 1, 50))
def test_few_equal_rows_are_chance(common, count) -> None:
    one, other = list(range(count)), list(range(common)) + list(range(100, 100 + count - common))
    assert overlap(known(one), known(other)) is None


def test_a_short_session_is_known_by_all_of_it() -> None:
    assert overlap(known([1, 2, 3]), known([9, 9, 9, 1, 2, 3])) == (3, (0, 2), (3, 5))
    assert overlap(known([1, 2, 3, 4]), known([9, 1, 8, 7])) is None


def test_a_united_map_holds_both_sessions() -> None:
    closed = sequence(LAP + 2, 2, 12, 4.0)
    one, other = (drive(new_map(), closed, bias=bias) for bias in (BIAS, -BIAS))
    count = one.keyframes().count
    united = remembered(unite(one, other, new_map()))
    for made, begin in ((one, 0), (other, LAP + 60)):
        found = overlap(remembered(made), united)
        assert found is not None
        assert begin <= found[2][0] <= found[2][1] < begin + count
