"""An emulated arm drives to goals in virtual time, with a wall in the way and without."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import networkx
import numpy as np
import pytest

from evaluation.papers.maps.goals import VirtualArm
from ratslam.live.goal_drive import DriveState, GoalDrive, GoalRoute
from ratslam.live.goal_planner import RECENT, GoalPlanner, felt_points
from ratslam.places.contact_alignment import RememberedContacts
from robot.live.live_config import GoalConfig, LiveConfig
from robot.world.maze import Maze, cell_centre, random_maze, wall_boxes
from robot.world.scene import MotionConfig
from robot.world.walls import Surroundings
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose
from tactile.frontend import Frontend, TouchConfig
from tactile.whisker_geometry import ur10_head

LOOP = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1)]
MAP_POSE = np.array([0.3, -0.2, 0.7])
"""Pose of the map's frame in the maze: drives must not depend on it."""
TOUCH = TouchConfig()
HEAD = ur10_head(TOUCH.head)


def maze(loop_open: bool = True) -> Maze:
    made = random_maze(3, 2, LOOP, 1.0, stream(5, "maze"))
    if not loop_open:
        close(made, (0, 0), (0, 1))
    return made


def close(made: Maze, a, b) -> None:
    wall, place = made.between_cells(a, b)
    wall[place] = True


def surroundings(made: Maze) -> Surroundings:
    return Surroundings(wall_boxes(made, stream(5, "heights")), HEAD)


def driven(loop_open: bool = True) -> networkx.DiGraph:
    """Experiences every 6 cm along the loop, with the heading of the motion, in the map's frame."""
    places = [cell_centre(cell) for cell in LOOP + LOOP[:1] * loop_open]
    poses = []
    for a, b in pairwise(places):
        heading = np.arctan2(*(b - a)[::-1])
        poses += [[*(a + share * (b - a)), heading] for share in (0.0, 1 / 3, 2 / 3)]
    if not loop_open:
        poses.append([*places[-1], poses[-1][2]])
    graph = networkx.DiGraph()
    for k, (x, y, heading) in enumerate(between(MAP_POSE, np.array(poses)).tolist()):
        graph.add_node(k, x=x, y=y, heading=heading)
    graph.add_edges_from(pairwise(range(len(poses))), traversals=1)
    if loop_open:
        graph.add_edge(len(poses) - 1, 0, traversals=1)
    return graph


def drive(graph: networkx.DiGraph, made: Maze, goal: int, most: int = 150) -> tuple[GoalDrive, VirtualArm]:
    """Drives from the first cell; the estimate is the truth with an error."""
    config = GoalConfig(map=Path("map.npz"), to=(goal,))
    live = LiveConfig.model_validate({"plan": {"motion": {"speed": 0.045}}})
    steered = GoalDrive(config, GoalPlanner(graph, config, live.plan.motion), 0.05)
    route = GoalRoute(steered, live, RememberedContacts(np.zeros((0, 3)), [], RECENT))
    arm = VirtualArm(live, surroundings(made), np.array([*cell_centre(LOOP[0]), 0.0]))
    frontend, random = Frontend(TOUCH), stream(5, "estimates")
    for _ in range(most):
        if route.advance(arm):
            break
        sample = arm.whisk()
        seen = frontend.observe(sample.reading)
        error = random.normal(0, [0.005, 0.005, 0.03])
        estimate = between(MAP_POSE, compose(sample.truth, error))
        route.see(estimate, felt_points(seen, TOUCH.image, HEAD), sample.truth, arm.poses[-1])
    return steered, arm


def place(graph: networkx.DiGraph, number: int) -> np.ndarray:
    node = graph.nodes[number]
    return compose(MAP_POSE, np.array([node["x"], node["y"], 0.0]))[:2]


def test_the_goal_is_reached_along_the_way():
    graph = driven()
    steered, arm = drive(graph, maze(), 6)
    assert steered.state is DriveState.REACHED
    assert steered.replans == 0
    path = np.array(arm.poses)[:, :2]
    assert np.hypot(*(path[-1] - place(graph, 6))) < 0.03
    assert np.hypot(*np.diff(path, axis=0).T).sum() < 1.15 * 0.36


def test_a_wall_on_the_way_is_driven_around():
    graph, made = driven(), maze()
    close(made, (1, 0), (2, 0))
    steered, arm = drive(graph, made, 6)
    assert steered.state is DriveState.REACHED
    assert steered.replans >= 1
    path = np.array(arm.poses)[:, :2]
    assert np.hypot(*(path[-1] - place(graph, 6))) < 0.03
    assert np.hypot(*np.diff(path, axis=0).T).sum() > 0.5, "the long way"


def test_a_wall_on_the_only_way_ends_the_drive_before_it():
    made = maze(loop_open=False)
    close(made, (1, 0), (2, 0))
    steered, arm = drive(driven(loop_open=False), made, 6)
    assert steered.state is DriveState.BLOCKED
    assert "blocked" in steered.reason
    assert np.array(arm.poses)[:, 0].max() < 0.36 - 0.05, "the wall is at 0.36 m"


@pytest.mark.parametrize(("goal", "found"), [(99, "experience 99"), ((5.0, 5.0), "m from experience")])
def test_goals_off_the_map_are_refused(goal, found):
    config = GoalConfig(map=Path("map.npz"), to=(goal,))
    with pytest.raises(InputError, match=r"live\.plan\.goal\.to\[0\]") as error:
        GoalPlanner(driven(), config, MotionConfig())
    assert found in str(error.value)
