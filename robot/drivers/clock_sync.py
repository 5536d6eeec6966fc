"""Clock synchronisation: maps device time stamps to the host's clock.

A message arrives later than its time stamp, by at least the shortest transmission delay and often by much
more. The line along the lower edge of the pairs (device time, arrival time) is therefore the device's clock
in host time, up to that shortest delay, and independent of how late single messages arrive.
"""

from __future__ import annotations

from collections import deque
from threading import Lock

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
Line = tuple[float, float, float]
"""A point on the fitted line, device and host time in s, and its slope, host seconds per device second."""


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
        self._pieces: deque[_Segment]
        self._line: Line
        self._newest: float  # device time of the last observation
        self._restart()

    def observe(self, device: float, arrival: float) -> None:
        """Adds a pair of device time and arrival time, s; arrivals in order."""
        device, arrival = float(device), float(arrival)
        with self._lock:
            # Only early arrivals count, since late ones occur on every busy host.
            settled = bool(self._pieces) and device - self._pieces[0].begin >= MIN_SPAN
            if device < self._newest or (settled and arrival - _on_line(self._line, device) < -JUMP):
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
                if arrival < _on_line(self._line, device):
                    self._line = self._edge()

    def to_host(self, device: Array) -> Array:
        """Host time, s, of device times [...] s.

        Raises:
            ValueError: no observation yet.
        """
        if not self._pieces:
            raise ValueError("no observation of the device's clock yet")
        return _on_line(self._line, device)

    @property
    def scale(self) -> float:
        """Host seconds per device second; 1 before the first observation."""
        return self._line[2]

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
        late = arrival - _on_line(line, device)
        return float(np.quantile(late, RESIDUAL_QUANTILE))

    def _restart(self) -> None:
        self._pieces = deque()
        self._line = (0.0, 0.0, 1.0)
        self._newest = -np.inf

    def _edge(self) -> Line:
        """The lower edge: the hull edge below the middle of the points, or, where its slope is beyond the
        drift limit, the line of limited slope that touches the hull."""
        corners: list[Point] = []
        for piece in self._pieces:
            for point in piece.hull:
                _extend_hull(corners, point)
        middle = (corners[0][0] + corners[-1][0]) / 2
        right = next((k for k, (device, _) in enumerate(corners) if device > middle), 0)
        if not right:
            return (*corners[0], 1.0)
        (x0, y0), (x1, y1) = corners[right - 1], corners[right]
        scale = (y1 - y0) / (x1 - x0)
        if abs(scale - 1) <= MAX_DRIFT:
            return x0, y0, scale
        scale = 1 + float(np.clip(scale - 1, -MAX_DRIFT, MAX_DRIFT))
        touched = min(corners, key=lambda corner: corner[1] - y0 - scale * (corner[0] - x0))
        return (*touched, scale)


class _Segment:
    """A short span of pairs, with its lower convex hull."""

    def __init__(self, begin: float) -> None:
        self.begin = begin
        self.points: list[Point] = []
        self.hull: list[Point] = []

    def add(self, device: float, arrival: float) -> None:
        self.points.append((device, arrival))
        _extend_hull(self.hull, (device, arrival))


def _on_line(line: Line, device: Array) -> Array:
    """Host time, s, of device times [...] s."""
    begin, arrival, scale = line
    return arrival + scale * (device - begin)


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
