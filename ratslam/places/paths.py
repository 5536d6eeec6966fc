"""Paths: a supposed pose followed through many keyframes of a session."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ratslam.mapping.following import Motion, Supposed, advance
from ratslam.mapping.gain_odds import LEAVING, GainOdds
from ratslam.mapping.ground import Ground

BESIDE = -1.0
"""Least log-odds of a view on ground that was driven, but not near the way: one or two in a hundred views of
a map's own revisits lie there, and three in ten of paths that only look alike."""
AGAIN = 6
"""Keyframes after which a path that comes back to a place visits it again."""
AGAIN_SHARE = 0.5
"""Share of the evidence for a path that counts there."""
BESIDE_SHARE = 0.3
"""Share of the evidence against a path that counts beside the way after the first such keyframe of a run."""


class Path(NamedTuple):
    """A supposed pose followed through n keyframes: poses [n, 3], m, m, rad; covariances [n, 3, 3]; and
    log-odds [n] of each keyframe, nat."""

    poses: np.ndarray
    covariances: np.ndarray
    odds: np.ndarray


def follow(
    ground: Ground,
    odds: GainOdds,
    at: Supposed,
    onwards: Iterable[tuple[Motion, np.ndarray | None]],
    least: float = -np.inf,
) -> Path:
    """The path from a supposed pose on mapped ground; ends early once its log-odds are below `least`.

    Args:
        onwards: the motion into each further keyframe, and the gains [S, N] of its view, None if it shows
            nothing.
    """
    poses, covariances, gained = [at.pose], [at.covariance], [0.0]
    total, inside = 0.0, True
    for moved, gains in onwards:
        at, gain = advance(ground, at, moved, gains)
        log_odds, inside = keyframe_odds(ground, odds, at.pose, gain, inside)
        poses.append(at.pose)
        covariances.append(at.covariance)
        gained.append(log_odds)
        total += log_odds
        if total < least:
            break
    return Path(np.array(poses), np.array(covariances), np.array(gained))


def keyframe_odds(
    ground: Ground, odds: GainOdds, pose: np.ndarray, gain: float | None, inside: bool
) -> tuple[float, bool]:
    """Log-odds of one keyframe, nat, and whether it is on mapped ground.

    Args:
        pose: [3] where it is supposed to be. gain: see `advance`.
        inside: whether the keyframe before is on mapped ground.
    """
    if gain is None:
        return 0.0, inside
    if ground.is_near(pose):
        return odds.of(gain), True
    if ground.is_passed(pose):
        return (BESIDE if np.isnan(gain) else min(max(odds.of(gain), BESIDE), 0.0)), inside
    if np.isnan(gain):
        return (LEAVING if inside else 0.0), False
    return 0.0, inside  # the pose is so uncertain that keyframes beyond the reach were compared


def counted_beside(ground: Ground, path: Path) -> np.ndarray:
    """[n] the log-odds of each keyframe, nat; of those in a run beside the driven way, less after the first:
    a path beside the way stays there for some keyframes, and the map may be bent there."""
    beside = np.array([ground.is_passed(pose) and not ground.is_near(pose) for pose in path.poses])
    still = beside & np.concatenate([[False], beside[:-1]])
    return np.where(still & (path.odds < 0), BESIDE_SHARE * path.odds, path.odds)


def at_undriven_headings(ground: Ground, path: Path) -> np.ndarray:
    """[n] bool: on the driven way, but at no heading that was driven there, so that a right pose and a wrong
    one may both look unlike it."""
    near = np.array([ground.is_near(pose) for pose in path.poses])
    apart = np.array([np.hypot(*(ground.poses[:, :2] - pose[:2]).T).min() for pose in path.poses])
    return ~near & (apart < ground.near_share * ground.reach)


def less_where_dependent(ground: Ground, path: Path) -> np.ndarray:
    """[n] the log-odds of each keyframe, nat, less where a keyframe before has said nearly the same.

    A place elsewhere that is alike is alike at each visit, and often from every heading; one that is not,
    contradicts at each.
    """
    apart = np.hypot(*(path.poses[:, None, :2] - path.poses[None, :, :2]).T)
    keyframe = np.arange(len(apart))
    earlier = keyframe[:, None] - keyframe >= AGAIN
    again = (earlier & (apart < ground.near_share * ground.reach)).any(axis=1)
    odds = counted_beside(ground, path)
    return np.where(again & (odds > 0), AGAIN_SHARE * odds, odds)
