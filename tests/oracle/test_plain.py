"""Pose cells and places of the plain engine."""

from __future__ import annotations

import numpy as np
import pytest

from tests.oracle.places import CREATE, EDGE, NONE, SET
from tests.oracle.plain import PlainCells, PlainPlaces, around, shifted
from tests.oracle.trace import Parameters
from tests.oracle.trace_cases import SETTINGS


def test_plain_shift_is_circular() -> None:
    """Activity is conserved at the edges, in both directions."""
    layers = np.zeros((2, 5, 5))
    layers[:, 0, 4] = 1.0
    moved = shifted(layers, np.array([0.25, -0.25]), 2)
    assert moved[0, 0, 0] == 0.25
    assert moved[1, 0, 3] == 0.25
    assert moved.sum(axis=(1, 2)) == pytest.approx([1.0, 1.0])
    assert around(4.5, 5) == pytest.approx(-0.5)


def test_plain_network_restarts() -> None:
    """Uniform activity dies out and is reseeded at the last decoded pose."""
    cells = PlainCells(Parameters(pc_dim_xy=9, pc_dim_th=12), SETTINGS)
    cells.activity[:] = 1.0 / cells.activity.size
    cells.best = (3.0, 4.0, 5.0)
    cells.move((0.0, 0.0, 0.0), injected=False)
    assert cells.best == pytest.approx((3.0, 4.0, 5.0))
    assert cells.activity[5, 4, 3] == 1.0
    assert cells.lag == (0.0, 0.0, 0.0)


def test_plain_places() -> None:
    """Created, linked once, and set when it is joined already."""
    places = PlainPlaces(Parameters(pc_dim_xy=20))
    a, b, c = (1.0, 1.0, 1.0), (6.0, 1.0, 1.0), (11.0, 1.0, 1.0)
    actions = [places.act(*at) for at in ((a, 0), (a, 0), (b, 1), (c, 2), (a, 0), (c, 2))]
    assert actions == [CREATE, NONE, CREATE, CREATE, EDGE, SET]
