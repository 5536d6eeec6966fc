"""Overload needs two consecutive overloaded samples, in blocks of any size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.head.reader import OverloadDetector
from robot.drivers.head.usb_protocol import ANGLE

LIMIT = 1000


def watcher(alive: list[bool] | None = None) -> OverloadDetector:
    return OverloadDetector(LIMIT * ANGLE, np.array([True] * 2 if alive is None else alive))


@given(
    st.lists(st.lists(st.sampled_from([0, 999, 1000, -1000]), min_size=2, max_size=2), max_size=30), st.data()
)
def test_overload_does_not_depend_on_the_blocks(rows, data):
    values = np.zeros((len(rows), 2, 3), np.int16)
    values[:, :, 2] = np.array(rows, np.int16).reshape(-1, 2)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(rows)), max_size=4)))
    overload = watcher()
    found = [overload.check(block) for block in np.split(values, cuts)]
    over = np.abs(values[..., 2]) >= LIMIT
    twice = over[1:] & over[:-1]
    assert {one for one in found if one is not None} <= set(np.flatnonzero(twice.any(axis=0)).tolist())
    assert any(one is not None for one in found) == twice.any()


@pytest.mark.parametrize(
    ("channel", "value", "found"),
    [
        (0, 32767, True),
        (0, -32768, True),
        (0, 32766, False),
        (1, -32768, True),
        (1, 1000, True),
        (2, 999, False),
    ],
)
def test_which_deflections_are_an_overload(channel, value, found):
    values = np.zeros((2, 2, 3), np.int16)
    values[:, 1, channel] = value
    assert watcher().check(values) == (1 if found else None)
    assert watcher([True, False]).check(values) is None


def test_two_whiskers_in_turn_are_not_an_overload():
    values = np.zeros((2, 2, 3), np.int16)
    values[0, 0, 1] = values[1, 1, 1] = 5000
    assert watcher().check(values) is None
