"""The vote of all closure sequences on the heading bias, before any of them is accepted.

Each sequence is true with some odds, and if it is true it favours the biases with which odometry leads to its
place. A false sequence favours no bias that others favour as well. Nothing is linearised."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from ratslam.keyframes.optimizer import BiasPrior

SHRINK = 2.0
"""Standard deviations of the vote by which its mean must differ from the prior's to count."""


class BiasVote(NamedTuple):
    """Result of a vote.

    Attributes:
        belief: heading bias, shrunk towards the prior, rad/m. mean: the same, not shrunk. odds: [R] log odds
            that each sequence is true, with the bias that the prior and the others vote for.
    """

    belief: BiasPrior
    mean: float
    odds: np.ndarray


def vote(
    grid: np.ndarray, prior: BiasPrior, log_ratios: np.ndarray, score_odds: np.ndarray, least_sd: float
) -> BiasVote:
    """The vote of R sequences on the biases of `grid` [B], rad/m.

    Args:
        log_ratios: [R, B] of `BiasScan`. score_odds: [R] log odds by their scores. least_sd: least standard
            deviation of the belief.
    """
    votes = np.logaddexp(0.0, score_odds[:, None] + log_ratios)
    total = -0.5 * ((grid - prior.mean) / prior.sd) ** 2 + votes.sum(axis=0)
    others = total - votes
    others = others - logsumexp(others, axis=1, keepdims=True)
    share = np.exp(total - logsumexp(total))
    mean = float(share @ grid)
    sd = float(np.sqrt(share @ (grid - mean) ** 2))
    off = mean - prior.mean
    kept = prior.mean + (off * max(0.0, 1 - (SHRINK * sd / off) ** 2) if off else 0.0)
    belief = BiasPrior(kept, max(float(np.hypot(sd, mean - kept)), least_sd))
    return BiasVote(belief, mean, score_odds + logsumexp(others + log_ratios, axis=1))
