"""The stock engine's map: lengths of links, relaxation."""

from __future__ import annotations

import pytest

from tests.oracle.map import StockMap
from tests.oracle.places import CREATE
from tests.oracle.trace import Parameters


def test_map_double_counts_its_first_link() -> None:
    """Reaching node 0 does not reset the accumulators, so the first link is too long."""
    graph = StockMap(Parameters(exp_initial_em_deg=0.0, exp_loops=0))
    for target in range(3):
        graph.move(1.0, 0.0, 1.0)
        graph.act(CREATE, max(target - 1, 0), target, 0.0)
    assert [link.distance for link in graph.links] == [2.0, 1.0]
    graph.link(1, 0, 0.0)
    assert len(graph.links) == 2


def test_relaxation_halves_a_contradiction() -> None:
    """One link of the wrong length, half corrected from both ends, fits afterwards."""
    graph = StockMap(Parameters(exp_initial_em_deg=0.0, exp_loops=1))
    graph.act(CREATE, 0, 0, 0.0)
    graph.move(2.0, 0.0, 1.0)
    graph.act(CREATE, 0, 1, 0.0)
    graph.x[1] = 3.0
    graph.relax()
    assert graph.x == pytest.approx([0.5, 2.5])
