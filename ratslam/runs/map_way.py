"""The way between two places of a saved map, and its picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaluation.plots.way_plot import draw_way
from ratslam.core.backend import Map
from ratslam.places.route import (
    Mode,
    Travel,
    Way,
    experiences_near,
    find_way,
    nearest_experience,
    travel_graph,
)
from ratslam.runs.goal_planner import HEADING_RADIUS, experience_at, felt_walls
from ratslam.runs.saved_map import SavedMap
from robot.live.goal_config import GoalConfig
from robot.world.head_trajectory import MotionConfig
from tactile.base.errors import InputError
from tactile.base.new_file import make_new_file
from tactile.whiskers.head_geometry import ur10_head

FARTHEST, TOLERANCE = (GoalConfig.model_fields[name].default for name in ("farthest", "tolerance"))


def find_map_way(
    made: Map,
    saved: SavedMap,
    start: tuple[float, float] | int | None,
    goal: tuple[float, float] | int,
    mode: Mode = "time",
) -> Way:
    """The way from a place to another at the speed of a session's default motion.

    Args:
        made: the map in `saved`. start, goal: x, y (m) within `FARTHEST` of an experience, or its number;
            None: the map's last pose.

    Raises:
        InputError: a place is not on the map. NoWay: nothing joins the two.
    """
    motion = MotionConfig()
    graph = travel_graph(made.graph(), Travel(motion.speed, motion.turn_rate))
    if not len(graph):
        found = f"a map of `backend: {saved.config.backend}` without experiences, which a way leads along"
        raise InputError(str(saved.path), found, "a map of `backend: recall` or `backend: classic`")
    last = experience_at(graph, goal, FARTHEST, "--to")
    if start is None:
        first = (
            nearest_experience(graph, made.trajectory()[-1], FARTHEST, HEADING_RADIUS)
            if saved.steps
            else None
        )
        if first is None:
            found = f"the map's last pose has no experience within {FARTHEST:g} m"
            raise InputError("--from", found, "a robot on driven ground", "give X,Y or an experience")
    else:
        first = experience_at(graph, start, FARTHEST, "--from")
    return find_way(graph, first, experiences_near(graph, last, TOLERANCE), mode)


def draw_map_way(path: Path, made: Map, saved: SavedMap, way: Way) -> None:
    """Writes a picture of a way on its map."""
    graph, config = made.graph(), saved.config
    row = {place: k for k, place in enumerate(graph)}
    nodes = np.array([[data["x"], data["y"]] for _, data in graph.nodes(data=True)])
    links = np.array([[row[a], row[b]] for a, b in graph.edges()]).reshape(-1, 2)
    felt = felt_walls(made, config.touch.image, ur10_head(config.touch.head))
    title = f"From experience {way.experiences[0]} to {way.experiences[-1]}"
    line = f"{way.length:.2f} m, {way.seconds:.0f} s over {len(way.experiences)} of {len(nodes)} experiences"
    figure = draw_way(title, line, nodes, links, way.poses, felt)
    make_new_file(path, lambda temporary: figure.savefig(temporary, metadata={"Software": None}))
