"""What the network remembers: where templates were seen, and its experiences (section 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from math import exp, hypot, inf, pi
from typing import NamedTuple

from tests.oracle.cells import Pose
from tests.oracle.circle import distance, into_ring
from tests.oracle.classic.cells import Network
from tests.oracle.params import Params

RECENT = 10  # templates younger than this do not inject, or so it was meant (Q1)

Cell = tuple[int, int, int]
"""heading, y, x."""


class Action(IntEnum):
    """What the map is told. Setting a node without an edge can never happen (Q10)."""

    NONE = 0
    CREATE_NODE = 1
    CREATE_EDGE = 2


@dataclass
class Template:
    """A template as the network knows it: where it was first seen."""

    pose: Pose
    decay: float
    experiences: list[int] = field(default_factory=list)


class Experience(NamedTuple):
    """A pose on the torus together with a template."""

    pose: Pose
    template: int


class Injection(NamedTuple):
    """Energy given to a cell."""

    energy: float
    cell: Cell


def truncated(pose: Pose) -> Cell:
    """The cell a stored pose is taken for (Q2)."""
    return int(pose.th), int(pose.y), int(pose.x)


class Places:
    """Templates and experiences, and the decision which experience the robot is at.

    `cell_of` chooses the cell for a stored pose: truncation, unless somebody knows better.
    """

    def __init__(self, params: Params, cell_of: Callable[[Pose], Cell] = truncated) -> None:
        self.params = params
        self.cell_of = cell_of
        self.network = Network(params)
        self.templates: list[Template] = []
        self.experiences: list[Experience] = []
        self.current_template = self.previous_template = 0
        self.current = 0
        self.delta_heading = 0.0  # cells; kept from the last injection (Q14)
        self.seen = self.moved = False

    def on_view(self, template: int, relative: float) -> Injection | None:
        """Learns a template, or injects where a known one was learnt."""
        injection = None
        if template > len(self.templates):
            raise ValueError(f"template {template} skips ids: {len(self.templates)} are known")
        if template == len(self.templates):
            self.templates.append(Template(self.network.best, self.params.vt_active_decay))
        elif self._is_old(template):
            injection = self._inject(template, relative)
        for known in self.templates:
            known.decay = max(known.decay - self.params.pc_vt_restore, self.params.vt_active_decay)
        self.previous_template, self.current_template = self.current_template, template
        self.seen = True
        return injection

    def _is_old(self, template: int) -> bool:
        """The guard against recent templates; in unsigned arithmetic, so open below RECENT templates (Q1)."""
        return len(self.templates) < RECENT or template < len(self.templates) - RECENT

    def _inject(self, template: int, relative: float) -> Injection | None:
        """A template seen again and again tires, without limit (Q3)."""
        known = self.templates[template]
        if template == self.current_template:
            known.decay += self.params.vt_active_decay
        energy = self.params.pc_vt_inject_energy / 30 * (30 - exp(1.2 * known.decay))
        if energy <= 0:
            return None
        self.delta_heading = relative * self.params.pc_dim_th / (2 * pi)
        heading = into_ring(known.pose.th + self.delta_heading, self.params.pc_dim_th)
        injection = Injection(energy, self.cell_of(known.pose._replace(th=heading)))
        self.network.inject(injection.cell, energy)
        return injection

    def on_odometry(self, v: float, w: float, dt: float) -> None:
        """Moves the packet."""
        self.network.step(v * dt / self.params.pc_cell_x_size, w * dt)
        self.moved = True

    def delta(self, experience: Experience) -> float:
        """Distance in cells between the packet and an experience; metres and degrees count alike (Q23)."""
        best, there = self.network.best, experience.pose
        N, K = self.params.pc_dim_xy, self.params.pc_dim_th
        heading = into_ring(best.th - self.delta_heading, K)
        x, y = distance(best.x, there.x, N), distance(best.y, there.y, N)
        return hypot(x, y, distance(heading, there.th, K))

    def action(self) -> Action:
        """Decides, if there was both a view and a movement since it was last asked."""
        ready = self.seen and self.moved
        self.seen = self.moved = False
        if not ready or not self.templates:
            return Action.NONE
        known_here = self.templates[self.current_template].experiences
        if not self.experiences or not known_here:
            return self._create()
        far = self.delta(self.experiences[self.current]) > self.params.exp_delta_pc_threshold
        if not far and self.current_template == self.previous_template:
            return Action.NONE
        deltas = {e: self.delta(self.experiences[e]) for e in known_here if e != self.current}
        nearest = min(deltas, key=lambda e: deltas[e], default=-1)  # the first on ties
        if deltas.get(nearest, inf) < self.params.exp_delta_pc_threshold:
            self.current = nearest
            return Action.CREATE_EDGE
        return self._create()

    def _create(self) -> Action:
        self.current = len(self.experiences)
        self.experiences.append(Experience(self.network.best, self.current_template))
        self.templates[self.current_template].experiences.append(self.current)
        return Action.CREATE_NODE
