"""Rows and series of strain from samples that come in any pieces, some of them lost."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.head.decoder import Frames
from robot.drivers.head.usb_protocol import frame_values
from robot.live.create_rig import StrainMonitor

RATE, PERIOD, SCALE, WHISKERS = 2000.0, 0.01, 0.01, 3
SIZE = 20
"""Samples of a row."""


def frames(first: int, count: int) -> Frames:
    """Samples from a number on, whose strain depends on the number."""
    number = np.arange(first, first + count)
    angle = np.zeros((count, WHISKERS))
    deflection = 0.01 * np.sin(number / 7)[:, None, None] * np.arange(1, 1 + WHISKERS * 2).reshape(1, -1, 2)
    return Frames(number, 500 * number, np.zeros(count, np.uint8), frame_values(angle, deflection))


def part(block: Frames, mask: np.ndarray) -> Frames:
    return Frames(*(column[mask] for column in block))


def monitor() -> StrainMonitor:
    made = StrainMonitor(RATE, PERIOD, SCALE, WHISKERS)
    made.add(frames(0, 33))  # before the motion
    made.begin()
    return made


@given(st.lists(st.integers(1, 50), min_size=1, max_size=12))
def test_rows_do_not_depend_on_the_pieces(sizes: list[int]) -> None:
    pieces, whole = monitor(), monitor()
    place = 33
    for size in sizes:
        pieces.add(frames(place, size))
        place += size
    whole.add(frames(33, sum(sizes)))
    count = sum(sizes) // SIZE
    rows = pieces.rows(10**6)
    assert len(rows) == count
    assert np.allclose(rows, whole.rows(10**6), rtol=0, atol=1e-18)
    strain = whole.strain(frames(33, count * SIZE).values)
    assert np.allclose(rows, strain.reshape(count, SIZE, WHISKERS, 2).mean(axis=1), rtol=0, atol=1e-18)
    assert len(pieces.rows(2)) == min(count, 2)


def test_a_head_that_has_run_for_long_or_is_connected_again() -> None:
    """Numbers may start anywhere and jump by 2^32."""
    late = StrainMonitor(RATE, PERIOD, SCALE, WHISKERS)
    late.begin()
    late.add(frames(10**9, SIZE))
    assert len(late.rows(9)) == 1
    late.restart()
    assert len(late.rows(9)) == 0
    late.add(frames(10**9 + 2**32, 3 * SIZE))
    late.begin()
    late.add(frames(10**9 + 2**32 + 3 * SIZE, 2 * SIZE))
    assert len(late.rows(9)) == 2
    assert late.first == 10**9 + 2**32 + 3 * SIZE


def test_many_rows_are_kept() -> None:
    made = monitor()
    made.add(frames(33, 300 * SIZE))
    assert len(made.rows(10**6)) == 300
    expected = made.strain(frames(33, 300 * SIZE).values).reshape(300, SIZE, WHISKERS, 2).mean(axis=1)
    assert np.allclose(made.rows(10**6), expected, rtol=0, atol=1e-18)


def test_a_row_of_lost_samples_repeats_the_one_before() -> None:
    block = frames(33, 4 * SIZE)
    lossy = monitor()
    number = block.sequence - 33
    lossy.add(part(block, (number < SIZE) | (number >= 2 * SIZE)))
    rows = lossy.rows(4)
    assert np.array_equal(rows[1], rows[0])
    assert not np.array_equal(rows[2], rows[1])


def test_the_strain_at_rest_is_subtracted() -> None:
    shifted = monitor()
    shifted.rest = np.full((WHISKERS, 2), 1e-4)
    shifted.add(frames(33, SIZE))
    plain = monitor()
    plain.add(frames(33, SIZE))
    assert np.allclose(shifted.rows(1), plain.rows(1) - 1e-4)


def test_lost_samples_of_a_series_are_interpolated_up_to_a_gap() -> None:
    block = frames(33, 2 * SIZE)
    made = monitor()
    made.add(block)
    whole = made.series(block, 2, gap=5)
    assert whole.shape == (2 * SIZE, WHISKERS, 2)
    kept = np.ones(2 * SIZE, bool)
    kept[[7, 8, 20]] = False
    filled = made.series(part(block, kept), 2, gap=5)
    assert np.array_equal(filled[kept], whole[kept])
    assert np.abs(filled - whole).max() < 0.02 * np.abs(whole).max()
    kept[9:12] = False
    assert len(made.series(part(block, kept), 2, gap=5)) == 0
