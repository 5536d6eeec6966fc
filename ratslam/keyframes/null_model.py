"""The null: scores of closure sequences that are false by construction, and the odds that follow.

The control of recall recognises places in mirror images (`ratslam.recall.mirror`). Its sequences have the
number and the scores of the false sequences of this world. A sequence of score s is then true with odds

    true sequences per score / false sequences per score = (T e^(-s/m) / m) / (n e^(-(s - s0)/t) / t)

with n sequences of the control above s0 and their mean excess t. The method is ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LEAST_SCORE = 2.0
"""Least score, s0, of the sequences of the control that count."""
PRIOR_COUNT, PRIOR_EXCESS = 5.0, 7.0
"""The prior of the excess: the number of sequences that it counts as, and their mean excess over s0."""
PRIOR_SEQUENCES, PRIOR_KEYFRAMES = 3.0, 16.0
"""The gamma prior of the rate of the control's sequences: as many sequences in as many keyframes."""
TRUE_MEAN = 30.0
"""Mean score, m, of true sequences."""
MIN_TRUE = 5.0
"""Least number of true sequences, T, that is expected in a session."""


class NullModel(NamedTuple):
    """Number of false sequences above `LEAST_SCORE`, and their mean excess over it."""

    number: float
    excess: float


def estimate_null(scores: np.ndarray, keyframes: int) -> NullModel:
    """The null from the scores [n] of the control's sequences in a session of so many keyframes."""
    above = scores[scores >= LEAST_SCORE] - LEAST_SCORE
    excess = (above.sum() + PRIOR_COUNT * PRIOR_EXCESS) / (len(above) + PRIOR_COUNT)
    keyframes = max(keyframes, 1)
    number = keyframes * (PRIOR_SEQUENCES + len(above)) / (PRIOR_KEYFRAMES + keyframes)
    # A control stronger than true sequences would let evidence lower the odds.
    return NullModel(number, min(float(excess), TRUE_MEAN))


def log_odds(score: np.ndarray, null: NullModel, true_count: float) -> np.ndarray:
    """[n] log odds that sequences with these scores [n] are true, before the map is asked.

    Args:
        true_count: number of true sequences known so far.
    """
    true = np.log(max(true_count, MIN_TRUE) / TRUE_MEAN) - score / TRUE_MEAN
    return true - np.log(null.number / null.excess) + (score - LEAST_SCORE) / null.excess
