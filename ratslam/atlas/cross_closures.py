"""Loop closures between a session and the ground that its path is on."""

from __future__ import annotations

import numpy as np

from ratslam.alignment.comparison import Comparison
from ratslam.alignment.ground import Ground
from ratslam.alignment.paths import Path


def closures_along(ground: Ground, views: Comparison, path: Path) -> list[tuple[int, int, int, float]]:
    """The keyframe of the ground that fits best at each pose of a path, where any fits better than a new
    place.

    Args:
        views: of the session's n keyframes. path: of the same.

    Returns:
        number among the session's keyframes, keyframe of the ground, row of the sector shift, and gain, nat.
    """
    found = []
    for k, pose in enumerate(path.poses):
        gain = views.gains(k)
        shift, frame = ground.near(pose, ground.reach, ground.reach_heading)
        if gain is None or not len(frame):
            continue
        best = int(np.argmax(gain[shift, frame]))
        fit = float(gain[shift[best], frame[best]])
        if fit > 0:
            found.append((k, int(frame[best]), int(shift[best]), fit))
    return found
