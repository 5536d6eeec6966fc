"""How gains are weighed: as they are, or less for views that many places share."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from ratslam.alignment.gain_odds import PRIOR, GainPrior

COMMON = 0.5
"""Factor on the logarithm of a view's mean likelihood over the whole ground, subtracted from its gains."""
COMMON_OF_PIECE = 0.25
"""The same factor for a piece of a growing map."""


class Weighing(NamedTuple):
    """Attributes:
    weigh: from gains [..., S, N] of views on a whole ground to those that are counted. prior: of these.
    matching: mean of those before one above which a false pose still looks right, nat.
    """

    weigh: Callable[[np.ndarray], np.ndarray]
    prior: GainPrior
    matching: float


def _as_they_are(gain: np.ndarray) -> np.ndarray:
    return gain


def less_where_common(gain: np.ndarray, share: float = COMMON) -> np.ndarray:
    """Gains [..., S, N] of views on a ground, less where the whole ground fits a view: a view that fits many
    places, or any wall, tells little of where the robot is, nor whether it is on this ground. Ours; a full
    Bayes filter would divide by the mean likelihood."""
    most = gain.max(axis=(-2, -1), keepdims=True, initial=-np.inf)
    mean = np.exp(gain - most).mean(axis=(-2, -1), keepdims=True)
    return gain - share * (most + np.log(mean))


PLAIN = Weighing(_as_they_are, PRIOR, 1.0)
"""For two pieces of finished maps, of which many keyframes are compared."""
PIECE = Weighing(
    partial(less_where_common, share=COMMON_OF_PIECE), GainPrior(true=(2.4, 0.8), false=(1.0, 1.6)), 1.5
)
"""For the newest piece of a growing map."""
DISTINCT = Weighing(less_where_common, GainPrior(true=(2.95, 0.8), false=(1.55, 1.6)), 2.0)
"""For a session of which few keyframes are known."""
