"""The map of the grid filter: the path of the particles that survived, and what was felt drawn along it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import networkx
import numpy as np

from ratslam.core.growable_array import GrowableArray, copy_arrays, restore_arrays
from ratslam.core.types import Estimate
from ratslam.grid.config import GridConfig
from ratslam.grid.genealogy import Ancestry
from ratslam.grid.map_drawing import Marks, draw, marks_of
from tactile.base.types import Observation
from tactile.whiskers.planar_whiskers import PlanarWhiskers


class GridMap:
    """Folds what the grid filter reports (`ratslam.core.backend.Map`).

    Args:
        feelers: the whiskers of the observations. side: of the map, cells.
    """

    def __init__(self, config: GridConfig, feelers: PlanarWhiskers, side: int) -> None:
        self.config, self.feelers, self.side = config, feelers, side
        whiskers = len(feelers.length)
        self._ancestry = Ancestry(config.particles)
        self._online = GrowableArray((3,), np.float64)
        self._motion = GrowableArray((), np.int64)
        self._flags = GrowableArray((whiskers, 2), bool)  # in contact, reports at all
        self._point = GrowableArray((whiskers, 2), np.float64)
        self._wall = GrowableArray((2,), np.float64)  # its nearest point; NaN: none

    def update(self, observation: Observation, estimate: Estimate, evidence: Any) -> Estimate:
        """Keeps the particles and what was felt."""
        self._ancestry.append(evidence.poses, evidence.weights, evidence.ancestor)
        self._online.append(estimate.pose)
        self._motion.append(int(observation.motion))
        self._flags.append(np.stack([observation.contact, observation.alive], axis=1))
        self._point.append(observation.point)
        self._wall.append(observation.wall_point if observation.wall else [np.nan, np.nan])
        return estimate

    def feedback(self) -> None:
        """The filter asks for nothing."""

    def pose(self, estimate: Estimate) -> np.ndarray:
        """[3] the weighted mean of the particles."""
        return np.asarray(estimate.pose, float)

    def trajectory(self) -> np.ndarray:
        """[T, 3] the weighted mean of the paths of the particles that are left."""
        return self._ancestry.path()

    def online_trajectory(self) -> np.ndarray:
        """[T, 3] the same: it needs no settling."""
        return self._ancestry.path()

    def closures(self) -> np.ndarray:
        """[0, 2]: a grid joins no steps."""
        return np.zeros((0, 2), int)

    def graph(self) -> networkx.DiGraph:
        """Empty: a grid has no nodes."""
        return networkx.DiGraph()

    def occupancy(self) -> np.ndarray:
        """[S, S] chance of an obstacle in each cell (rows are y, columns x; the robot started in the middle),
        as Fox et al. 2012 draw it: wide stamps along the path."""
        return draw(self.config, self.feelers, self.side, self.trajectory(), self._marks())

    def files(self) -> dict[str, Callable[[Path], None]]:
        """The map as arrays: probability [S, S], origin [2] m of its lower left corner, cell m."""
        return {"grid.npz": self._write}

    def _write(self, path: Path) -> None:
        corner = np.full(2, -self.side * self.config.cell / 2)
        np.savez_compressed(path, probability=self.occupancy(), origin=corner, cell=self.config.cell)

    def _marks(self) -> Marks:
        contact, alive = np.moveaxis(self._flags.rows, 2, 0)
        return marks_of(self._motion.rows, contact, alive, self._point.rows, self._wall.rows)

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything, so that `restore` continues bit for bit."""
        return copy_arrays(self) | {
            f"ancestry/{name}": rows for name, rows in self._ancestry.arrays().items()
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Takes the place of everything folded so far."""
        restore_arrays(self, arrays)
        prefix = "ancestry/"
        self._ancestry.restore({k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)})
