"""Motion of a Create from its replies: whole millimetres and degrees, or the counts of encoders.

A Create 1 that loses the rest below 1 mm and 1 degree at each reading is read seldom, and of what a reading
leaves open, up to one unit, the part is taken that the commanded motion tells.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from robot.drivers.create.driver_config import CreateConfig
from robot.drivers.create.protocol import COUNT, MODELS, STATE_QUERY, SensorReply
from tactile.base.types import Odometry

LONG_WAY, LONG_TURN = 500.0, 400.0
"""Commanded motion after which a robot that loses remainders is read, mm and degrees."""
LEAST_MOVING = 40
"""Readings of a moving robot from which on small ones are doubted."""


class CreateReading(NamedTuple):
    """A reading of the counters, as the robot reported it.

    Attributes:
        asked, replied: s, host. expected: (mm, degrees) by the commands since the reading before. reply: of
            the robot.
    """

    asked: float
    replied: float
    expected: tuple[float, float]
    reply: SensorReply

    @property
    def row(self) -> tuple[float, ...]:
        """Asked, replied, expected, reported way (mm) and turn (degrees), encoders (NaN without)."""
        encoders = self.reply.encoders or (math.nan, math.nan)
        return (self.asked, self.replied, *self.expected, *self.reply[:2], *encoders)


class WheelCounters:
    """The motion between replies, in the units of the robot; chooses the query of each poll.

    Args:
        time: from which on motion is expected, s.

    Attributes:
        due: whether the next poll must read the counters.
    """

    def __init__(self, config: CreateConfig, time: float) -> None:
        self._config, self._model = config, MODELS[config.model]
        self._speeds, self._since = (0, 0), time  # last command, mm/s right and left; end of `expected`
        self.expected = (0.0, 0.0)
        self._encoders: tuple[int, int] | None = None
        self._moving = np.zeros((2, 2), int)  # replies in motion, and of these at most one unit: way, turn
        self.due = True

    def command(self, right: int, left: int, time: float) -> None:
        """Notes the wheel speeds that were sent, mm/s."""
        self._expect(time)
        self._speeds = right, left

    def query(self, right: int, left: int, time: float) -> bytes:
        """The query of a poll before these speeds are sent, mm/s."""
        self._expect(time)
        way, turn = map(abs, self.expected)
        moves_on = self._speeds == (right, left) != (0, 0) and way < LONG_WAY and turn < LONG_TURN
        waits = self._config.remainders == "lost" and moves_on and not self.due
        return STATE_QUERY if waits and self._config.model == "create1" else self._model.query

    def read(self, reply: SensorReply) -> tuple[float, float]:
        """The motion since the last reading, mm and degrees."""
        expected, self.expected, self.due = self.expected, (0.0, 0.0), False
        if reply.encoders is not None:
            before, self._encoders = self._encoders or reply.encoders, reply.encoders
            left, right = COUNT * count_steps(np.subtract(reply.encoders, before), self._config.wrap)
            turn = math.degrees((right - left) / 1000 / self._config.wheel_base)
            return float(left + right) / 2, turn
        counts = reply.millimetres, reply.degrees
        moves = np.abs(expected) > 0.01
        self._moving += np.stack([moves, moves & (np.abs(counts) <= 1)])
        if self._config.remainders != "lost":
            return counts
        scales = self._config.distance_scale, self._config.turn_scale
        return (
            complete_count(counts[0], expected[0] / scales[0]),
            complete_count(counts[1], expected[1] / scales[1]),
        )

    @property
    def doubt(self) -> str:
        """What speaks against the sums of the replies; '' for nothing."""
        for all, few, unit in zip(*self._moving, ("mm", "degree"), strict=True):
            if self._config.remainders == "unknown" and all >= LEAST_MOVING and 2 * few >= all:
                said = f"{few} of {all} replies in motion are 0 or 1 {unit}: if the robot loses the rest,"
                return f"{said} this is hardly reported; `python -m ratslam check robot create` tells"
        return ""

    def _expect(self, time: float) -> None:
        (right, left), seconds = self._speeds, time - self._since
        turn = math.degrees((right - left) / 1000 / self._config.wheel_base)
        self.expected = (
            self.expected[0] + (right + left) / 2 * seconds,
            self.expected[1] + turn * seconds,
        )
        self._since = time


def count_steps(differences: np.ndarray, wrap: int) -> np.ndarray:
    """Counts of encoders from differences of their values, which start again after `wrap`."""
    return (differences + wrap // 2) % wrap - wrap // 2


def complete_count(count: int, expected: float) -> float:
    """A count, cut towards zero, with the remainder that an expected value tells."""
    return float(np.clip(expected, count - (count <= 0), count + (count >= 0)))


class CreateOdometry:
    """Sums readings into a body-frame motion.

    Args:
        time: host time of the reading that cleared the robot's counters, s. scales: true over reported way
            and turn.
    """

    def __init__(self, time: float, scales: tuple[float, float] = (1.0, 1.0)) -> None:
        self._taken = self._time = time
        self._scales = scales
        self._x = self._y = 0.0
        self._degrees = 0.0

    def add(self, millimetres: float, degrees: float, time: float) -> None:
        """Adds a reading (mm, degrees, host time s): an arc since the previous one."""
        turned, turn = (math.radians(angle) * self._scales[1] for angle in (self._degrees, degrees))
        way = self._scales[0] * millimetres / 1000
        chord = way * (math.sin(turn / 2) / (turn / 2) if turn else 1.0)
        self._x += chord * math.cos(turned + turn / 2)
        self._y += chord * math.sin(turned + turn / 2)
        self._degrees += degrees
        self._time = time

    def take_odometry(self) -> Odometry:
        """Motion since the last call; dt ends at the last reading. The turn is not wrapped."""
        turn = math.radians(self._degrees) * self._scales[1]
        motion = Odometry(self._x, self._y, turn, self._time - self._taken)
        self._taken, self._x, self._y, self._degrees = self._time, 0.0, 0.0, 0.0
        return motion
