"""The experience map (section 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tests.oracle.places import CREATE, NONE
from tests.oracle.trace import Parameters
from tests.oracle.views import wrapped


@dataclass(frozen=True)
class Link:
    """A directed link: distance, its direction and the turn, both seen from the start, and the time."""

    start: int
    end: int
    distance: float
    heading: float
    facing: float
    time: float


class StockMap:
    """Section 5: nodes and links, relaxed in place, with the accumulators in the world frame (Q9)."""

    def __init__(self, parameters: Parameters) -> None:
        self.correction = parameters.exp_correction
        self.loops = parameters.exp_loops
        self.x: list[float] = []
        self.y: list[float] = []
        self.th: list[float] = []
        self.outgoing: list[list[Link]] = []
        self.links: list[Link] = []  # in order of creation
        self.current = 0
        self.dx = self.dy = self.time = 0.0
        self.facing = math.radians(parameters.exp_initial_em_deg)

    def move(self, v: float, w: float, dt: float) -> None:
        """`on_odo`: turn first, then advance (Q13)."""
        self.facing = wrapped(self.facing + w * dt)
        self.dx += v * dt * math.cos(self.facing)
        self.dy += v * dt * math.sin(self.facing)
        self.time += dt

    def act(self, action: int, source: int, target: int, relative: float) -> None:
        """`on_action`, then always one relaxation; nothing else relaxes the map."""
        if action == NONE:
            return
        if action == CREATE:
            self.create()
            self.set(target, 0.0)
        else:
            self.link(source, target, relative)
            self.set(target, relative)
        self.relax()

    def create(self) -> None:
        """Adds a node at the pose by odometry."""
        first = not self.x
        self.x.append((0.0 if first else self.x[self.current]) + self.dx)
        self.y.append((0.0 if first else self.y[self.current]) + self.dy)
        self.th.append(self.facing)
        self.outgoing.append([])
        if not first:
            self.link(self.current, len(self.x) - 1, 0.0)

    def link(self, a: int, b: int, relative: float) -> None:
        """Join two nodes unless they are joined in either direction. The time is never cleared (Q8)."""
        joined = any(k.end == b for k in self.outgoing[a]) or any(k.end == a for k in self.outgoing[b])
        if joined:
            return
        heading = wrapped(math.atan2(self.dy, self.dx) - self.th[a])
        facing = wrapped(wrapped(self.facing + relative) - self.th[a])
        link = Link(a, b, math.hypot(self.dx, self.dy), heading, facing, self.time)
        self.outgoing[a].append(link)
        self.links.append(link)

    def set(self, node: int, relative: float) -> None:
        """Goes to a node. At the current node, as after node 0, nothing is cleared (Q7)."""
        if node == self.current:
            return
        self.current = node
        self.dx = self.dy = 0.0
        self.facing = wrapped(self.th[node] + relative)

    def relax(self) -> None:
        """`iterate`: Gauss-Seidel over all links; no node is anchored.

        Lists of floats and no calls but sine and cosine, because this loop takes most of the time.
        """
        x, y, th, g = self.x, self.y, self.th, self.correction
        pi, turn, cos, sin = math.pi, 2 * math.pi, math.cos, math.sin
        by_node = (link for outgoing in self.outgoing for link in outgoing)
        links = [(k.start, k.end, k.distance, k.heading, k.facing) for k in by_node]
        for _ in range(self.loops):
            for a, b, distance, heading, facing in links:
                direction = th[a] + heading
                ex = g * (x[b] - (x[a] + distance * cos(direction)))
                ey = g * (y[b] - (y[a] + distance * sin(direction)))
                eth = th[b] - th[a] - facing
                while eth > pi:
                    eth -= turn
                while eth <= -pi:
                    eth += turn
                x[a] += ex
                y[a] += ey
                x[b] -= ex
                y[b] -= ey
                new = th[a] + g * eth
                while new > pi:
                    new -= turn
                while new <= -pi:
                    new += turn
                th[a] = new
                new = th[b] - g * eth
                while new > pi:
                    new -= turn
                while new <= -pi:
                    new += turn
                th[b] = new
