"""Paths: a supposed pose followed through many keyframes of a session."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from ratslam.alignment.following import Motion, Supposed, advance
from ratslam.alignment.gain_odds import LEAVING, GainOdds
from ratslam.alignment.ground import Ground


NEAR = 0.5
"""Largest distance and turn from a keyframe at which a view of a known path counts, as shares of the ground's
reaches: beside the driven way, and at headings that were not driven, views differ although the pose is right."""


class Path(NamedTuple):
    """A supposed pose followed through n keyframes: poses [n, 3], covariances [n, 3, 3], and log-odds [n] of
    each keyframe."""

    poses: np.ndarray
    covariances: np.ndarray
    odds: np.ndarray


Counts = Callable[[Ground, np.ndarray, float], bool]
"""Whether a view counts at a pose [3] on a ground, given its gain there, NaN where no keyframe is near."""


def every_view(ground: Ground, pose: np.ndarray, gain: float) -> bool:
    """Every view counts."""
    return True


def views_on_the_way(ground: Ground, pose: np.ndarray, gain: float) -> bool:
    """Views near the driven way count, and having left it (`NEAR`)."""
    return not ground.is_passed(pose) if np.isnan(gain) else ground.is_near(pose, NEAR)


def follow(
    ground: Ground,
    odds: GainOdds,
    at: Supposed,
    onwards: Iterable[tuple[Motion, np.ndarray | None]],
    least: float = -np.inf,
    counts: Counts = every_view,
) -> Path:
    """The path from a supposed pose on mapped ground; ends early once its log-odds are below `least`.

    Args:
        onwards: the motion into each further keyframe, and the gains [S, N] of its view, None if it shows
            nothing. counts: whether a view counts.
    """
    poses, covariances, gained = [at.pose], [at.covariance], [0.0]
    total, inside = 0.0, True
    for moved, gains in onwards:
        at, gain = advance(ground, at, moved, gains)
        shows = gains is not None and counts(ground, at.pose, gain)
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
