"""A dense pose-cell network step in plain NumPy float64: the baseline of all stated speeds.

A straightforward implementation: separable circular convolutions as circulant products, heading layers
translated one after another, a search for the peak. Time it in the same process as the engine: only the
ratio of both times is meaningful.
"""

from __future__ import annotations

import numpy as np


class NumpyNetwork:
    """A network of [K, N, N] cells; `step(d, turn)` moves it d cells forward and turns it by `turn` cells."""

    def __init__(self, n: int, k: int = 36) -> None:
        self.n, self.k = n, k
        self.excite = [_circulant(_gaussian(7, 1.0), size) for size in (k, n, n)]
        self.inhibit = [_circulant(_gaussian(5, 2.0), size) for size in (k, n, n)]
        self.activity = np.zeros((k, n, n))
        self.activity[k // 2, n // 2, n // 2] = 1

    def step(self, d: float, turn: float) -> tuple[float, float, float]:
        """One step; the decoded pose in cells: x, y, heading."""
        p = _convolve(self.activity, self.excite)
        p = p - _convolve(p, self.inhibit)
        p = np.where(p >= 2e-5, p - 2e-5, 0.0)
        p /= p.sum()
        moved = np.empty_like(p)
        for layer in range(self.k):
            angle = layer * 2 * np.pi / self.k
            for axis, far in ((0, d * np.sin(angle)), (1, d * np.cos(angle))):
                source = p[layer] if axis == 0 else moved[layer]
                share = abs(far)
                moved[layer] = (1 - share) * source + share * np.roll(source, int(np.sign(far)), axis)
        share = abs(turn)
        self.activity = (1 - share) * moved + share * np.roll(moved, int(np.sign(turn)), 0)
        return self.decode()

    def decode(self) -> tuple[float, float, float]:
        """Circular mean of the activity around its peak, cells: x, y, heading."""
        sizes = (self.k, self.n, self.n)
        peak = np.unravel_index(np.argmax(self.activity), sizes)
        at = [(p + np.arange(-3, 4)) % size for p, size in zip(peak, sizes, strict=True)]
        box = self.activity[np.ix_(*at)]
        means = []
        for axis, size in enumerate(sizes):
            mass = box.sum(tuple(a for a in range(3) if a != axis))
            angle = at[axis] * 2 * np.pi / size
            means.append(np.arctan2(mass @ np.sin(angle), mass @ np.cos(angle)) * size / (2 * np.pi) % size)
        return means[2], means[1], means[0]


def _gaussian(width: int, sigma: float) -> np.ndarray:
    weight = np.exp(-((np.arange(width) - width // 2) ** 2) / (2 * sigma**2))
    return weight / weight.sum()


def _circulant(kernel: np.ndarray, size: int) -> np.ndarray:
    return np.sum(
        [w * np.roll(np.eye(size), len(kernel) // 2 - t, axis=0) for t, w in enumerate(kernel)], axis=0
    )


def _convolve(p: np.ndarray, along: list[np.ndarray]) -> np.ndarray:
    p = np.tensordot(along[0], p, axes=(1, 0))
    p = np.einsum("ab,kbi->kai", along[1], p, optimize=True)
    return p @ along[2].T
