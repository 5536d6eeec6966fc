"""Experiences as groups of frames: where the robot is, said in places.

A new experience is made where none is near; a known one is reached by a closure that the map has confirmed,
or by the map's pose while such a closure is fresh. Recall alone never joins two places.
"""

from __future__ import annotations

from typing import NamedTuple

import networkx
import numpy as np

from ratslam.core.growable_array import GrowableArray
from ratslam.core.types import Action
from tactile.base.se2 import between, wrap


class ExperienceChange(NamedTuple):
    """The experience now, the one before, and how it was come by."""

    place: int
    previous: int
    action: Action


class Experiences:
    """Which experience each frame belongs to.

    Args:
        radius: reach of an experience, m. heading: the same, rad.
    """

    def __init__(self, radius: float, heading: float) -> None:
        self.radius, self.heading = radius, heading
        self._frame = GrowableArray((), np.int64)  # the frame each experience was made at
        self._place = GrowableArray((), np.int64)  # the experience of each frame
        self._link = GrowableArray((3,), np.int64)  # from, to, traversals
        self._link_of: dict[tuple[int, int], int] = {}
        self._current = -1

    def stay(self) -> ExperienceChange:
        """Nothing happened."""
        return ExperienceChange(self._current, self._current, Action.NONE)

    def arrive(self, poses: np.ndarray, frame: int, matched: int, sure: bool) -> ExperienceChange:
        """The experience of a new frame.

        Args:
            poses: [N, 3] of all frames. matched: the frame it was confirmed to be at, or -1.
            sure: whether the map's pose can be trusted to find a known experience.
        """
        previous = self._current
        place = int(self._place.rows[matched]) if matched >= 0 else self._near(poses, frame, sure)
        action = Action.NONE
        if place < 0:
            place, action = len(self._frame.rows), Action.CREATE
            self._frame.append(frame)
        elif place != previous:
            known = (previous, place) in self._link_of or (place, previous) in self._link_of
            action = Action.SET if known or previous < 0 else Action.LINK
        self._place.append(place)
        if place != previous and previous >= 0:
            self._traverse(previous, place)
        self._current = place
        return ExperienceChange(place, previous, action)

    def graph(self, poses: np.ndarray) -> networkx.DiGraph:
        """Nodes with x, y (m), heading (rad), frame; links with dx, dy, dtheta and traversals."""
        graph: networkx.DiGraph = networkx.DiGraph()
        for place, frame in enumerate(self._frame.rows.tolist()):
            x, y, heading = map(float, poses[frame])
            graph.add_node(place, x=x, y=y, heading=heading, frame=frame)
        for a, b, traversals in self._link.rows.tolist():
            ends = poses[self._frame.rows[[a, b]]]
            dx, dy, dtheta = map(float, between(ends[0], ends[1]))
            graph.add_edge(a, b, dx=dx, dy=dy, dtheta=dtheta, traversals=traversals)
        return graph

    def _near(self, poses: np.ndarray, frame: int, sure: bool) -> int:
        """The current experience while within its reach, else (if sure) the nearest within reach, or -1."""
        if not len(self._frame.rows):
            return -1
        apart = poses[self._frame.rows] - poses[frame]
        turned = wrap(apart[:, 2])
        far = np.hypot(np.hypot(apart[:, 0], apart[:, 1]) / self.radius, turned / self.heading)
        if far[self._current] <= 1:
            return self._current
        best = int(np.argmin(far))
        return best if sure and far[best] <= 1 else -1

    def _traverse(self, a: int, b: int) -> None:
        if (a, b) not in self._link_of:
            self._link_of[a, b] = len(self._link.rows)
            self._link.append((a, b, 0))
        self._link.rows[self._link_of[a, b], 2] += 1

    def arrays(self) -> dict[str, np.ndarray]:
        """Its whole state."""
        return {
            "frame": self._frame.rows.copy(),
            "place": self._place.rows.copy(),
            "link": self._link.rows.copy(),
            "current": np.array(self._current),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self._frame.replace(arrays["frame"])
        self._place.replace(arrays["place"])
        self._link.replace(arrays["link"])
        self._current = int(arrays["current"])
        self._link_of = {(a, b): k for k, (a, b, _) in enumerate(self._link.rows.tolist())}
