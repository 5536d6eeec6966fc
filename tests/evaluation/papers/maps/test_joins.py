"""Whether a second session is joined to a first one, and rightly."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.papers.maps.merged_maps import Join
from evaluation.papers.maps.stored_maps import MapArrays

COUNT = 20


def two_sessions(shift: float, turn: float = 0.0, joined: bool = True) -> MapArrays:
    """A straight line of 2 m driven twice; the second is off by a shift (m) and a turn (rad)."""
    truth = np.column_stack([0.1 * np.arange(COUNT), np.zeros((COUNT, 2))])
    return MapArrays(
        np.concatenate([truth, truth + [0.0, shift, turn]]),
        np.concatenate([truth, truth]),
        np.repeat([0, 0 if joined else 1], COUNT),
        COUNT,
    )


@pytest.mark.parametrize(
    ("arrays", "right", "wrong"),
    [
        (two_sessions(0.05), True, False),
        (two_sessions(0.3), False, True),
        (two_sessions(0.0, 0.6), False, True),
        (two_sessions(0.0, joined=False), False, False),
        (two_sessions(0.3, joined=False), False, False),
    ],
)
def test_a_join_is_right_or_wrong_and_none_is_neither(arrays: MapArrays, right: bool, wrong: bool) -> None:
    found = Join.of(arrays, COUNT)
    assert (found.right, found.wrong) == (right, wrong)


def test_steps_before_the_known_part_do_not_count() -> None:
    arrays = two_sessions(0.0)
    arrays.trajectory[COUNT : COUNT + 12, 1] += 1
    assert Join.of(arrays, COUNT).wrong
    assert Join.of(arrays, COUNT, entry=12).right


def test_revisits_alone_are_compared() -> None:
    arrays = two_sessions(0.0)
    away = slice(COUNT, COUNT + 12)
    arrays.truth[away, 1] += 5
    assert Join.of(arrays, COUNT).wrong
    assert Join.of(arrays, COUNT, revisits=True).right


def test_the_figures_of_a_map_are_those_of_its_known_steps() -> None:
    arrays = two_sessions(0.3)
    assert arrays.em > 0.01
    assert two_sessions(0.3, joined=False).em_within_pieces == pytest.approx(0, abs=1e-12)
    arrays.truth[COUNT:] = np.nan
    assert arrays.em == pytest.approx(0, abs=1e-12)
    assert arrays.em_within_pieces == pytest.approx(0, abs=1e-12)
    assert arrays.ate == pytest.approx(0, abs=1e-12)
