"""Drives to goals: with the localiser on a small map, and the lines of planted drives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.maps.goals import GOALS, ClosedLoop, Drive, goal_figures, shortest_driven
from evaluation.papers.maps.scenarios import Recipe, open_world
from evaluation.papers.maps.stored_maps import store_map
from evaluation.papers.tables.touch_table import MAIN, touch_config
from ratslam.live.goal_drive import DriveState
from robot.world.maze import cell_centre
from tests.evaluation.papers.maps.stand_ins import cells_by_figure

SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
MAZE = 31002


def drive(state: DriveState, error: float, replans: int = 0) -> Drive:
    path = np.array([[0.09, 0.09], [0.27, 0.09]])
    return Drive(state, path[1], replans, error, 0.5, 0.01, 0.2, 0.18, 0.08, True, path)


def test_the_shortest_way_runs_along_the_lines_between_cells():
    a, b = cell_centre((0, 0)) + [0.02, 0.0], cell_centre((1, 1))
    assert shortest_driven(SQUARE, a, b)[0] == pytest.approx(0.16 + 0.18)
    assert shortest_driven(SQUARE, a, b - [0.0, 0.02])[1] == [(1, 0)]


def test_only_true_ends_count_as_reached(tmp_path: Path):
    ends = [(DriveState.REACHED, 0.01), (DriveState.REACHED, 0.2), (DriveState.LOST, 0.01)]
    walled = [
        drive(DriveState.BLOCKED, 0.3),
        drive(DriveState.REACHED, 0.01, 1),
        drive(DriveState.REACHED, 0.01),
    ]
    maze, _ = open_world(MAZE)
    found = goal_figures([drive(*end) for end in ends], walled, 120.0, np.zeros((2, 2)), 0.09, maze)
    lines = cells_by_figure(GOALS.table([found]))
    assert lines["reached (truly within 0.09 m)"][0].startswith("1 of 3")
    assert lines["reached (truly within 0.09 m)"][1].startswith("0 of 3")
    assert lines["said to be reached at a wrong place"][0].startswith("1 of 6")
    assert lines["path over the shortest driven way, all reached"][0] == "1.11"
    assert lines["wall in the way: reached by a new way, or blocked"][0].startswith("2 of 3")
    record = found.record
    counts = [record[name] for name in ("not_reached", "wrongly_reached", "in_wall", "wall_not_solved")]
    assert counts == [2, 1, 0, 1]
    assert record["path_ratio"] == pytest.approx(0.2 / 0.18)
    assert record["error"] == pytest.approx(0.105)
    assert GOALS.draw is not None
    GOALS.draw([found], tmp_path / "goals.png")
    assert (tmp_path / "goals.png").stat().st_size > 10_000


def test_the_arm_drives_to_a_goal_on_its_map(tmp_path: Path):
    settings = MAIN | {"path": {"circuits": "CCC"}}
    recipe = Recipe(touch_config(MAZE, 1, settings))
    loop = ClosedLoop(recipe, store_map(recipe, tmp_path))
    far = {place: loop.way_to(place)[0] for place in loop.experiences}
    goal = min(far, key=lambda place: abs(far[place] - 0.4))
    end = loop.drive(goal)
    assert end.reached, (end.state, end.error)
    assert end.clear
    assert end.length <= 1.15 * end.shortest + 0.09
    walls = loop.walls().walls
    assert (walls.box == loop.scene.surroundings.walls.box).all()
    assert (walls.height == loop.scene.surroundings.walls.height).all()
