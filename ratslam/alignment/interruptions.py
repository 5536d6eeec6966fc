"""Log-odds of a pose that is right although its views contradict the map for a while: the place has changed.

A hidden Markov model with a state in which the views agree, and a changed state of bounded length in which
they are as likely as at the other place that they resemble most. A short contradiction costs its prior,
however strong it is; one that lasts, or views of another known place, are those of a wrong pose. The model is
ours."""

from __future__ import annotations

import numpy as np

LONGEST = 12
"""Longest stretch of changed ground, keyframes."""
SHARE = 1e-4
"""Share of keyframes at which such a stretch begins; each length is as likely as another."""


def uninterrupted(count: int) -> np.ndarray:
    """[count, 1 + LONGEST] log-odds of poses at which all views agreed: of agreement, and of a changed
    stretch that lasts 1, 2, ... more keyframes."""
    states = np.full((count, 1 + LONGEST), -np.inf)
    states[:, 0] = 0.0
    return states


def continue_states(states: np.ndarray, odds: np.ndarray, elsewhere: np.ndarray) -> np.ndarray:
    """The log-odds [n, 1 + LONGEST] after one more keyframe.

    Args:
        odds: [n] log-odds of its view. elsewhere: [n] those at another place like it, 0 without one.
    """
    agrees, changed = states[:, 0], states[:, 1:]
    following = np.empty_like(states)
    following[:, 0] = np.logaddexp(agrees + np.log1p(-SHARE), changed[:, 0]) + odds
    following[:, 1:] = agrees[:, None] + np.log(SHARE / LONGEST)
    following[:, 1:-1] = np.logaddexp(following[:, 1:-1], changed[:, 1:])
    following[:, 1:] -= elsewhere[:, None]
    return following


def summed(states: np.ndarray) -> np.ndarray:
    """[n] log-odds of the poses, whether interrupted now or not."""
    return np.logaddexp.reduce(states, axis=1)
