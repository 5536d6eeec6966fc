"""Where to move while the place on the map is not known: ahead where contacts leave room, else it turns."""

from __future__ import annotations

import numpy as np

AHEAD, HALF_WIDTH = 0.1, 0.045
"""Length and half the width of the free space that a move ahead needs, m."""
STEP = 0.05
"""Length of a move, m: about as far as the head comes in a whisk."""
TURN = 0.5
"""Turn on the spot where the way ahead is not free, rad."""


class GoalSearch:
    """A cautious search along free directions: the robot turns to the side with fewer contacts, and keeps
    turning to it until the way ahead is free.

    Args:
        longest: way after which the search ends, m.
    """

    def __init__(self, longest: float) -> None:
        self._left = longest
        self._side = 0.0
        self._refused = False

    def next_move(self, points: np.ndarray) -> np.ndarray | None:
        """The pose [3] in base_link to move to; None at the end of the search.

        Args:
            points: [n, 2] contacts of the last whisks in base_link, m.
        """
        if self._left <= 0:
            return None
        ahead = (points[:, 0] > 0) & (points[:, 0] < AHEAD) & (np.abs(points[:, 1]) < HALF_WIDTH)
        if ahead.any() or self._refused:
            self._refused = False
            if not self._side:
                front = points[points[:, 0] > 0, 1]
                self._side = 1.0 if (front > 0).sum() <= (front < 0).sum() else -1.0
            self._left -= STEP  # a robot that only turns finds an end, too
            return np.array([0.0, 0.0, self._side * TURN])
        self._side = 0.0
        self._left -= STEP
        return np.array([STEP, 0.0, 0.0])

    def refuse(self) -> None:
        """Takes note that the robot cannot move there."""
        self._refused = True
