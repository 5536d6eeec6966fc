"""The design of the C++ engines, in compiled loops of our own: excitation and inhibition scatter from cells
that are not zero, everything else sweeps the whole grid."""

from __future__ import annotations

import numpy as np
from numba import njit


def kernel(width: int, sigma: float) -> np.ndarray:
    at = np.arange(width) - width // 2
    weight = np.exp(
        -(at[:, None, None] ** 2 + at[None, :, None] ** 2 + at[None, None, :] ** 2) / (2 * sigma**2)
    )
    return weight / weight.sum()


@njit(cache=False)
def scatter(p, weight, out):
    k, n, m = p.shape
    half = weight.shape[0] // 2
    out[:] = 0.0
    for h in range(k):
        for y in range(n):
            for x in range(m):
                value = p[h, y, x]
                if value == 0.0:
                    continue
                for a in range(weight.shape[0]):
                    i = (h + a - half) % k
                    for b in range(weight.shape[0]):
                        j = (y + b - half) % n
                        for c in range(weight.shape[0]):
                            out[i, j, (x + c - half) % m] += value * weight[a, b, c]


@njit(cache=False)
def threshold(p, q, g):
    total = 0.0
    k, n, m = p.shape
    for h in range(k):
        for y in range(n):
            for x in range(m):
                left = p[h, y, x] - q[h, y, x]
                left = left - g if left >= g else 0.0
                p[h, y, x] = left
                total += left
    for h in range(k):
        for y in range(n):
            for x in range(m):
                p[h, y, x] /= total


@njit(cache=False)
def integrate(p, out, d, turn):
    k, n, m = p.shape
    out[:] = 0.0
    for h in range(k):
        angle = h * 2 * np.pi / k
        dx, dy = d * np.cos(angle), d * np.sin(angle)
        sx, sy = (1 if dx >= 0 else -1), (1 if dy >= 0 else -1)
        st = 1 if turn >= 0 else -1
        ax, ay, at = abs(dx), abs(dy), abs(turn)
        for y in range(n):
            for x in range(m):
                value = p[h, y, x]
                for i, wt in ((h, 1 - at), ((h + st) % k, at)):
                    for j, wy in ((y, 1 - ay), ((y + sy) % n, ay)):
                        out[i, j, x] += value * wt * wy * (1 - ax)
                        out[i, j, (x + sx) % m] += value * wt * wy * ax


@njit(cache=False)
def peak(p):
    best, where = -1.0, (0, 0, 0)
    k, n, m = p.shape
    for h in range(k):
        for y in range(n):
            for x in range(m):
                if p[h, y, x] > best:
                    best, where = p[h, y, x], (h, y, x)
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
