"""Robust kernels: weights that reduce the influence of edges that disagree with the rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Kernel(NamedTuple):
    """A robust kernel: weight and cost of an edge as functions of its squared Mahalanobis error."""

    weight: Callable[[np.ndarray], np.ndarray]
    loss: Callable[[np.ndarray], np.ndarray]


no_kernel = Kernel(np.ones_like, lambda chi2: chi2)
"""Plain least squares."""


def huber(scale: float) -> Kernel:
    """Cost linear beyond `scale` standard deviations, so the influence of an edge is bounded (Huber 1964)."""
    return Kernel(
        lambda chi2: np.minimum(1.0, scale / np.sqrt(np.maximum(chi2, 1e-300))),
        lambda chi2: np.where(chi2 <= scale**2, chi2, 2 * scale * np.sqrt(chi2) - scale**2),
    )


def geman_mcclure(mu: float) -> Kernel:
    """Cost bounded by mu: an error far beyond sqrt(mu) standard deviations has no influence (Geman 1985)."""
    return Kernel(lambda chi2: (mu / (mu + chi2)) ** 2, lambda chi2: mu * chi2 / (mu + chi2))
