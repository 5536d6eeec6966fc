"""Experiences: groups of keyframes, the places of the keyframe map.

A new experience is created where none is near. A known one is reached by a confirmed closure, or by the
map's pose shortly after such a closure; recall alone never joins two places.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.core.estimates import Action
from tactile.base.compiled import compiled, wrapped
from tactile.base.se2 import between, compose

if TYPE_CHECKING:
    import networkx


class Experiences(Checkpointed):
    """The experience of each keyframe.

    Args:
        radius: of an experience, m. heading: largest difference in heading within one, rad.

    Attributes:
        current: the experience of the newest keyframe, -1 before the first.
    """

    VALUES = ("current",)

    def __init__(self, radius: float, heading: float) -> None:
        self.radius, self.heading = radius, heading
        self._frame = GrowableArray((), np.int64)  # the keyframe that holds each experience
        self._offset = GrowableArray((3,), np.float64)  # the pose of each experience in its keyframe's frame
        self._place = GrowableArray((), np.int64)  # the experience of each keyframe
        self._link = GrowableArray((3,), np.int64)  # from, to, traversals
        self._link_of: dict[tuple[int, int], int] = {}
        self.current = -1

    def arrive(
        self, poses: np.ndarray, frame: int, matched: int, reliable: bool, begins: bool = False
    ) -> tuple[int, int, Action]:
        """The experience of a new keyframe, the one before, and the action that led to it.

        Args:
            poses: [N, 3] of all keyframes. matched: the keyframe of a confirmed closure, or -1.
            reliable: the map's pose is accurate enough to find a known experience. begins: a piece begins
                with the keyframe: no link leads to its experience.
        """
        previous = -1 if begins else self.current
        place = int(self._place.rows[matched]) if matched >= 0 else -1
        if matched < 0 and len(self._frame.rows):
            # The current experience if in reach, else the nearest in reach if the pose is reliable.
            held, offset = self._frame.rows, self._offset.rows
            far = _measure_distances(poses, held, offset, frame, self.radius, self.heading)
            best = int(np.argmin(far))
            if self.current >= 0 and far[self.current] <= 1:
                place = self.current
            elif reliable and far[best] <= 1:
                place = best
        action = Action.NONE
        if place < 0:
            place, action = len(self._frame.rows), Action.CREATE
            self._frame.append(frame)
            self._offset.append((0.0, 0.0, 0.0))
        elif place != previous:
            known = (previous, place) in self._link_of or (place, previous) in self._link_of
            action = Action.SET if known or previous < 0 else Action.LINK
        self._place.append(place)
        if place != previous and previous >= 0:
            if (previous, place) not in self._link_of:
                self._link_of[previous, place] = len(self._link.rows)
                self._link.append((previous, place, 0))
            self._link.rows[self._link_of[previous, place], 2] += 1
        self.current = place
        return place, previous, action

    def merge(self, source: np.ndarray, onto: np.ndarray, offset: np.ndarray) -> None:
        """Follows a merge of keyframes, see `MergedRows`.

        An experience keeps its pose, also where its keyframe is merged with one that faces the other way.
        """
        frame = self._frame.rows
        self._offset.rows[:] = compose(offset[frame], self._offset.rows)
        frame[:] = onto[frame]
        self._place.replace(self._place.rows[source])

    def take(self, row: np.ndarray, own: np.ndarray, number: np.ndarray, poses: np.ndarray) -> None:
        """Reduces the experiences to those with keyframes that remain, and the links to those between them.

        Args:
            row: [E] keyframe of the map that each keyframe ever taken is or is merged with; none is merged
                thereafter. own: [N] number of each keyframe of the map among all ever taken. number: [E]
                new number of each of these, -1 if it does not remain. poses: [E, 3] of all.
        """
        place, taken = self._place.rows[row], np.flatnonzero(number >= 0)
        places, first = np.unique(place[taken], return_index=True)
        before = own[self._frame.rows]  # the keyframe that holds each experience
        held = compose(poses[before], self._offset.rows)[places]
        holder = np.where(number[before[places]] >= 0, before[places], taken[first])
        self._offset.replace(between(poses[holder], held))
        self._frame.replace(number[holder])
        self._place.replace(np.searchsorted(places, place[taken]))
        again = np.full(len(before), -1)
        again[places] = np.arange(len(places))
        links = np.column_stack([again[self._link.rows[:, :2]], self._link.rows[:, 2]])
        self._link.replace(links[(links[:, :2] >= 0).all(axis=1)])
        self._link_of = {(a, b): k for k, (a, b, _) in enumerate(self._link.rows.tolist())}
        self.current = int(again[self.current]) if self.current >= 0 else -1

    def graph(self, poses: np.ndarray, taken: np.ndarray, piece: np.ndarray) -> networkx.DiGraph:
        """Nodes with x, y (m), heading (rad), keyframe, piece; links within pieces with dx, dy, dtheta and
        traversals.

        Args:
            poses: [N, 3] of the keyframes. taken: [N] their numbers among all ever taken. piece: [N] of
            each.
        """
        import networkx  # slow to import

        graph: networkx.DiGraph = networkx.DiGraph()
        places = compose(poses[self._frame.rows], self._offset.rows)
        for place, frame in enumerate(self._frame.rows.tolist()):
            x, y, heading = map(float, places[place])
            keyframe = int(taken[frame])
            graph.add_node(place, x=x, y=y, heading=heading, keyframe=keyframe, piece=int(piece[frame]))
        for a, b, traversals in self._link.rows.tolist():
            if graph.nodes[a]["piece"] != graph.nodes[b]["piece"]:
                continue
            dx, dy, dtheta = map(float, between(places[a], places[b]))
            graph.add_edge(a, b, dx=dx, dy=dy, dtheta=dtheta, traversals=traversals)
        return graph

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._link_of = {(a, b): k for k, (a, b, _) in enumerate(self._link.rows.tolist())}


@compiled
def _measure_distances(
    poses: np.ndarray, held: np.ndarray, offset: np.ndarray, frame: int, radius: float, turn: float
) -> np.ndarray:
    """[E] distances of a keyframe from the experiences at `offset` [E, 3] in the frames of keyframes `held`
    [E], 1 where they are `radius` (m) or `turn` (rad) away."""
    far = np.empty(len(held))
    x, y, heading = poses[frame]
    for e in range(len(held)):
        x0, y0, heading0 = poses[held[e]]
        c, s = np.cos(heading0), np.sin(heading0)
        dx = x0 + c * offset[e, 0] - s * offset[e, 1] - x
        dy = y0 + s * offset[e, 0] + c * offset[e, 1] - y
        turned = wrapped(heading0 + offset[e, 2] - heading)
        far[e] = np.hypot(np.hypot(dx, dy) / radius, turned / turn)
    return far
