"""How much a report speaks for a supposed pose in a finished map.

Reports were counted in arenas 100 to 119: at the true poses of sessions in the map of their arena, and at the
best of the four poses at which the walls of *another* arena fit, as `Expectation` classes them. The classes
are in shares of a whisker's length, so the counts do not depend on its size. The method is ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.grid.expectation import CLASSES, CROSSINGS, TIPS

PRIOR = 3.0
"""Reports in each class before any were counted."""
FREE, CONTACT = 0, 1
"""Rows of `WhiskerCounts`: a free whisker, a new contact."""
_TRUE = [
    [[2, 12, 44], [14, 13, 303], [1, 4, 880], [72, 68, 685], [951, 73, 34], [9449, 175, 57]],
    [[0, 1, 16], [0, 0, 330], [0, 0, 107], [0, 0, 5], [0, 0, 1], [0, 7, 0]],
]
_ALIKE = [
    [[67, 296, 546], [28, 39, 934], [6, 14, 1625], [163, 149, 1185], [1937, 125, 57], [19245, 543, 95]],
    [[0, 43, 80], [0, 2, 469], [0, 0, 233], [1, 3, 47], [12, 3, 1], [43, 26, 7]],
]
"""Free whiskers and new contacts [2, CROSSINGS, TIPS] at true poses, and at poses in another arena."""
_TRUE_WALLS, _ALIKE_WALLS = [304, 4, 0, 0, 4, 24], [494, 42, 19, 1, 18, 124]
"""Walls by the difference of their direction."""
_TRUE_BODY = [5684, 16, 0, 0]
_DRIVEN_BODY = [0.97, 0.01, 0.01, 0.01]
"""Bodies at true poses, and the shares of the classes anywhere on driven ground."""


class Agreement(NamedTuple):
    """Log-likelihoods of a report's parts by class.

    Attributes:
        whisker: [2, CLASSES] of a free whisker and of a new contact at a true pose. wall: [WALL_CLASSES].
            body: [4], less those anywhere. odds, wall_odds: as `whisker` and `wall`, less those at an alike
            pose elsewhere.
    """

    whisker: np.ndarray
    wall: np.ndarray
    body: np.ndarray
    odds: np.ndarray
    wall_odds: np.ndarray


def counted_agreement() -> Agreement:
    """The log-likelihoods as counted."""
    true, alike = (_chances(np.array(counts, float)) for counts in (_TRUE, _ALIKE))
    wall, other = (_shares(np.array(counts, float)) for counts in (_TRUE_WALLS, _ALIKE_WALLS))
    body = _shares(np.array(_TRUE_BODY, float)) - np.log(_DRIVEN_BODY)
    return Agreement(true, wall, body, true - alike, wall - other)


def _chances(counts: np.ndarray) -> np.ndarray:
    """[2, CLASSES] logarithms of the chances of no contact and of a contact."""
    assert counts.shape == (2, CROSSINGS, TIPS)
    counts = counts.reshape(2, CLASSES)
    counts = counts + PRIOR * counts.sum(axis=1, keepdims=True) / counts.sum()
    return np.log(counts / counts.sum(axis=0))


def _shares(counts: np.ndarray) -> np.ndarray:
    return np.log((counts + 1) / (counts + 1).sum())
