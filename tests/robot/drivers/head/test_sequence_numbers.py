"""Sequence numbers, with a small range, so that all orders of arrival occur."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.head import decoder
from robot.drivers.head.decoder import SequenceUnwrapper
from tests.robot.drivers.head import oracle

STEPS = st.one_of(st.integers(-9, 12), st.sampled_from([1, 1, 1, 2**31 - 1, 2**31, -(2**31)]))


@pytest.fixture(scope="module")
def few():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decoder, "LATE", 8)
        patch.setattr(oracle, "LATE", 8)
        yield


def arrivals(examples):
    """Decorates a law of sequence numbers in any order, cut into blocks anywhere."""
    drawn = given(
        st.sampled_from([0, 3, 2**32 - 5]),
        st.lists(STEPS, max_size=60),
        st.lists(st.integers(0, 60), max_size=6),
    )
    return lambda law: settings(max_examples=examples)(drawn(law))


def check_arrivals(first, steps, cuts):
    raw = [(first + step) % 2**32 for step in itertools.accumulate(steps)]
    mine, streams = SequenceUnwrapper(), []
    for block in np.split(np.array(raw, np.uint32), sorted(cut for cut in cuts if cut <= len(raw))):
        number, new = mine.take(block)
        full = [oracle.accept_number(value, streams) for value in block.tolist()]
        assert [n if taken else None for n, taken in zip(number.tolist(), new.tolist(), strict=True)] == full
        assert mine.missing == sum(stream.missing for stream in streams)
        assert mine.streams == len(streams)


@arrivals(250)
def test_all_orders_of_arrival(few, first, steps, cuts):
    check_arrivals(first, steps, cuts)


@pytest.mark.soak
@arrivals(5000)
def test_many_orders_of_arrival(few, first, steps, cuts):
    check_arrivals(first, steps, cuts)
