"""Plans ways to goals on a saved map for a drive (`robot.live.goal_drive`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ratslam.core.backend import Map
from ratslam.mapping.appearance import WhiskerAppearance
from ratslam.mapping.map import KeyframeMap
from ratslam.places.contact_alignment import RememberedContacts, placed_points
from ratslam.places.route import (
    NoWay,
    Travel,
    experiences_near,
    find_way,
    nearest_experience,
    position,
    travel_graph,
)
from ratslam.recall.whisker_likelihood import level_heights
from robot.live.goal_config import GoalConfig
from robot.live.goal_drive import DriveState, PlannedWay
from robot.live.goal_route import RECENT, ContactMap, NoContacts
from robot.world.head_trajectory import MotionConfig
from tactile.base.errors import InputError
from tactile.base.types import Observation
from tactile.features.whisker_image import ImageConfig
from tactile.whiskers.head_geometry import Head
from tactile.whiskers.planar_whiskers import image_points

if TYPE_CHECKING:
    import networkx


HEADING_RADIUS = 0.2
"""Distance that a difference in heading of 1 rad counts for in the search for the nearest experience, m."""


class GoalPlanner:
    """Ways over the experiences of a map; a `robot.live.goal_drive.Planner`.

    Args:
        experiences: graph of the map, see `KeyframeMap.graph`. motion: of the robot.

    Attributes:
        goals: experience of each goal.

    Raises:
        InputError: a goal is not on the map.
    """

    def __init__(self, experiences: networkx.DiGraph, config: GoalConfig, motion: MotionConfig) -> None:
        self._experiences, self._config = experiences, config
        self._travel = Travel(motion.speed, motion.turn_rate)
        graph = travel_graph(experiences, self._travel)
        self.goals = [
            experience_at(graph, goal, config.farthest, f"live.plan.goal.to[{k}]")
            for k, goal in enumerate(config.to)
        ]

    def plan(self, pose: np.ndarray, goal: int, obstacles: np.ndarray) -> PlannedWay:
        """See `robot.live.goal_drive.Planner`."""
        config = self._config
        graph = travel_graph(self._experiences, self._travel, obstacles, config.standoff)
        start = nearest_experience(graph, pose, config.farthest, HEADING_RADIUS)
        if start is None:
            reason = f"no experience within {config.farthest:g} m of the estimate"
            return PlannedWay(None, DriveState.LOST, reason)
        try:
            goals = experiences_near(graph, self.goals[goal], config.tolerance)
            return PlannedWay(find_way(graph, start, goals, config.mode).poses)
        except NoWay as error:
            return PlannedWay(None, DriveState.BLOCKED, str(error))


def contact_map(made: Map, image: ImageConfig, head: Head) -> ContactMap:
    """The contacts of the keyframes of a map; those of none if it has no whisker images of this head."""
    found = _keyframe_contacts(made, image, head)
    return RememberedContacts(*found, RECENT) if len(found[1]) else NoContacts()


def felt_walls(made: Map, image: ImageConfig, head: Head) -> np.ndarray:
    """[n, 2] contact points of the keyframes of a map, m; none if it has no whisker images of this head."""
    return placed_points(*_keyframe_contacts(made, image, head))


def _keyframe_contacts(made: Map, image: ImageConfig, head: Head) -> tuple[np.ndarray, list[np.ndarray]]:
    """Poses [n, 3] of the keyframes, and the contacts [m, 2] of each in base_link, m."""
    if not isinstance(made, KeyframeMap) or not isinstance(made.keyframes().appearance, WhiskerAppearance):
        return np.zeros((0, 3)), []
    poses = made.solution().fit.poses
    levels, _ = made.keyframes().appearance.stored(np.arange(len(poses)))
    if levels.shape[1] < len(head.length):
        return np.zeros((0, 3)), []
    points, there = image_points(head, level_heights(levels[:, : len(head.length)]), image.tallest)
    return poses, [seen[touched] for seen, touched in zip(points, there, strict=True)]


def felt_points(observation: Observation, image: ImageConfig, head: Head) -> np.ndarray:
    """[n, 2] contact points of a whisker image in base_link, m."""
    pixels = observation.view[..., 0].reshape(-1)
    if len(pixels) != len(head.length) or not observation.view_seen:
        return np.asarray(observation.point)[observation.contact]
    points, there = image_points(head, pixels, image.tallest)
    return points[there & observation.alive]


def experience_at(
    graph: networkx.Graph, goal: Sequence[float] | int, farthest: float, where: str = "--to"
) -> int:
    """The experience of a goal: its number, or the nearest one to x, y (m).

    Args:
        farthest: largest distance of x, y from it, m. where: of the goal, for errors.

    Raises:
        InputError: there is no such experience, none that near, or x or y is not finite.
    """
    if isinstance(goal, int):
        if goal not in graph:
            last = max(graph.nodes(), default=-1)
            raise InputError(where, f"experience {goal}", f"a number from 0 to {last}")
        return goal
    place = np.array(goal[:2], float)
    if not np.isfinite(place).all():
        raise InputError(where, f"({place[0]:g}, {place[1]:g})", "finite numbers x, y, m")
    found = nearest_experience(graph, place, farthest)
    if found is not None:
        return found
    nearest = nearest_experience(graph, place, np.inf)
    if nearest is None:
        raise InputError(where, "a map without experiences", "a map with experiences")
    x, y = position(graph, nearest)
    away = float(np.hypot(x - place[0], y - place[1]))
    text = f"({place[0]:g}, {place[1]:g}), {away:.2f} m from experience {nearest} at ({x:.2f}, {y:.2f})"
    cure = f"the nearest possible place is {x:.2f},{y:.2f}; map.png shows all, in the frame of the map"
    raise InputError(where, text, f"a point within {farthest:g} m of an experience", cure)
