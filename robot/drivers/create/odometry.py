"""Odometry from what the Create tells in whole millimetres and degrees.

The robot keeps what it has not told, less than 1 mm and 1 degree, for the next reply; so nothing may be lost,
and sums stay within that of what its wheels did, however often it is read.
"""

from __future__ import annotations

import math

from tactile.base.types import Odometry


class CreateOdometry:
    """Adds readings up until they are taken.

    Args:
        time: s, host's monotonic clock, of the reading that set the robot's counters to 0.
    """

    def __init__(self, time: float) -> None:
        self._taken = self._time = time
        self._x = self._y = 0.0
        self._degrees = 0  # whole, so that a sum of any length is exact

    def add(self, millimetres: int, degrees: int, time: float) -> None:
        """One reading: an arc since the one before."""
        turned, turn = math.radians(self._degrees), math.radians(degrees)
        chord = millimetres / 1000 * (math.sin(turn / 2) / (turn / 2) if turn else 1.0)
        self._x += chord * math.cos(turned + turn / 2)
        self._y += chord * math.sin(turned + turn / 2)
        self._degrees += degrees
        self._time = time

    def take_odometry(self) -> Odometry:
        """Motion since the last time it was taken; dt ends at the last reading. The turn is not wrapped."""
        told = Odometry(self._x, self._y, math.radians(self._degrees), self._time - self._taken)
        self._taken, self._x, self._y, self._degrees = self._time, 0.0, 0.0, 0
        return told
