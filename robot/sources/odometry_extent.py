"""How far a robot goes, as far as its odometry knows: what a map has to cover."""

from __future__ import annotations

import numpy as np

from robot.sources.source import Source
from tactile.base.se2 import integrate


def extent(source: Source) -> float:
    """Largest distance from the start along either axis of the frame that it starts in, m."""
    moves = np.array([sample.reading.odometry[:3] for sample in source], float).reshape(-1, 3)
    path = integrate(np.where(np.isfinite(moves), moves, 0.0), np.zeros(3))
    return float(np.abs(path[:, :2]).max(initial=0.0))
