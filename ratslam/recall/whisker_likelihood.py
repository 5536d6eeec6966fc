"""How alike two whisker images are: log-odds of one place against two, learned from the session itself.

A pixel is silent, dead, or has one of a few heights. What a pixel says depends on how often whiskers touch
anything here, on which heights are common, and on how much one visit to a place differs from the next. All
three are counted: the first two over all images, the last over pairs of images that the map has found to be
of one place. Before there are such pairs a prior stands for them. No truth is used; the model is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.types import Array

LEVELS = 32
"""Of a pixel: 0 silent, 1 to 30 heights, 31 dead."""
DEAD = LEVELS - 1
HEIGHTS = DEAD - 1


class Variation(NamedTuple):
    """How one visit differs from the next.

    Attributes:
        appears, vanishes: shares of silent pixels that touch, and of touching ones that are silent, on the
            next visit. width: mean difference of heights, full scale 1. astray: share of heights that have
            nothing to do with the former.
    """

    appears: float
    vanishes: float
    width: float
    astray: float


PRIOR = Variation(0.07, 0.17, 0.08, 0.1)
"""Visits of an arm whose path repeats to some 5 mm."""
PRIOR_PAIRS = 20.0
"""Pairs of images that the prior is worth."""


class Pixels(NamedTuple):
    """How the pixels of a whisker image [R, C, K], flat, belong together; D of them.

    Attributes:
        group: [D] those of one ring and channel, which are alike. behind: [D] the pixel that felt what this
            one feels before the head turned about: of the whisker opposite. columns: whiskers in a ring.
    """

    group: np.ndarray
    behind: np.ndarray
    columns: int


def pixels(view_shape: tuple[int, int, int]) -> Pixels:
    """Of images of that shape."""
    _, columns, channels = view_shape
    row, _, channel = np.indices(view_shape)
    number = np.arange(row.size).reshape(view_shape)
    behind = np.roll(number, -(columns // 2), axis=1)
    return Pixels((row * channels + channel).reshape(-1), behind.reshape(-1), columns)


def levels(view: Array, alive: Array) -> Array:
    """The level of every pixel: of values [...] in 0..1, and whether their whiskers report [...] (0 or 1).

    Operators only, so it serves NumPy and JAX alike; whole numbers of the view's own type, which `alive` has
    to be of, too, where types are strict.
    """
    height = -(-view * HEIGHTS // 1)
    height = (height + HEIGHTS - abs(height - HEIGHTS)) / 2  # at most
    height = (height + abs(height)) / 2  # at least 0
    return alive * height + (1 - alive) * DEAD


class Background(NamedTuple):
    """What pixels are like anywhere.

    Attributes:
        touching: [G] share of pixels that touch, by group. heights: [G, HEIGHTS] how the others' heights are
            distributed, sums 1.
    """

    touching: np.ndarray
    heights: np.ndarray


def background(images: np.ndarray, group: np.ndarray) -> Background:
    """Of images [N, D] of levels, pixels in groups [D]."""
    groups = int(group.max()) + 1
    touching, heights = np.zeros(groups), np.zeros((groups, HEIGHTS))
    for g in range(groups):
        level = images[:, group == g]
        level = level[level != DEAD]
        contact = level[level > 0]
        touching[g] = (len(contact) + 1.0) / (len(level) + 4.0)
        count = np.bincount(contact - 1, minlength=HEIGHTS) + 1.0
        heights[g] = count / count.sum()
    return Background(touching, heights)


def variation(now: np.ndarray, then: np.ndarray) -> Variation:
    """Of pairs [P, D] of images of one place, with the prior in it."""
    both = (now != DEAD) & (then != DEAD)
    silent, touching = both & (then == 0), both & (then > 0)
    pixels = now.shape[1] if now.ndim == 2 else 1
    weight = PRIOR_PAIRS * pixels / 2

    def share(part: np.ndarray, whole: np.ndarray, prior: float) -> float:
        return float((part.sum() + weight * prior) / (whole.sum() + weight))

    apart = np.abs(now - then)[touching & (now > 0)] / HEIGHTS
    width, astray = PRIOR.width, PRIOR.astray
    for _ in range(20):
        fits = (1 - astray) * np.exp(-apart / width) / (2 * width)
        loose = astray / (astray + fits) if len(apart) else apart
        astray = float((loose.sum() + weight * PRIOR.astray) / (len(apart) + weight))
        width = float(((1 - loose) @ apart + weight * PRIOR.width) / ((1 - loose).sum() + weight))
    return Variation(
        share(silent & (now > 0), silent, PRIOR.appears),
        share(touching & (now == 0), touching, PRIOR.vanishes),
        width,
        astray,
    )


def table(common: Background, visits: Variation) -> np.ndarray:
    """[G, LEVELS, LEVELS] log-odds that a pixel of this level now (second axis) and of that level then (last
    axis) show one place rather than two."""
    height = (np.arange(HEIGHTS) + 0.5) / HEIGHTS
    near = np.exp(-np.abs(height[:, None] - height) / visits.width)
    near = near / near.sum(axis=0)
    log = np.zeros((len(common.touching), LEVELS, LEVELS))
    for g, (touching, heights) in enumerate(zip(common.touching, common.heights, strict=True)):
        again = (1 - visits.astray) * near + visits.astray * heights[:, None]
        log[g, 0, 0] = np.log((1 - visits.appears) / (1 - touching))
        log[g, 1:DEAD, 0] = np.log(visits.appears / touching)
        log[g, 0, 1:DEAD] = np.log(visits.vanishes / (1 - touching))
        log[g, 1:DEAD, 1:DEAD] = np.log((1 - visits.vanishes) / touching * again / heights[:, None])
    return log
