"""The engine: one trace row after the other (section 2)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from tests.oracle.cells import Cell, Pose, StockCells, truncated
from tests.oracle.map import StockMap
from tests.oracle.places import NONE, StockPlaces
from tests.oracle.trace import Parameters, Row
from tests.oracle.views import Match, StockTemplates


@dataclass(frozen=True)
class Step:
    """Decisions of the stock engine in one row."""

    match: Match | None
    energy: float
    injected: Cell | None
    delta: float
    action: int
    source: int
    target: int


class StockEngine:
    """The three processes of section 2 in the order of a trace row: view, map, network, action, map."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.templates = StockTemplates(parameters)
        self.cells = StockCells(parameters)
        self.places = StockPlaces(parameters)
        self.map = StockMap(parameters)
        # A stamp of exactly 0 means that there was no message before (Q22).
        self.stamp = 0.0

    def step(self, row: Row, truncate: Callable[[Pose], Cell] = truncated) -> Step:
        """One row; `truncate` chooses the cell of an injection."""
        match, energy, injected = None, 0.0, None
        if row.seen:
            match = self.match(row)
            recalled = self.places.see(match.template, match.relative, self.cells.best)
            if recalled:
                injected = self.cells.inject(*recalled, truncate)
                energy = recalled[0] if injected else 0.0
        source, delta, action = self.places.experience, math.nan, NONE
        if self.places.experiences:
            delta = self.places.delta(source, self.cells.best)
        if row.odometry and self.stamp != 0:
            dt = row.stamp - self.stamp
            self.map.move(row.v, row.w, dt)
            self.cells.move(row.v, row.w, dt)
            self.places.moved = True
            if self.places.experiences:
                delta = self.places.delta(source, self.cells.best)
            action = self.places.act(self.cells.best)
            relative = self.places.turned * 2 * math.pi / self.parameters.pc_dim_th
            self.map.act(action, source, self.places.experience, relative)
        if row.odometry:
            self.stamp = row.stamp
        return Step(match, energy, injected, delta, action, source, self.places.experience)

    def match(self, row: Row) -> Match:
        """The template of the row's view, or the template given in the row."""
        if row.label is not None:
            template, relative = row.label
            return Match(template, 0.0, relative, novel=template >= len(self.places.memories))
        assert row.view is not None
        return self.templates.see(row.view)
