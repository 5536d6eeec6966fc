"""Odometry from the whole millimetres and degrees that the Create reports.

The robot keeps the remainder below 1 mm and 1 degree for the next reply. Unless a reply is lost, sums
stay within these bounds of the wheels' motion, at any reading rate.
"""

from __future__ import annotations

import math

from tactile.base.types import Odometry


class CreateOdometry:
    """Accumulates readings until they are taken.

    Args:
        time: host time of the reading that cleared the robot's counters, s.
    """

    def __init__(self, time: float) -> None:
        self._taken = self._time = time
        self._x = self._y = 0.0
        self._degrees = 0  # an integer, so that the sum is exact

    def add(self, millimetres: int, degrees: int, time: float) -> None:
        """Adds a reading (mm, degrees, host time s): an arc since the previous one."""
        turned, turn = math.radians(self._degrees), math.radians(degrees)
        chord = millimetres / 1000 * (math.sin(turn / 2) / (turn / 2) if turn else 1.0)
        self._x += chord * math.cos(turned + turn / 2)
        self._y += chord * math.sin(turned + turn / 2)
        self._degrees += degrees
        self._time = time

    def take_odometry(self) -> Odometry:
        """Motion since the last call; dt ends at the last reading. The turn is not wrapped."""
        motion = Odometry(self._x, self._y, math.radians(self._degrees), self._time - self._taken)
        self._taken, self._x, self._y, self._degrees = self._time, 0.0, 0.0, 0
        return motion
