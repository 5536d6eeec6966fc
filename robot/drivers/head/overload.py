"""Detects whiskers bent beyond the limit at which the arm must stop."""

from __future__ import annotations

import numpy as np

from robot.drivers.head.protocol import ANGLE

FULL_SCALE = 32767
"""Least counts at the end of the sensor's range."""


class OverloadDetector:
    """Finds whiskers overloaded in two consecutive samples; a single one is a transmission error or a knock.

    Args:
        limit: deflection of x or y, rad. alive: [W] bool, whiskers to check.
    """

    def __init__(self, limit: float, alive: np.ndarray) -> None:
        self._limit = min(limit / ANGLE, FULL_SCALE)
        self._alive = np.asarray(alive, bool)
        self._before = np.zeros(len(self._alive), bool)

    def check(self, values: np.ndarray) -> int | None:
        """The first whisker overloaded in values [N, W, 3], int16 counts, or between these and the previous
        ones; None without one."""
        if not len(values):
            return None
        size = np.abs(values.astype(np.int32))  # int16 has no 32768
        beyond = ((size[..., 0] >= FULL_SCALE) | (size[..., 1:] >= self._limit).any(axis=-1)) & self._alive
        twice = beyond & np.concatenate([self._before[None], beyond[:-1]])
        self._before = beyond[-1]
        return int(np.flatnonzero(twice.any(axis=0))[0]) if twice.any() else None
