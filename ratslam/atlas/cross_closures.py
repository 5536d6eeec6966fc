"""Loop closures between a session and the ground that its path is on."""

from __future__ import annotations

from ratslam.alignment.comparison import Comparison
from ratslam.alignment.ground import Ground, Match
from ratslam.alignment.paths import Path


def closures_along(ground: Ground, views: Comparison, path: Path) -> list[tuple[int, Match]]:
    """Keyframes of a session, by number, and where on the ground each fits best at its pose of a path, if it
    fits anything there better than a new place.

    Args:
        views: of the session's n keyframes. path: of the same.
    """
    found = []
    for k, pose in enumerate(path.poses):
        gain = views.gains(k)
        match = ground.best_match(pose, gain) if gain is not None else None
        if match is not None:
            found.append((k, match))
    return found
