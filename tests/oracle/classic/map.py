"""The experience map and its relaxation (section 5)."""

from __future__ import annotations

from math import atan2, cos, hypot, pi, radians, sin
from typing import NamedTuple

from tests.oracle.circle import wrap
from tests.oracle.params import Params


class Link(NamedTuple):
    """A directed link as it was measured; delta_time counts from the start of the run (Q8)."""

    source: int
    target: int
    d: float
    heading: float
    facing: float
    delta_time: float


class ExperienceMap:
    """Nodes, links, and the odometry since the current node in the world frame of that moment (Q9)."""

    def __init__(self, params: Params) -> None:
        self.correction = params.exp_correction
        self.loops = params.exp_loops
        self.x: list[float] = []
        self.y: list[float] = []
        self.th: list[float] = []
        self.outgoing: list[list[Link]] = []
        self.joined: set[tuple[int, int]] = set()
        self.current = 0
        self.dx = self.dy = self.time = 0.0
        self.facing = radians(params.exp_initial_em_deg)

    @property
    def links(self) -> list[Link]:
        """By node, then in the order they were made."""
        return [link for links in self.outgoing for link in links]

    def on_odometry(self, v: float, w: float, dt: float) -> None:
        """Turns first, then moves along the new heading (Q13)."""
        self.facing = wrap(self.facing + w * dt)
        self.dx += v * dt * cos(self.facing)
        self.dy += v * dt * sin(self.facing)
        self.time += dt

    def create(self) -> None:
        """A node where odometry is, linked from the current one."""
        first = not self.x
        self.x.append((0.0 if first else self.x[self.current]) + self.dx)
        self.y.append((0.0 if first else self.y[self.current]) + self.dy)
        self.th.append(self.facing)
        self.outgoing.append([])
        if not first:
            self.link(self.current, len(self.x) - 1, 0.0)

    def link(self, a: int, b: int, relative: float) -> None:
        """At most one link joins two nodes, however often the way is travelled (Q11)."""
        if (a, b) in self.joined or (b, a) in self.joined:
            return
        self.joined.add((a, b))
        heading = wrap(atan2(self.dy, self.dx) - self.th[a])
        facing = wrap(wrap(self.facing + relative) - self.th[a])
        self.outgoing[a].append(Link(a, b, hypot(self.dx, self.dy), heading, facing, self.time))

    def set(self, node: int, relative: float) -> None:
        """The robot is at a node; at node 0 the first time, this is forgotten (Q7)."""
        if node == self.current:
            return
        self.current = node
        self.dx = self.dy = 0.0
        self.facing = wrap(self.th[node] + relative)

    def iterate(self) -> None:
        """Gauss-Seidel sweeps in place: by node, then by outgoing link; no node is anchored."""
        x, y, th, g = self.x, self.y, self.th, self.correction
        links = [(k.source, k.target, k.d, k.heading, k.facing) for k in self.links]
        # The time of a run goes here: the angle is brought back by hand, as `wrap` would.
        for _ in range(self.loops):
            for a, b, d, heading, facing in links:
                along = th[a] + heading
                ex = g * (x[b] - (x[a] + d * cos(along)))
                ey = g * (y[b] - (y[a] + d * sin(along)))
                error = th[b] - th[a] - facing
                eth = g * (error if -pi < error <= pi else wrap(error))
                x[a] += ex
                y[a] += ey
                x[b] -= ex
                y[b] -= ey
                turned = th[a] + eth
                th[a] = turned if -pi < turned <= pi else wrap(turned)
                turned = th[b] - eth
                th[b] = turned if -pi < turned <= pi else wrap(turned)
