"""Log-odds of two whisker images showing one place against two places, learned from the session itself.

A pixel is silent, dead, or has one of 30 heights. Its log-odds depend on how often whiskers are in contact,
on which heights are common (both counted over all images), and on the variation between two visits to a place
(from pairs of images that the map has confirmed, with a prior). No ground truth is used.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.types import Array, Observation

LEVELS = 32
"""Number of levels of a pixel: 0 silent, 1 to 30 heights, 31 dead."""
DEAD = LEVELS - 1
HEIGHTS = DEAD - 1


class Variation(NamedTuple):
    """Variation of an image between two visits to a place.

    Attributes:
        appears: share of silent pixels that are in contact on the next visit. vanishes: share of pixels in
            contact that are silent on the next visit. width: mean difference of heights, full scale 1.
            outliers: share of heights that are independent of those before.
    """

    appears: float
    vanishes: float
    width: float
    outliers: float


PRIOR = Variation(0.07, 0.17, 0.08, 0.1)
"""Variation for an arm that repeats its path to about 5 mm."""
PRIOR_PAIRS = 20.0
"""Number of pairs of images that the prior counts as."""


class PixelLayout(NamedTuple):
    """Relations between the D pixels of a flattened whisker image [R, C, K].

    Attributes:
        group: [D] number of each pixel's ring and channel; pixels of a group are statistically alike.
        opposite: [D] the pixel of the opposite whisker; the first whisker of each row points ahead.
    """

    group: np.ndarray
    opposite: np.ndarray


def pixel_layout(view_shape: tuple[int, int, int]) -> PixelLayout:
    """The layout of images of this shape."""
    _, columns, channels = view_shape
    row, _, channel = np.indices(view_shape)
    number = np.arange(row.size).reshape(view_shape)
    opposite = np.roll(number, -(columns // 2), axis=1)
    return PixelLayout((row * channels + channel).reshape(-1), opposite.reshape(-1))


def live_pixels(observation: Observation) -> Array:
    """[R, C, K] bool, pixels whose whiskers report; all where the observation has no whiskers."""
    rows, columns, channels = observation.view.shape
    if observation.alive.size != rows * columns:
        return np.ones((rows, columns, channels), bool)
    return observation.alive.reshape(rows, columns, 1) & np.ones((1, 1, channels), bool)


def pixel_levels(view: Array, alive: Array) -> Array:
    """Levels of pixels with values [...] in 0..1, dead where `alive` [...] is 0; whole numbers of the view's
    dtype. For NumPy and JAX; with JAX `alive` has the dtype of the view."""
    height = -(-view * HEIGHTS // 1)
    height = (height + HEIGHTS - abs(height - HEIGHTS)) / 2  # at most HEIGHTS
    height = (height + abs(height)) / 2  # at least 0
    return alive * height + (1 - alive) * DEAD


def level_heights(level: np.ndarray) -> np.ndarray:
    """Pixel values in 0..1 of levels [...]: the middle of each, 1 for the highest; 0 without contact and for
    dead pixels."""
    value = np.where(level == HEIGHTS, 1.0, (level - 0.5) / HEIGHTS)
    return np.where((level > 0) & (level <= HEIGHTS), value, 0.0)


Background = tuple[np.ndarray, np.ndarray]
"""Pixels over all places: share [G] of those in contact, by group, and the distribution [G, HEIGHTS] of their
heights, of which each row sums to 1."""


def estimate_background(images: np.ndarray, group: np.ndarray) -> Background:
    """The background in images [N, D] of levels, with pixels in groups [D]."""
    groups = int(group.max()) + 1
    cell = (group * LEVELS + images).reshape(-1)
    count = np.bincount(cell, minlength=groups * LEVELS).reshape(groups, LEVELS)
    silent, contact = count[:, 0], count[:, 1:DEAD]
    touching = (contact.sum(axis=1) + 1.0) / (silent + contact.sum(axis=1) + 4.0)
    return touching, (contact + 1.0) / (contact + 1.0).sum(axis=1, keepdims=True)


def estimate_variation(now: np.ndarray, then: np.ndarray) -> Variation:
    """The variation in pairs of images [P, D] of one place, combined with the prior."""
    both = (now != DEAD) & (then != DEAD)
    silent, touching = both & (then == 0), both & (then > 0)
    pixels = now.shape[1] if now.ndim == 2 else 1
    weight = PRIOR_PAIRS * pixels / 2

    def share(part: np.ndarray, whole: np.ndarray, prior: float) -> float:
        return float((part.sum() + weight * prior) / (whole.sum() + weight))

    apart = np.abs(now - then)[touching & (now > 0)] / HEIGHTS
    width, outliers = PRIOR.width, PRIOR.outliers
    for _ in range(20):
        fits = (1 - outliers) * np.exp(-apart / width) / (2 * width)
        loose = outliers / (outliers + fits) if len(apart) else apart
        outliers = float((loose.sum() + weight * PRIOR.outliers) / (len(apart) + weight))
        width = float(((1 - loose) @ apart + weight * PRIOR.width) / ((1 - loose).sum() + weight))
    appears = share(silent & (now > 0), silent, PRIOR.appears)
    vanishes = share(touching & (now == 0), touching, PRIOR.vanishes)
    return Variation(appears, vanishes, width, outliers)


def log_odds_table(common: Background, visits: Variation) -> np.ndarray:
    """[G, LEVELS, LEVELS] log-odds of one place against two, by a pixel's group, its level now and its level
    in the earlier image."""
    height = (np.arange(HEIGHTS) + 0.5) / HEIGHTS
    near = np.exp(-np.abs(height[:, None] - height) / visits.width)
    near = near / near.sum(axis=0)
    log = np.zeros((len(common[0]), LEVELS, LEVELS))
    for g, (touching, heights) in enumerate(zip(*common, strict=True)):
        again = (1 - visits.outliers) * near + visits.outliers * heights[:, None]
        log[g, 0, 0] = np.log((1 - visits.appears) / (1 - touching))
        log[g, 1:DEAD, 0] = np.log(visits.appears / touching)
        log[g, 0, 1:DEAD] = np.log(visits.vanishes / (1 - touching))
        log[g, 1:DEAD, 1:DEAD] = np.log((1 - visits.vanishes) / touching * again / heights[:, None])
    return log
