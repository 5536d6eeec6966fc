"""The pose cells: activity P[heading, y, x] on a torus (section 4; "3. Motion" of the engine's semantics)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tests.oracle.trace import Array, Parameters

Pose = tuple[float, float, float]
Cell = tuple[int, int, int]
BOX = 3  # half width of the box that is decoded


class NetworkDied(Exception):
    """No activity is left after the inhibition (Q6)."""


def circulant(n: int, width: int, sigma: float) -> Array:
    """One axis of the normalised Gaussian as a matrix: row: target cell, column: source cell."""
    reach = range(-(width // 2), width // 2 + 1)
    weights = np.array([math.exp(-(o * o) / (2 * sigma * sigma)) for o in reach])
    weights /= weights.sum()
    matrix = np.zeros((n, n))
    for o, weight in zip(reach, weights, strict=True):
        for source in range(n):
            matrix[(source + o) % n, source] += weight
    return matrix


def occupied(activity: Array) -> list[NDArray[np.intp]]:
    """The indices along each axis at which anything is not zero."""
    nonzero = activity != 0
    return [np.flatnonzero(nonzero.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]


class Attractor:
    """Steps a to d of `on_odo`: excitation, inhibition, global inhibition; shared by both engines.

    The Gaussians are separable, and only the box of occupied cells, widened by both kernels, is computed:
    everything outside it is exactly zero.
    """

    def __init__(self, parameters: Parameters) -> None:
        p = parameters
        self.global_inhibition = p.pc_global_inhib
        lengths = (p.pc_dim_th, p.pc_dim_xy, p.pc_dim_xy)
        self.excite = [circulant(n, p.pc_w_e_dim, p.pc_w_e_var) for n in lengths]
        self.inhibit = [circulant(n, p.pc_w_i_dim, p.pc_w_i_var) for n in lengths]

    def inhibited(self, activity: Array) -> Array:
        """The activity after steps a, b and c, not yet normalised."""
        here = occupied(activity)
        excited = [np.flatnonzero((m[:, i] != 0).any(axis=1)) for m, i in zip(self.excite, here, strict=True)]
        wide = [
            np.flatnonzero((m[:, i] != 0).any(axis=1)) for m, i in zip(self.inhibit, excited, strict=True)
        ]
        box = activity[np.ix_(*here)]
        box = along_axes([m[np.ix_(w, i)] for m, w, i in zip(self.excite, wide, here, strict=True)], box)
        box = box - along_axes([m[np.ix_(w, w)] for m, w in zip(self.inhibit, wide, strict=True)], box)
        box = np.where(box >= self.global_inhibition, box - self.global_inhibition, 0.0)
        result = np.zeros_like(activity)
        result[np.ix_(*wide)] = box
        return result


def along_axes(matrices: list[Array], box: Array) -> Array:
    """Apply one matrix per axis."""
    k, j, i = matrices
    box = np.tensordot(k, box, axes=(1, 0))
    box = np.matmul(j, box)
    return np.matmul(box, i.T)


def translated_leaky(activity: Array, distance: float) -> Array:
    """Step e: shift each heading layer, in the frame of its quadrant, with the corner that leaks (Q4).

    Nothing checks that the shifts stay below one cell, so longer steps get negative weights (Q5).
    """
    headings, n, _ = activity.shape
    result = np.zeros_like(activity)
    layers = np.flatnonzero((activity != 0).any(axis=(1, 2)))
    length = abs(distance)
    angles = [k * (2 * math.pi / headings) + (math.pi if distance < 0 else 0.0) for k in layers]
    quadrants = np.array([math.floor(2 * a / math.pi) for a in angles])
    for q in np.unique(quadrants):
        here = quadrants == q
        rest = np.array([a for a, mine in zip(angles, here, strict=True) if mine]) - q * (math.pi / 2)
        along_i = (length * np.sin(rest))[:, None, None]
        along_j = (length * np.cos(rest))[:, None, None]
        layer = np.rot90(activity[layers[here]], -q, axes=(1, 2))
        wide = np.zeros((len(layer), n + 1, n + 1))
        wide[:, :n, :n] = layer * ((1 - along_i) * (1 - along_j))
        wide[:, :n, 1:] += layer * (along_i * (1 - along_j))
        wide[:, 1:, :n] += layer * ((1 - along_i) * along_j)
        wide[:, 1:, 1:] += layer * (along_i * along_j)
        folded = wide[:, :n, :n].copy()
        folded[:, 0, 1:] += wide[:, n, 1:n]
        folded[:, 1:, 0] += wide[:, 1:n, n]
        folded[:, 0, 0] += wide[:, n, n]
        result[layers[here]] = np.rot90(folded, q, axes=(1, 2))
    return result


def rotated(activity: Array, angle: float) -> Array:
    """Step f: shift along heading; a whole number of cells goes entirely with the upper one."""
    if angle == 0:
        return activity
    cells = abs(angle) / (2 * math.pi / activity.shape[0])
    sign = 1 if angle > 0 else -1
    lower, upper = math.floor(cells), math.ceil(cells)
    fraction = cells - lower if cells != lower else 1.0
    shifted = np.roll(activity, sign * upper, axis=0) * fraction
    return (1 - fraction) * np.roll(activity, sign * lower, axis=0) + shifted


def box_around(activity: Array, peak: Cell) -> tuple[Array, list[NDArray[np.intp]]]:
    """The wrapped box around a cell (k, j, i) and its indices; on a small torus it visits cells twice."""
    reach = np.arange(-BOX, BOX + 1)
    indices = [(c + reach) % n for c, n in zip(peak, activity.shape, strict=True)]
    return activity[np.ix_(*indices)], indices


def circular_mean(sums: Array, indices: NDArray[np.intp], n: int) -> float:
    """Step g: the angle of the summed unit vectors in cells, counted from 1; n itself can come out."""
    angles = 2 * math.pi * (indices + 1) / n
    mean = math.atan2(float(sums @ np.sin(angles)), float(sums @ np.cos(angles))) * n / (2 * math.pi) - 1
    while mean < 0:
        mean += n
    while mean > n:
        mean -= n
    return mean


def decoded(activity: Array) -> Pose:
    """Step g: the pose (x, y, th) of the box around the first of the largest cells, k outermost."""
    k, j, i = (int(c) for c in np.unravel_index(int(np.argmax(activity)), activity.shape))
    box, (ks, js, xs) = box_around(activity, (k, j, i))
    headings, n, _ = activity.shape
    return (
        circular_mean(box.sum(axis=(0, 1)), xs, n),
        circular_mean(box.sum(axis=(0, 2)), js, n),
        circular_mean(box.sum(axis=(1, 2)), ks, headings),
    )


class StockCells:
    """Section 4: the stock engine's network and its decoded pose."""

    def __init__(self, parameters: Parameters) -> None:
        p = parameters
        self.cell_size = p.pc_cell_x_size
        self.attractor = Attractor(p)
        start = (p.pc_dim_th // 2, p.pc_dim_xy // 2, p.pc_dim_xy // 2)
        self.activity = np.zeros((p.pc_dim_th, p.pc_dim_xy, p.pc_dim_xy))
        self.activity[start] = 1.0
        self.best: Pose = (float(start[2]), float(start[1]), float(start[0]))

    def inject(self, energy: float, pose: Pose, truncate: Callable[[Pose], Cell]) -> Cell | None:
        """Raise the cell (x, y, th) that the pose truncates to; outside the grid the energy is lost (Q2)."""
        i, j, k = truncate(pose)
        headings, n, _ = self.activity.shape
        if not (0 <= k < headings and 0 <= j < n and 0 <= i < n):
            return None
        self.activity[k, j, i] += energy
        return i, j, k

    def move(self, v: float, w: float, dt: float) -> None:
        """`on_odo`: the steps a to g. The translation uses the heading before the rotation (Q13)."""
        activity = self.attractor.inhibited(self.activity)
        total = float(activity.sum())
        if total <= 0:
            raise NetworkDied("nothing is left of the activity: the stock engine aborts here")
        activity = translated_leaky(activity / total, v * dt / self.cell_size)
        self.activity = rotated(activity, w * dt)
        self.best = decoded(self.activity)


def truncated(pose: Pose) -> Cell:
    """The cell that the stock engine injects into: towards zero, not to the nearest (Q2)."""
    x, y, th = pose
    return int(x), int(y), int(th)
