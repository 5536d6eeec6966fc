"""The odometry since the newest keyframe."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from tactile.base.se2 import compose


class Travel(NamedTuple):
    """Odometry added up: motion [3] (m, m, rad), distance m, sum of absolute turns rad."""

    motion: np.ndarray
    length: float
    turn: float

    def onwards(self, odometry: Any) -> Travel:
        """With one more step, if that is finite: the kernel reports as an outcome what is not, and NaN would
        spoil the whole map."""
        moved = np.array([float(odometry.dx), float(odometry.dy), float(odometry.dtheta)])
        if not np.isfinite(moved).all():
            return self
        length = self.length + float(np.hypot(moved[0], moved[1]))
        return Travel(compose(self.motion, moved), length, self.turn + abs(moved[2]))


HALT = Travel(np.zeros(3), 0.0, 0.0)
