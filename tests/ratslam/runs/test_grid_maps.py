"""The grid filter on whole sessions: its error against dead reckoning, its essential parts, the map."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from evaluation.papers.tables.grid_table import GridFigures, measure_session

ONE, FEW, MANY = (9100,), (9100, 9101), tuple(range(9100, 9108))
ARENAS = pytest.mark.parametrize("arenas", [ONE, pytest.param(FEW, marks=pytest.mark.soak)])


@cache
def sessions(row: str, arenas: tuple[int, ...] = FEW) -> list[GridFigures]:
    return [measure_session(("A", row, arena)) for arena in arenas]


def ratio(row: str, arenas: tuple[int, ...] = FEW) -> float:
    """Mean error over that of dead reckoning, in 1.25 m arenas."""
    error, odometry = np.array([one[:2] for one in sessions(row, arenas)]).T
    return float(error.sum() / odometry.sum())


@pytest.mark.soak
def test_errors_are_corrected_and_contacts_alone_do_so():
    """Those of a session's scale, and partly those of single moves."""
    assert ratio("bias") < 0.3
    assert ratio("move", MANY) < 0.85
    assert ratio("bias, blobs only", MANY) < 0.5


@pytest.mark.soak
@pytest.mark.parametrize(("row", "least"), [
    ("move, temper 1, prior 0.3", 1.0), ("move, BACK skipped", 1.0), ("bias, as printed", 0.6),
    ("move, as printed", 1.0), ("bias without run errors", 1.5), ("bias, BACK skipped", 2.0),
])  # fmt: skip
def test_errors_are_not_corrected_without_the_essential_parts(row, least):
    """Without odometry of BACK motions, with unknown space as obstacles, or with the filter as printed, the
    error is near or above dead reckoning's; without those of a scale's noise model, a multiple of the
    filter's."""
    assert ratio(row, MANY) > least * (ratio("bias", MANY) if least > 1 else 1)


@ARENAS
def test_the_map_agrees_with_the_walls(arenas):
    auc, skill, free, there, back = np.mean([one[4] for one in sessions("bias", arenas)], axis=0)
    assert auc > 0.85
    assert skill > max(0.25, free)
    assert max(there, back) < 0.08


@ARENAS
def test_wall_directions_are_estimated_from_contacts(arenas):
    _, _, errors, contacts, _ = zip(*sessions("bias", arenas), strict=True)
    off = np.degrees(np.concatenate(errors))
    assert off.mean() < 6
    assert (off > 15).mean() < 0.04
    assert len(off) > 0.45 * sum(contacts)
