"""A dense network step whose convolutions and shifts are products of spectra (SciPy's real FFT)."""

from __future__ import annotations

import numpy as np
from scipy import fft


def spectrum(width: int, sigma: float, size: int) -> np.ndarray:
    weight = np.exp(-((np.arange(width) - width // 2) ** 2) / (2 * sigma**2))
    ring = np.zeros(size)
    ring[(np.arange(width) - width // 2) % size] += weight / weight.sum()
    return fft.fft(ring)


class Fourier:
    """As `NumpyNetwork`, but only excitation, inhibition and threshold, the part that FFTs can do."""

    def __init__(self, n: int, k: int = 36) -> None:
        self.shape = (k, n, n)
        both = []
        for width, sigma in ((7, 1.0), (5, 2.0)):
            along = [spectrum(width, sigma, size) for size in self.shape]
            half = along[2][: n // 2 + 1]
            both.append(along[0][:, None, None] * along[1][None, :, None] * half[None, None, :])
        self.response = both[0] * (1 - both[1])
        self.activity = np.zeros(self.shape)
        self.activity[k // 2, n // 2, n // 2] = 1

    def step(self, d: float, turn: float) -> None:
        del d, turn
        left = fft.irfftn(fft.rfftn(self.activity) * self.response, self.shape)
        excess = np.where(left >= 2e-5, left - 2e-5, 0.0)
        self.activity = excess / excess.sum()
