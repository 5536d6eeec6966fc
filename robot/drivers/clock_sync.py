"""Clock synchronisation: maps device time stamps to the host's clock.

A message arrives later than its time stamp, by at least the shortest transmission delay and often by much
more. The line along the lower edge of the pairs (device time, arrival time) is therefore the device's clock
in host time, up to that shortest delay, and independent of how late single messages arrive.
"""

from __future__ import annotations

from collections import deque
from threading import Lock
from typing import NamedTuple

import numpy as np

from tactile.base.types import Array

WINDOW = 30.0
"""Time span of the pairs that count, s."""
MAX_DRIFT = 200e-6
"""Largest relative drift of a device's clock; quartz oscillators stay within half of it."""
SEGMENT = 0.25
"""Pairs enter and leave the window in segments of this length, s of device time."""
JUMP = 0.1
"""An arrival earlier than the fitted line by this much, s, means that the device's clock jumped forward.
Smaller differences occur after a period of late arrivals on a busy host."""
RESIDUAL_QUANTILE = 0.1
"""Quantile of the delays above the line that is reported as the residual."""
MIN_SPAN = 1.0
"""Jumps are detected once the pairs span this time, s."""

Point = tuple[float, float]


class ClockFit(NamedTuple):
    """host = arrival + scale (device - `device`).

    Attributes:
        device, arrival: s, a point on the line. scale: host seconds per device second.
    """

    device: float
    arrival: float
    scale: float

    def at(self, device: Array) -> Array:
        return self.arrival + self.scale * (device - self.device)


class ClockSync:
    """Fits host time as a line over device time; a jump of the device's clock restarts the fit.

    The result depends on the observations only. One thread may observe while others read.

        Attributes:
            jumps: number of jumps of the device's clock. A step back by less than the time between two
                observations is not detected; the fit follows it as older pairs leave the window.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._lock = Lock()
        self._restart()

    def observe(self, device: float, arrival: float) -> None:
        """Adds a pair of device time and arrival time, s; arrivals in order."""
        device, arrival = float(device), float(arrival)
        with self._lock:
            if self._has_jumped(device, arrival):
                self.jumps += 1
                self._restart()
            self._newest = device
            if not self._pieces or device - self._pieces[-1].begin >= SEGMENT:
                self._pieces.append(_Segment(device))
                while self._pieces[0].begin < device - WINDOW:
                    self._pieces.popleft()
                self._pieces[-1].add(device, arrival)
                self._line = self._edge()
            else:
                self._pieces[-1].add(device, arrival)
                if arrival < self._line.at(device):
                    self._line = self._edge()

    def to_host(self, device: Array) -> Array:
        """Host time, s, of device times [...] s.

        Raises:
            ValueError: no observation yet.
        """
        return self._known().at(device)

    @property
    def scale(self) -> float:
        """Host seconds per device second; 1 before the first observation."""
        return self._line.scale

    @property
    def residual(self) -> float:
        """The 10 % quantile of the delays above the line, s; 0 before any. A large value means that few
        messages define the line; the delay of the others does not matter."""
        with self._lock:
            points = [point for piece in self._pieces for point in piece.points]
            line = self._line
        if not points:
            return 0.0
        device, arrival = np.array(points).T
        late = arrival - line.at(device)
        return float(np.quantile(late, RESIDUAL_QUANTILE))

    def _known(self) -> ClockFit:
        if not self._pieces:
            raise ValueError("no observation of the device's clock yet")
        return self._line

    def _restart(self) -> None:
        self._pieces: deque[_Segment] = deque()
        self._line = ClockFit(0.0, 0.0, 1.0)
        self._newest = -np.inf

    def _has_jumped(self, device: float, arrival: float) -> bool:
        if not self._pieces:
            return False
        if device < self._newest:
            return True
        # Only early arrivals count, since late ones occur on every busy host.
        settled = device - self._pieces[0].begin >= MIN_SPAN
        return settled and arrival - self._line.at(device) < -JUMP

    def _edge(self) -> ClockFit:
        """The lower edge: the hull edge below the middle of the points, or, where its slope is beyond the
        drift limit, the line of limited slope that touches the hull."""
        corners: list[Point] = []
        for piece in self._pieces:
            for point in piece.hull:
                _extend_hull(corners, point)
        middle = (corners[0][0] + corners[-1][0]) / 2
        right = next((k for k, (device, _) in enumerate(corners) if device > middle), 0)
        if not right:
            return ClockFit(*corners[0], 1.0)
        (x0, y0), (x1, y1) = corners[right - 1], corners[right]
        scale = (y1 - y0) / (x1 - x0)
        if abs(scale - 1) <= MAX_DRIFT:
            return ClockFit(x0, y0, scale)
        scale = 1 + float(np.clip(scale - 1, -MAX_DRIFT, MAX_DRIFT))
        touched = min(corners, key=lambda corner: corner[1] - y0 - scale * (corner[0] - x0))
        return ClockFit(*touched, scale)


class _Segment:
    """A short span of pairs, with its lower convex hull."""

    def __init__(self, begin: float) -> None:
        self.begin = begin
        self.points: list[Point] = []
        self.hull: list[Point] = []

    def add(self, device: float, arrival: float) -> None:
        self.points.append((device, arrival))
        _extend_hull(self.hull, (device, arrival))


def _extend_hull(hull: list[Point], point: Point) -> None:
    """Appends a point, not left of any other, to a lower convex hull."""
    x, y = point
    if hull and hull[-1][0] == x:
        if hull[-1][1] <= y:
            return
        hull.pop()
    while len(hull) > 1:
        (x0, y0), (x1, y1) = hull[-2], hull[-1]
        if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
            break
        hull.pop()
    hull.append(point)
