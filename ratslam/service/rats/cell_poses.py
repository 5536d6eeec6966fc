"""The pose that each cell of the network stands for."""

from __future__ import annotations

import numpy as np

from tactile.base.errors import InputError


def cell_poses(shape: tuple[int, int, int], cell_size: float, cell: np.ndarray) -> np.ndarray:
    """[C, 3] poses of cells on the torus (m, m, rad): x and y in [0, N * cell_size), heading in [0, 2 pi).

    Args:
        shape: (K, N, N) cells over heading, y, x. cell_size: m. cell: [C] indices in the flattened network.

    Raises:
        InputError: an index is no cell of the network.
    """
    check_cells(shape, cell)
    heading, y, x = np.unravel_index(np.asarray(cell, np.int64), shape)
    return packet_poses(shape, cell_size, np.stack([x, y, heading], axis=-1))


def packet_poses(shape: tuple[int, int, int], cell_size: float, packet: np.ndarray) -> np.ndarray:
    """[..., 3] poses on the torus (m, m, rad) of positions [..., 3] over x, y, heading in cells."""
    return np.asarray(packet, np.float64) * [cell_size, cell_size, 2 * np.pi / shape[0]]


def check_cells(shape: tuple[int, int, int], cell: np.ndarray) -> None:
    """Checks the indices [C] of chosen cells.

    Raises:
        InputError: they are no whole numbers, there are none, or one is no cell of the network.
    """
    total, given = int(np.prod(shape)), np.asarray(cell)
    expected = f"indices of the {total} cells, 0 to {total - 1}"
    if given.ndim != 1 or not given.size or given.dtype.kind not in "iu":
        raise InputError("cell", f"an array of shape {given.shape} and type {given.dtype}", expected)
    wrong = given[(given < 0) | (given >= total)]
    if wrong.size:
        raise InputError("cell", f"the index {wrong[0]}", expected)
