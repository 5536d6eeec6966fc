"""One observation is one step: first the view, then the motion, then the place."""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

from tests.oracle.cells import Pose
from tests.oracle.clean.map import Links, Move
from tests.oracle.clean.places import Action, Places
from tests.oracle.clean.settings import Settings
from tests.oracle.clean.views import Labels, Views
from tests.oracle.params import Params
from tests.oracle.trace import Row


class Outcome(NamedTuple):
    """What one row of a stream leads to."""

    template: int
    relative: float
    energy: float
    packet: Pose
    died: bool
    action: int
    previous: int
    place: int


class Engine:
    """The quirk-free engine."""

    def __init__(self, params: Params, given: bool = False, settings: Settings | None = None) -> None:
        settings = settings or Settings()
        self.views = Labels() if given else Views(params, settings)
        self.places = Places(params, settings)
        self.links = Links()
        self.cell = params.pc_cell_x_size
        self.heading_cell = 6.283185307179586 / params.pc_dim_th
        self.stamp: float | None = None

    def step(self, row: Row) -> Outcome:
        """One row of a stream; without odometry it is a step that does not move."""
        energy = 0.0
        if row.view is not None:
            match = self.views.match(row.view)
            energy = self.places.on_view(match.template, match.relative)
        move = self._odometry(row)
        died = self.places.network.step(move.x / self.cell, move.y / self.cell, move.th / self.heading_cell)
        previous = self.places.place
        action = self.places.decide() if row.view is not None else Action.NONE
        self.links.step(move, action, self.places.place, self.places.relative)
        return Outcome(
            template=self.places.template,
            relative=self.places.relative,
            energy=energy,
            packet=self.places.network.packet,
            died=died,
            action=action,
            previous=previous,
            place=self.places.place,
        )

    def _odometry(self, row: Row) -> Move:
        """The pose after the row in the frame of the pose before: driven along the heading after the turn.

        The first odometry only sets the clock.
        """
        if not row.moves:
            return Move()
        dt = 0.0 if self.stamp is None else row.time - self.stamp
        self.stamp = row.time
        turn, way = row.w * dt, row.v * dt
        return Move(way * cos(turn), way * sin(turn), turn)
