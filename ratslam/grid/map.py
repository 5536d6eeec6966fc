"""The map of the grid filter: the mean path of the surviving particles, and contacts drawn along it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ratslam.core.backend import Map
from ratslam.core.checkpoint import Checkpointed
from ratslam.core.estimates import Estimate, GridDrawing
from ratslam.core.growable_array import GrowableArray
from ratslam.grid.config import GridConfig
from ratslam.grid.genealogy import Genealogy
from ratslam.grid.map_drawing import ContactLog, contact_log, draw_occupancy
from tactile.base.types import Observation
from tactile.whiskers.planar_whiskers import PlanarWhiskers


class GridMap(Checkpointed, Map):
    """The map of the grid filter.

    Args:
        feelers: the whiskers of the observations. side: of the map, cells.
    """

    PARTS = ("_genealogy",)

    def __init__(self, config: GridConfig, feelers: PlanarWhiskers, side: int) -> None:
        self.config, self.feelers, self.side = config, feelers, side
        whiskers = len(feelers.length)
        self._genealogy = Genealogy(config.particles)
        self._online = GrowableArray((3,), np.float64)
        self._motion = GrowableArray((), np.int64)
        self._flags = GrowableArray((whiskers, 2), bool)  # in contact, alive
        self._point = GrowableArray((whiskers, 2), np.float64)
        self._wall = GrowableArray((2,), np.float64)  # nearest point; NaN: unknown

    def update(self, observation: Observation, estimate: Estimate, evidence: Any) -> Estimate:
        """Stores the particles and the contacts."""
        self._genealogy.append(evidence.poses, evidence.weights, evidence.ancestor)
        self._online.append(estimate.pose)
        self._motion.append(int(observation.motion))
        self._flags.append(np.stack([observation.contact, observation.alive], axis=1))
        self._point.append(observation.point)
        self._wall.append(observation.wall_point if observation.wall else [np.nan, np.nan])
        return estimate

    def trajectory(self) -> np.ndarray:
        """[T, 3] the weighted mean path of the surviving particles."""
        return self._genealogy.path()

    def occupancy(self) -> np.ndarray:
        """[S, S] probability of an obstacle in each cell; rows are y, columns x, the middle is the start."""
        return draw_occupancy(self.config, self.feelers, self.side, self.trajectory(), self.contacts())

    def grid(self) -> GridDrawing:
        corner = np.full(2, -self.side * self.config.cell / 2)
        return GridDrawing(self.occupancy(), corner, self.config.cell)

    def files(self) -> dict[str, Callable[[Path], None]]:
        """The map as arrays: probability [S, S], origin [2] m of its lower left corner, cell m."""
        return {"grid.npz": self._write}

    def _write(self, path: Path) -> None:
        np.savez_compressed(path, **self.grid()._asdict())

    def contacts(self) -> ContactLog:
        """The contacts of all reports."""
        contact, alive = np.moveaxis(self._flags.rows, 2, 0)
        return contact_log(self._motion.rows, contact, alive, self._point.rows, self._wall.rows)
