"""The pose cell network, with its leaking corner and its unchecked weights (section 4)."""

from __future__ import annotations

from math import floor, pi

import numpy as np

from tests.oracle.cells import Array, Attractor, Pose, decode
from tests.oracle.params import Params


class Network:
    """The attractor on its torus and the pose decoded from it."""

    def __init__(self, params: Params) -> None:
        N, K = params.pc_dim_xy, params.pc_dim_th
        self.attractor = Attractor(params)
        self.P = np.zeros((K, N, N))
        self.P[K // 2, N // 2, N // 2] = 1.0
        self.best = Pose(float(N // 2), float(N // 2), float(K // 2))

    def inject(self, cell: tuple[int, ...], energy: float) -> None:
        """Adds energy to a cell; outside the grid it is lost without a word (Q2)."""
        if all(0 <= i < n for i, n in zip(cell, self.P.shape, strict=True)):
            self.P[cell] += energy

    def step(self, distance: float, turn: float) -> None:
        """One odometry message: `distance` in cells and `turn` in rad (steps a to g).

        Translation uses the heading before the turn (Q13).
        """
        P, total = self.attractor(self.P)
        if not total > 0:
            raise ArithmeticError("the activity died out, where the reference aborts (Q6)")
        self.P = rotated(translated(P / total, distance), turn)
        peak = np.unravel_index(self.P.argmax(), self.P.shape)
        self.best = decode(self.P, tuple(map(int, peak)))


def translated(P: Array, distance: float) -> Array:
    """Step e: every heading layer moved along its heading, x by the sine and y by the cosine.

    Layers of the same quadrant are turned so that both shifts are positive, moved, and turned back.
    """
    K = len(P)
    back = pi if distance < 0 else 0.0
    angles = np.array([k * (2 * pi / K) + back for k in range(K)])
    quadrants = np.floor(2 * angles / pi).astype(int)
    inside = angles - quadrants * (pi / 2)
    A, B = abs(distance) * np.sin(inside), abs(distance) * np.cos(inside)
    active = P.any(axis=(1, 2))
    out = np.zeros_like(P)
    for q in np.unique(quadrants):
        layers = np.flatnonzero(active & (quadrants == q))
        turned = np.rot90(P[layers], -q, axes=(1, 2))
        moved = _shifted_and_folded(turned, A[layers, None, None], B[layers, None, None])
        out[layers] = np.rot90(moved, q, axes=(1, 2))
    return out


def _shifted_and_folded(P: Array, A: Array, B: Array) -> Array:
    """Bilinear shift of [layer, j, i] by A along i and B along j, which nothing keeps below one cell (Q5).

    The overflow folds to the opposite edges, but its two outer corners are lost (Q4).
    """
    layers, n, _ = P.shape
    wide = np.zeros((layers, n + 1, n + 1))
    wide[:, :n, :n] = (1 - A) * (1 - B) * P
    wide[:, :n, 1:] += A * (1 - B) * P
    wide[:, 1:, :n] += (1 - A) * B * P
    wide[:, 1:, 1:] += A * B * P
    out = wide[:, :n, :n]
    out[:, 0, 1:] += wide[:, n, 1:n]
    out[:, 1:, 0] += wide[:, 1:n, n]
    out[:, 0, 0] += wide[:, n, n]
    return out


def rotated(P: Array, turn: float) -> Array:
    """Step f: the layers shifted along the ring of headings, linearly between whole cells."""
    if turn == 0:
        return P
    cells = abs(turn) / (2 * pi / len(P))
    sign = 1 if turn > 0 else -1
    low = floor(cells)
    fraction = cells - low or 1.0
    high = low if fraction == 1.0 else low + 1
    return (1 - fraction) * np.roll(P, sign * low, axis=0) + fraction * np.roll(P, sign * high, axis=0)
