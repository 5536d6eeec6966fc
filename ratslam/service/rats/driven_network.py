"""A network of pose cells that a loop of one's own drives with motions."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from ratslam.classic import pose_cells
from ratslam.classic.levels import point_activity, to_full_torus, window_levels
from ratslam.classic.pose_cell_config import NetworkConfig, rings, units
from ratslam.classic.pose_cells import LARGEST_SUBSTEP, MOST_SUBSTEPS, Outcome, PoseCells
from tactile.base.errors import InputError
from tactile.base.types import Odometry


class DrivenNetwork:
    """A network and its state. Steps are compiled once for each `NetworkConfig` in a process, in the
    precision that JAX has by default.

    The axes of the torus are those of the world: a pose is at the cell of its position divided by the cell
    size, and of its heading divided by 2 pi / K, each modulo the size of its ring.

    Args:
        pose: [3] m, m, rad, at which the network starts with one active cell.

    Attributes:
        activity: [K * N * N] of all cells; it sums to 1. packet: [3] decoded over x, y, heading, cells.
    """

    def __init__(self, config: NetworkConfig, pose: np.ndarray) -> None:
        self.config = config
        self._dtype = np.dtype(jax.dtypes.canonicalize_dtype(float))
        self._unit, self._rings = units(config, self._dtype), rings(config, self._dtype)
        start, self._step = _compiled(config, self._dtype)
        self._cells: PoseCells = start(self._position(pose))
        self.packet = np.asarray(self._cells.pose)
        self.activity = np.asarray(to_full_torus(window_levels(config, self._dtype), self._cells.activity))
        self.activity = self.activity.ravel()

    @property
    def pose(self) -> np.ndarray:
        """[3] the decoded packet on the torus, m, m, rad."""
        return self.packet * self._unit

    def advance(self, motion: np.ndarray, anchor: np.ndarray | None = None, energy: float = 0.0) -> None:
        """One step.

        Args:
            motion: [4] dx m, dy m, dtheta rad, dt s, in the frame of the body before it.
            anchor: [3] pose (m, m, rad) at which energy is injected; None: nowhere. energy: activity injected
                there, as a share of the activity of all cells.

        Raises:
            InputError: a number is not finite, the energy is negative, or the motion is longer than a step
                can follow.
        """
        where = np.zeros(3) if anchor is None else self._position(anchor)
        given = np.array([*motion, *where, energy if anchor is not None else 0.0], self._dtype)
        if not (np.isfinite(given).all() and given[-1] >= 0):
            found = f"motion {motion}, anchor {anchor}, energy {energy}"
            raise InputError("motion", found, "finite numbers, and an energy from 0 on")
        self._cells, outcome, activity = self._step(self._cells, given)
        if int(outcome) == Outcome.TOO_FAST:
            most = MOST_SUBSTEPS * LARGEST_SUBSTEP
            found = f"{np.hypot(*motion[:2]):.3g} m and {motion[2]:.3g} rad in one step"
            raise InputError("motion", found, f"at most {most:g} cells", "take shorter steps or larger cells")
        self.packet, self.activity = np.asarray(self._cells.pose), np.asarray(activity)

    def _position(self, pose: np.ndarray) -> np.ndarray:
        """[3] cells of a pose (m, m, rad), in [0, N) and [0, K)."""
        cells = (np.asarray(pose, np.float64) / self._unit % self._rings).astype(self._dtype)
        return np.where(cells >= self._rings, 0, cells)


@lru_cache(maxsize=16)
def _compiled(config: NetworkConfig, dtype: np.dtype) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The start of the network at a position [3] in cells, and its step with the numbers [8] of motion,
    anchor in cells, and energy."""
    levels = window_levels(config, dtype)

    def start(position: Any) -> PoseCells:
        activity = point_activity(levels, position)
        return PoseCells(activity, position, jax.numpy.zeros(3, dtype), jax.numpy.int32(0))

    def step(cells: PoseCells, given: Any) -> tuple[PoseCells, Any, Any]:
        odometry, recall, energy = Odometry(*given[:4]), given[4:7], given[7]
        cells, info = pose_cells.step(config, levels, cells, odometry, recall, energy)
        return cells, info.outcome, to_full_torus(levels, cells.activity).ravel()

    return jax.jit(start), jax.jit(step)
