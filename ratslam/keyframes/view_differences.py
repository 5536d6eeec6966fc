"""Differences between many pairs of stored views, in compiled loops."""

from __future__ import annotations

import numpy as np

from ratslam.core.compiled import compiled


@compiled
def mean_differences(views: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] mean absolute differences of the views [N, D] numbered a [n] and b [n]."""
    found = np.empty(len(a))
    for k in range(len(a)):
        total = 0.0
        for d in range(views.shape[1]):
            total += abs(views[a[k], d] - views[b[k], d])
        found[k] = total / views.shape[1]
    return found


@compiled
def summed_log_odds(
    table: np.ndarray,
    group: np.ndarray,
    levels: np.ndarray,
    opposite: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    reversed: np.ndarray,
) -> np.ndarray:
    """[n] log-odds that the images numbered a [n] and b [n] are of one place.

    Args:
        table: [G, L, L] log-odds by group of pixels and the levels of both. group: [D] of each pixel.
        levels: [N, D] the images. opposite: [D] the pixel at the other side of the head.
        reversed: [n] bool, whether image b is seen in the opposite direction.
    """
    found = np.empty(len(a))
    for k in range(len(a)):
        total = 0.0
        for d in range(len(group)):
            other = opposite[d] if reversed[k] else d
            total += table[group[d], levels[a[k], d], levels[b[k], other]]
        found[k] = total
    return found


@compiled
def near_facing(
    poses: np.ndarray, frames: np.ndarray, guard: int, radius: float, facing: float
) -> np.ndarray:
    """[F, N] int8: for each of the keyframes `frames` [F], which older ones are near it: 1 those that face
    alike, -1 those that face the opposite way, 0 all others.

    Args:
        poses: [N, 3]. guard: number of newest keyframes before each that do not count. radius: largest
            distance, m. facing: least cosine of the difference in heading, or in opposite headings.
    """
    ahead, aside = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    found = np.zeros((len(frames), len(poses)), np.int8)
    for row in range(len(frames)):
        k = frames[row]
        for other in range(k - guard):
            dx, dy = poses[other, 0] - poses[k, 0], poses[other, 1] - poses[k, 1]
            if dx * dx + dy * dy < radius * radius:
                cosine = ahead[other] * ahead[k] + aside[other] * aside[k]
                if abs(cosine) > facing:
                    found[row, other] = 1 if cosine > 0 else -1
    return found
