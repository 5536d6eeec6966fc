"""Paths: a supposed pose followed through many keyframes of a session."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from ratslam.alignment.following import Motion, Supposed, advance
from ratslam.alignment.gain_odds import LEAVING, GainOdds
from ratslam.alignment.ground import Ground

NEAR = 0.5
"""Largest distance and turn from a keyframe at which a view counts by its gain, as shares of the ground's
reaches: beside the driven way, and at headings that were not driven, views differ although the pose is
right."""
BESIDE = -1.0
"""Least log-odds of a view on ground that was driven, but not near the way: one or two in a hundred views of
a map's own revisits lie there, and three in ten of paths that only look alike."""


class Path(NamedTuple):
    """A supposed pose followed through n keyframes: poses [n, 3], covariances [n, 3, 3], and log-odds [n] of
    each keyframe."""

    poses: np.ndarray
    covariances: np.ndarray
    odds: np.ndarray


Judge = Callable[[Ground, GainOdds, np.ndarray, float, bool], tuple[float, bool]]
"""Log-odds of a view, and whether it is on mapped ground; from the ground, its odds, the pose [3], the gain
of the best keyframe near by (NaN without one), and whether the keyframe before is on mapped ground."""


def judge_everywhere(
    ground: Ground, odds: GainOdds, pose: np.ndarray, gain: float, inside: bool
) -> tuple[float, bool]:
    """Each view counts by its gain."""
    return keyframe_odds(odds, gain, inside, True)


def judge_on_the_way(
    ground: Ground, odds: GainOdds, pose: np.ndarray, gain: float, inside: bool
) -> tuple[float, bool]:
    """Views near the driven way count by their gain, those beside it by little."""
    if ground.is_near(pose, NEAR):
        return odds.of(gain), True
    if ground.is_passed(pose):
        return (BESIDE if np.isnan(gain) else min(max(odds.of(gain), BESIDE), 0.0)), inside
    return keyframe_odds(odds, gain, inside, bool(np.isnan(gain)))


def follow(
    ground: Ground,
    odds: GainOdds,
    at: Supposed,
    onwards: Iterable[tuple[Motion, np.ndarray | None]],
    least: float = -np.inf,
    judge: Judge = judge_everywhere,
) -> Path:
    """The path from a supposed pose on mapped ground; ends early once its log-odds are below `least`.

    Args:
        onwards: the motion into each further keyframe, and the gains [S, N] of its view, None if it shows
            nothing. judge: gives the log-odds of each view that shows something.
    """
    poses, covariances, gained = [at.pose], [at.covariance], [0.0]
    total, inside = 0.0, True
    for moved, gains in onwards:
        at, gain = advance(ground, at, moved, gains)
        log_odds = 0.0
        if gains is not None:
            log_odds, inside = judge(ground, odds, at.pose, gain, inside)
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
