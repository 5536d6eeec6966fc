"""The ring buffer agrees with a dictionary of the newest numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.head.decoder import Frames
from robot.drivers.head.reader import RingBuffer

SIZE = 16


def frames(numbers: list[int]) -> Frames:
    number = np.array(numbers, np.int64)
    values = np.repeat(number[:, None] % 30000, 3, axis=1)[:, None].astype(np.int16)
    return Frames(number, 500 * number, (number % 256).astype(np.uint8), values)


BLOCKS = st.lists(
    st.lists(st.integers(-40, 40), max_size=8, unique=True), max_size=8
)  # steps about the highest so far


@given(BLOCKS, st.integers(0, 60), st.integers(0, 40))
def test_the_ring_holds_the_newest_frames(blocks, first, length):
    ring, stored, highest = RingBuffer(1, size=SIZE), {}, 2**32
    for k, block in enumerate(blocks):
        numbers = [highest + step for step in block]
        highest = max([highest, *numbers]) if stored or numbers else highest
        ring.append(frames(numbers), float(k))
        stored |= {n: 500 * n for n in numbers}
        if stored:
            newest = max(stored)
            stored = {n: t for n, t in stored.items() if n > newest - SIZE}
            assert ring.newest is not None
            assert ring.newest[:2] == (newest, 500 * newest)
    start = 2**32 - 20 + first
    wanted = sorted(n for n in stored if start <= n <= start + length)
    got = ring.between(start, start + length)
    assert got.sequence.tolist() == wanted
    assert got.time.tolist() == [500 * n for n in wanted]
    assert got.flags.tolist() == [n % 256 for n in wanted]
    assert got.values[:, 0, 2].tolist() == [n % 30000 for n in wanted]


def test_an_empty_ring():
    ring = RingBuffer(1)
    assert ring.newest is None
    assert not len(ring.between(0, 10).sequence)


def test_results_are_copies():
    ring = RingBuffer(1, size=SIZE)
    ring.append(frames(list(range(10))), 0.0)
    got = ring.between(0, 9)
    ring.append(frames(list(range(10, 30))), 0.0)
    assert got.sequence.tolist() == list(range(10))
    assert ring.between(0, 99).sequence.tolist() == list(range(14, 30))


def test_the_size_must_be_a_power_of_two():
    with pytest.raises(ValueError, match="power of two"):
        RingBuffer(1, size=100)
