"""The design of the C++ engines, in compiled loops of our own: excitation and inhibition scatter from cells
that are not zero, everything else sweeps the whole grid."""

from __future__ import annotations

import numpy as np
from numba import njit


def kernel(width: int, sigma: float) -> np.ndarray:
    at = np.arange(width) - width // 2
    squares = at[:, None, None] ** 2 + at[None, :, None] ** 2 + at[None, None, :] ** 2
    weight = np.exp(-squares / (2 * sigma**2))
    return weight / weight.sum()


@njit(cache=False)
def scatter(p, weight, out):
    k, n, m = p.shape
    half = weight.shape[0] // 2
    out[:] = 0.0
    for h, y, x in np.ndindex(k, n, m):
        if p[h, y, x] != 0.0:
            for a, b, c in np.ndindex(weight.shape):
                i, j = (h + a - half) % k, (y + b - half) % n
                out[i, j, (x + c - half) % m] += p[h, y, x] * weight[a, b, c]


@njit(cache=False)
def threshold(p, q, g):
    total = 0.0
    for cell in np.ndindex(p.shape):
        left = p[cell] - q[cell]
        p[cell] = left - g if left >= g else 0.0
        total += p[cell]
    for cell in np.ndindex(p.shape):
        p[cell] /= total


@njit(cache=False)
def integrate(p, out, d, turn):
    k, n, m = p.shape
    out[:] = 0.0
    st, at = (1 if turn >= 0 else -1), abs(turn)
    for h in range(k):
        angle = h * 2 * np.pi / k
        dx, dy = d * np.cos(angle), d * np.sin(angle)
        sx, sy, ax, ay = (1 if dx >= 0 else -1), (1 if dy >= 0 else -1), abs(dx), abs(dy)
        for y, x in np.ndindex(n, m):
            for i, wt in ((h, 1 - at), ((h + st) % k, at)):
                for j, wy in ((y, 1 - ay), ((y + sy) % n, ay)):
                    out[i, j, x] += p[h, y, x] * wt * wy * (1 - ax)
                    out[i, j, (x + sx) % m] += p[h, y, x] * wt * wy * ax


@njit(cache=False)
def peak(p):
    best, where = -1.0, (0, 0, 0)
    for cell in np.ndindex(p.shape):
        if p[cell] > best:
            best, where = p[cell], cell
    return where


class SparseLoop:
    """As `NumpyNetwork`."""

    def __init__(self, n: int, k: int = 36) -> None:
        self.shape = (k, n, n)
        self.excite, self.inhibit = kernel(7, 1.0), kernel(5, 2.0)
        self.activity = np.zeros(self.shape)
        self.activity[k // 2, n // 2, n // 2] = 1
        self.first, self.second = np.empty(self.shape), np.empty(self.shape)

    def step(self, d: float, turn: float) -> tuple[int, int, int]:
        scatter(self.activity, self.excite, self.first)
        scatter(self.first, self.inhibit, self.second)
        threshold(self.first, self.second, 2e-5)
        integrate(self.first, self.activity, d, turn)
        return peak(self.activity)
