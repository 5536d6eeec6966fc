"""A device's clock as seen from the host: when did happen what the device stamped?

What a device stamped arrives later than it happened, never earlier: by at least the way's shortest delay,
often by much more. So the line along the lower edge of the pairs (device's time, time of arrival) is the
device's clock in the host's time, up to that shortest delay, however late single pairs come.
"""

from __future__ import annotations

from collections import deque
from threading import Lock
from typing import NamedTuple

import numpy as np

from tactile.base.types import Array

WINDOW = 30.0
"""How long pairs count, s."""
MAX_DRIFT = 200e-6
"""How far a device's second can be from the host's, as a share: quartzes stay within half of it."""
SEGMENT = 0.25
"""s of device time that enter and leave the window together."""
JUMP = 0.1
"""An arrival so much before the line, s, tells that the device's clock went forward by itself. Less is what a
host that was busy for long leaves: its line is too late until something comes in time again."""
RESIDUAL_QUANTILE = 0.1
"""Share of arrivals that should come as fast as they can."""
MIN_SPAN = 1.0
"""s of pairs from which on the line is trusted to tell it."""

Point = tuple[float, float]


class ClockFit(NamedTuple):
    """host = arrival + scale (device - `device`).

    Attributes:
        device, arrival: s, a point of it. scale: host's seconds in a device's second.
    """

    device: float
    arrival: float
    scale: float

    def at(self, device: Array) -> Array:
        return self.arrival + self.scale * (device - self.device)


class ClockSync:
    """The line through what was observed; a jump of the device's clock starts it anew.

    It depends on the observations alone. One thread may observe while others ask.

    Attributes:
        jumped: how often the device's clock went back or ahead. A step back by less than the time between two
            observations is not told; it is followed as the pairs before it leave the window.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._lock = Lock()
        self._restart()

    def observe(self, device: float, arrival: float) -> None:
        """What the device stamped so has arrived then; both s, arrivals in their order."""
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
        """The host's time, s, of a device's [...] s.

        Raises:
            ValueError: nothing was observed yet.
        """
        return self._known().at(device)

    @property
    def scale(self) -> float:
        """Host's seconds in a device's second; 1 before anything was observed."""
        return self._line.scale

    @property
    def residual(self) -> float:
        """How far above the line the earliest tenth of arrivals lies, s; 0 before any. Where it is large the
        line hangs on a few lucky ones; how late the others come does not matter."""
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
            raise ValueError("a clock that has observed nothing")
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
        # Late arrivals tell nothing: a busy host is late for as long as it is busy.
        settled = device - self._pieces[0].begin >= MIN_SPAN
        return settled and arrival - self._line.at(device) < -JUMP

    def _edge(self) -> ClockFit:
        """The line below all points that comes closest to them: it passes under their middle along an edge of
        their hull, or touches it where the scale cannot be that of a clock."""
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
    """Pairs of a moment: all, and the lower hull of them."""

    def __init__(self, begin: float) -> None:
        self.begin = begin
        self.points: list[Point] = []
        self.hull: list[Point] = []

    def add(self, device: float, arrival: float) -> None:
        self.points.append((device, arrival))
        _extend_hull(self.hull, (device, arrival))


def _extend_hull(hull: list[Point], point: Point) -> None:
    """The lower hull with one more point, which is not left of any."""
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
