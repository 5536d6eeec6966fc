"""Templates with their habituation, and the places made of them (semantics, parts 1 and 4)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import exp, inf, pi, sqrt
from typing import NamedTuple

from tests.oracle.cells import Pose
from tests.oracle.circle import around
from tests.oracle.clean.cells import Network
from tests.oracle.clean.settings import Settings
from tests.oracle.params import Params

SLACK = 1e-9
MUTE = 3.0  # habituation beyond which there is nothing left to inject, and to recover from


class Action(IntEnum):
    """What happened to the place."""

    NONE = 0
    CREATE = 1
    LINK = 2
    SET = 3


@dataclass
class Template:
    """Where a template was learnt, and how used one is to it."""

    packet: Pose
    habituation: float


class Place(NamedTuple):
    """A pose on the torus, freed of the view's relative heading, with its template."""

    packet: Pose
    template: int


class Places:
    """Which template and which place the robot is at."""

    def __init__(self, params: Params, settings: Settings) -> None:
        self.params = params
        self.recent = settings.recent
        self.radius = params.exp_delta_pc_threshold
        self.network = Network(params, settings)
        self.templates: list[Template] = []
        self.places: list[Place] = []
        self.joined: set[frozenset[int]] = set()
        self.template = self.place = -1
        self.relative = 0.0

    def on_view(self, template: int, relative: float) -> float:
        """Learns a template, or recalls one; the energy injected."""
        rest = self.params.vt_active_decay
        novel = template == len(self.templates)
        energy = 0.0 if novel else self._recall(template)
        for known in self.templates:
            known.habituation = max(known.habituation - self.params.pc_vt_restore, rest)
        if novel:
            self.templates.append(Template(self.network.packet, rest))
        self.template, self.relative = template, 0.0 if novel else relative
        if energy > 0:
            self.network.inject(self._seen_from(self.templates[template].packet, +1), energy)
        return energy

    def _recall(self, template: int) -> float:
        known, rest = self.templates[template], self.params.vt_active_decay
        if template == self.template:
            known.habituation = min(known.habituation + rest, max(MUTE, rest))
        if template + self.recent >= len(self.templates):
            return 0.0
        return max(self.params.pc_vt_inject_energy / 30 * (30 - exp(1.2 * known.habituation)), 0.0)

    def _seen_from(self, packet: Pose, sign: int) -> Pose:
        """A packet with the view's relative heading put on (+1) or taken off (-1)."""
        K = self.params.pc_dim_th
        return packet._replace(th=(packet.th + sign * self.relative * K / (2 * pi)) % K)

    def decide(self) -> Action:
        """After a view and the motion: the place kept, reached or made."""
        here = self._seen_from(self.network.packet, -1)
        if self.place >= 0:
            current = self.places[self.place]
            if current.template == self.template and self.far(here, current) <= 1 + SLACK:
                return Action.NONE
        near = {
            e: far
            for e, place in enumerate(self.places)
            if e != self.place
            and place.template == self.template
            and (far := self.far(here, place)) < 1 - SLACK
        }
        if near:
            reached = next(e for e, far in near.items() if far <= min(near.values()) + SLACK)
            known = self.place < 0 or not self._join(reached)
            self.place = reached
            return Action.SET if known else Action.LINK
        self.places.append(Place(here, self.template))
        if self.place >= 0:
            self._join(len(self.places) - 1)
        self.place = len(self.places) - 1
        return Action.CREATE

    def _join(self, other: int) -> bool:
        """Joins the present place with another; whether they were apart."""
        pair = frozenset((self.place, other))
        apart = pair not in self.joined
        self.joined.add(pair)
        return apart

    def far(self, here: Pose, place: Place) -> float:
        """Distance in radii."""
        sizes = (self.params.pc_dim_xy, self.params.pc_dim_xy, self.params.pc_dim_th)
        apart = (around(a - b, n) / self.radius if self.radius else inf
                 for a, b, n in zip(here, place.packet, sizes, strict=True))  # fmt: skip
        return sqrt(sum(d * d for d in apart))
