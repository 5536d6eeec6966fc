"""The grid filter on whole sessions: it beats dead reckoning, and what carries it does."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ratslam.experiments.tables.grid import GridFigures, GridTask, measure_session

FEW, MANY = (9100, 9101), tuple(range(9100, 9108))


@cache
def sessions(row: str, arenas: tuple[int, ...] = FEW) -> list[GridFigures]:
    return [measure_session(GridTask("A", row, arena)) for arena in arenas]


def ratio(row: str, arenas: tuple[int, ...] = FEW) -> float:
    """Mean error over that of dead reckoning, in 1.25 m arenas."""
    found = sessions(row, arenas)
    return float(np.sum([one.error for one in found]) / np.sum([one.odometry for one in found]))


@pytest.mark.soak
def test_errors_that_last_are_taken_out():
    assert ratio("bias") < 0.3


@pytest.mark.soak
def test_errors_of_single_moves_are_made_good_in_part():
    assert ratio("move", MANY) < 0.85


@pytest.mark.soak
def test_contacts_alone_take_out_errors_that_last():
    assert ratio("bias, blobs only", MANY) < 0.5


@pytest.mark.soak
@pytest.mark.parametrize(("row", "least"), [
    ("move, temper 1, prior 0.3", 1.0), ("move, BACK skipped", 1.0), ("bias, as printed", 0.6),
    ("move, as printed", 1.0),
])  # fmt: skip
def test_what_carries_it_does(row, least):
    """A way back left out; unknown space as obstacles; the paper's filter: dead reckoning again."""
    assert ratio(row, MANY) > least


@pytest.mark.soak
@pytest.mark.parametrize(("row", "times"), [("bias without run errors", 1.5), ("bias, BACK skipped", 2.0)])
def test_what_carries_it_against_errors_that_last(row, times):
    """They are no noise, and the way back is part of the way."""
    assert ratio(row, MANY) > times * ratio("bias", MANY)


def test_a_map_is_drawn_where_walls_are():
    auc, skill, free, there, back = np.mean([one.map for one in sessions("bias")], axis=0)
    assert auc > 0.85
    assert skill > max(0.25, free)
    assert max(there, back) < 0.08


def test_walls_are_told_as_they_run():
    found = sessions("bias")
    off = np.degrees(np.concatenate([one.wall_errors for one in found]))
    assert off.mean() < 6
    assert (off > 15).mean() < 0.04
    assert len(off) > 0.45 * sum(one.contacts for one in found)
