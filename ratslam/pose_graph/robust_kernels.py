"""Robust kernels: how much an edge counts that disagrees with the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Kernel(NamedTuple):
    """A robust kernel over squared Mahalanobis errors: the weight of an edge and what it costs."""

    weight: Callable[[np.ndarray], np.ndarray]
    loss: Callable[[np.ndarray], np.ndarray]


no_kernel = Kernel(np.ones_like, lambda chi2: chi2)
"""Plain least squares."""


def huber(scale: float) -> Kernel:
    """Linear beyond `scale` standard deviations: a disagreeing edge pulls, but not the harder the farther."""
    return Kernel(
        lambda chi2: np.minimum(1.0, scale / np.sqrt(np.maximum(chi2, 1e-300))),
        lambda chi2: np.where(chi2 <= scale**2, chi2, 2 * scale * np.sqrt(chi2) - scale**2),
    )


def geman_mcclure(mu: float) -> Kernel:
    """Bounded: an edge that disagrees far beyond sqrt(mu) standard deviations is as good as cut."""
    return Kernel(lambda chi2: (mu / (mu + chi2)) ** 2, lambda chi2: mu * chi2 / (mu + chi2))
