"""Paths: a supposed pose followed through many keyframes of a session."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ratslam.alignment.following import Motion, Supposed, advance
from ratslam.alignment.gain_odds import LEAVING, GainOdds
from ratslam.alignment.ground import Ground


class Path(NamedTuple):
    """A supposed pose followed through n keyframes: poses [n, 3], covariances [n, 3, 3], and log-odds [n] of
    each keyframe."""

    poses: np.ndarray
    covariances: np.ndarray
    odds: np.ndarray


def follow(
    ground: Ground,
    odds: GainOdds,
    at: Supposed,
    onwards: Iterable[tuple[Motion, np.ndarray | None]],
    least: float = -np.inf,
    near: float = np.inf,
) -> Path:
    """The path from a supposed pose on mapped ground; ends early once its log-odds are below `least`.

    Args:
        onwards: the motion into each further keyframe, and the gains [S, N] of its view, None if it shows
            nothing. near: largest distance, m, from a keyframe of the ground at which a view counts.
    """
    poses, covariances, gained = [at.pose], [at.covariance], [0.0]
    total, inside = 0.0, True
    for moved, gains in onwards:
        at, gain = advance(ground, at, moved, gains)
        shows = gains is not None and (np.isnan(gain) or ground.is_near(at.pose, near))
        log_odds, inside = keyframe_odds(odds, gain, inside, shows)
        poses.append(at.pose)
        covariances.append(at.covariance)
        gained.append(log_odds)
        total += log_odds
        if total < least:
            break
    return Path(np.array(poses), np.array(covariances), np.array(gained))


def keyframe_odds(odds: GainOdds, gain: float, inside: bool, shows: bool) -> tuple[float, bool]:
    """Log-odds of one keyframe, and whether it is on mapped ground.

    Args:
        gain: of its best keyframe near by, NaN without one. inside: whether the keyframe before is on mapped
            ground. shows: whether its view can be compared.
    """
    if not shows:
        return 0.0, inside
    if np.isnan(gain):
        return (LEAVING if inside else 0.0), False
    return odds.of(gain), True
