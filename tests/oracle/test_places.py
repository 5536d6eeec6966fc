"""Places of the stock engine: recent templates, energy of injections, actions."""

from __future__ import annotations

import pytest

from tests.oracle.places import CREATE, EDGE, NONE, StockPlaces
from tests.oracle.trace import Parameters


def test_recent_templates() -> None:
    """With fewer than ten templates all pass the unsigned comparison, with ten none."""
    places = StockPlaces(Parameters())
    pose = (1.0, 1.0, 1.0)
    for template in range(9):
        assert places.see(template, 0.0, pose) is None
    assert places.see(7, 0.0, pose) is not None
    assert places.see(9 - 1, 0.0, pose) is not None
    places.see(9, 0.0, pose)
    assert places.see(0, 0.0, pose) is None
    with pytest.raises(ValueError, match="skips ids"):
        places.see(12, 0.0, pose)


def test_energy_falls_with_consecutive_matches() -> None:
    """0.889 and 0.633 of the full energy, then 0."""
    places = StockPlaces(Parameters(pc_vt_inject_energy=1.0))
    for template in range(2):
        places.see(template, 0.0, (1.0, 1.0, 1.0))
    energies = [recalled[0] if (recalled := places.see(0, 0.0, (0.0, 0.0, 0.0))) else 0.0 for _ in range(3)]
    assert energies == pytest.approx([0.8893, 0.6326, 0.0], abs=1e-4)


def test_actions() -> None:
    """Create, go back by an edge, and nothing without both messages."""
    places = StockPlaces(Parameters())
    places.see(0, 0.0, (1.0, 1.0, 1.0))
    assert places.act((1.0, 1.0, 1.0)) == NONE
    expected = [(0, CREATE), (1, CREATE), (1, NONE), (0, EDGE)]
    for template, action in expected:
        places.see(template, 0.0, (1.0, 1.0, 1.0))
        places.moved = True
        assert places.act((1.0, 1.0, 1.0)) == action
