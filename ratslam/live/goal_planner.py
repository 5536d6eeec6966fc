"""Ways on a saved map: to the goals of a drive (`ratslam.live.goal_drive`), and between two places, drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evaluation.plots.map_plot import draw_way
from ratslam.core.backend import Map
from ratslam.mapping.appearance import WhiskerAppearance
from ratslam.mapping.map import KeyframeMap
from ratslam.places import route
from ratslam.places.contact_alignment import RememberedContacts, placed_points
from ratslam.recall.whisker_likelihood import level_heights
from ratslam.runs.saved_map import SavedMap
from robot.live.live_config import GoalConfig
from robot.world.scene import MotionConfig
from tactile.base.errors import InputError
from tactile.base.files import make_new_file
from tactile.base.types import Observation
from tactile.frontend import TouchConfig, has_points, touched_points

if TYPE_CHECKING:
    import networkx

RECENT = 8
"""Whisks whose contacts are aligned with those of the map."""
HEADING_RADIUS = 0.2
"""Distance that a difference in heading of 1 rad counts for in the search for the nearest experience, m."""


class GoalPlanner:
    """Ways over the experiences of a map, which were driven.

    Args:
        experiences: graph of the map, see `KeyframeMap.graph`. motion: of the robot.

    Attributes:
        goals: experience of each goal.

    Raises:
        InputError: a goal is not on the map.
    """

    def __init__(self, experiences: networkx.DiGraph, config: GoalConfig, motion: MotionConfig) -> None:
        self._experiences, self._config = experiences, config
        self._travel = route.Travel(motion.speed, motion.turn_rate)
        graph = route.travel_graph(experiences, self._travel)
        self.goals = [
            experience_at(graph, goal, config.farthest, f"live.plan.goal.to[{k}]")
            for k, goal in enumerate(config.to)
        ]

    def plan(self, pose: np.ndarray, goal: int, obstacles: np.ndarray) -> np.ndarray | None:
        """Poses [K, 3] of the way from a pose [3] to a goal (its number in the list), clear of obstacles
        [n, 2] m; None: the pose is away from driven ground.

        Raises:
            NoWay: there is none.
        """
        config = self._config
        graph = route.travel_graph(self._experiences, self._travel, obstacles, config.standoff)
        start = route.nearest_experience(graph, pose, config.farthest, HEADING_RADIUS)
        if start is None:
            return None
        goals = route.experiences_near(graph, self.goals[goal], config.tolerance)
        return route.find_way(graph, start, goals, config.mode).poses


def contact_map(made: Map, touch: TouchConfig) -> RememberedContacts:
    """The contacts of the keyframes of a map; those of none if it has no touch images of this kind."""
    return RememberedContacts(*_keyframe_contacts(made, touch), RECENT)


def _keyframe_contacts(made: Map, touch: TouchConfig) -> tuple[np.ndarray, list[np.ndarray]]:
    """Poses [n, 3] of the keyframes, and the contacts [m, 2] of each in base_link, m."""
    if not isinstance(made, KeyframeMap) or not isinstance(made.appearance, WhiskerAppearance):
        return np.zeros((0, 3)), []
    poses = made.solution().pose.rows
    levels, _ = made.appearance.stored(np.arange(len(poses)))
    count = levels.shape[1] // (1 + touch.image.radial)
    if not has_points(touch, count):
        return np.zeros((0, 3)), []
    points, there = touched_points(touch, level_heights(levels[:, :count]))
    return poses, [seen[touched] for seen, touched in zip(points, there, strict=True)]


def felt_points(observation: Observation, touch: TouchConfig) -> np.ndarray:
    """[n, 2] contact points of a touch image in base_link, m."""
    pixels = observation.view[..., 0].reshape(-1)
    known = has_points(touch, len(pixels)) and len(pixels) == len(observation.alive)
    if not known or not observation.view_seen:
        return np.asarray(observation.point)[observation.contact]
    points, there = touched_points(touch, pixels)
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
    found = route.nearest_experience(graph, place, farthest)
    if found is not None:
        return found
    nearest = route.nearest_experience(graph, place, np.inf)
    if nearest is None:
        raise InputError(where, "a map without experiences", "a map with experiences")
    x, y = route.position(graph, nearest)
    away = float(np.hypot(x - place[0], y - place[1]))
    text = f"({place[0]:g}, {place[1]:g}), {away:.2f} m from experience {nearest} at ({x:.2f}, {y:.2f})"
    cure = f"the nearest possible place is {x:.2f},{y:.2f}; map.png shows all, in the frame of the map"
    raise InputError(where, text, f"a point within {farthest:g} m of an experience", cure)


FARTHEST, TOLERANCE = (GoalConfig.model_fields[name].default for name in ("farthest", "tolerance"))


def find_map_way(
    made: Map,
    saved: SavedMap,
    start: tuple[float, float] | int | None,
    goal: tuple[float, float] | int,
    mode: route.Mode = "time",
) -> route.Way:
    """The way from a place to another at the speed of a session's default motion.

    Args:
        made: the map in `saved`. start, goal: x, y (m) within `FARTHEST` of an experience, or its number;
            None: the map's last pose.

    Raises:
        InputError: a place is not on the map. NoWay: nothing joins the two.
    """
    motion = MotionConfig()
    graph = route.travel_graph(made.graph(), route.Travel(motion.speed, motion.turn_rate))
    if not len(graph):
        found = f"a map of `backend: {saved.config.backend}` without experiences, which a way leads along"
        raise InputError(str(saved.path), found, "a map of `backend: recall` or `backend: classic`")
    last = experience_at(graph, goal, FARTHEST, "--to")
    if start is None:
        first = route.nearest_experience(graph, made.trajectory()[-1], FARTHEST, HEADING_RADIUS)
        if first is None:
            found = f"the map's last pose has no experience within {FARTHEST:g} m"
            raise InputError("--from", found, "a robot on driven ground", "give X,Y or an experience")
    else:
        first = experience_at(graph, start, FARTHEST, "--from")
    return route.find_way(graph, first, route.experiences_near(graph, last, TOLERANCE), mode)


def draw_map_way(path: Path, made: Map, saved: SavedMap, way: route.Way) -> None:
    """Writes a picture of a way on its map."""
    graph, config = made.graph(), saved.config
    row = {place: k for k, place in enumerate(graph)}
    nodes = np.array([[data["x"], data["y"]] for _, data in graph.nodes(data=True)])
    links = np.array([[row[a], row[b]] for a, b in graph.edges()]).reshape(-1, 2)
    felt = placed_points(*_keyframe_contacts(made, config.touch))
    title = f"From experience {way.experiences[0]} to {way.experiences[-1]}"
    line = f"{way.length:.2f} m, {way.seconds:.0f} s over {len(way.experiences)} of {len(nodes)} experiences"
    figure = draw_way(title, line, nodes, links, way.poses, felt)
    make_new_file(path, lambda temporary: figure.savefig(temporary, metadata={"Software": None}))
