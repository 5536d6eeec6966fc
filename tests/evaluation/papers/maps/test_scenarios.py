"""The laws of the scenarios: what differs between two sessions of a maze, and what does not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from evaluation.papers.maps.scenarios import (
    FOREIGN,
    LOCALISED,
    REENTERED,
    Recipe,
    carried_sessions,
    closed_door,
    moved_wall,
    open_world,
    overlapping_sessions,
    record,
    same_maze,
    ten_circuits,
    unknown_start,
)
from ratslam.runs.settings.run_config import RunConfig
from robot.world.maze import CELL_SIDE, Cell, Maze, cell_centre
from robot.world.scene import make_maze

MAZES = (31003, 31015)


def cells_of(poses: np.ndarray) -> list[Cell]:
    return [(int(x), int(y)) for x, y in np.floor(poses[:, :2] / CELL_SIDE)]


def maze_of(config: RunConfig) -> Maze:
    simulation = config.simulation
    assert simulation is not None
    return make_maze(simulation.maze, simulation.path, simulation.seed)[0]


def changed_walls(one: Maze, other: Maze) -> int:
    return int((one.across != other.across).sum() + (one.along != other.along).sum())


@pytest.mark.parametrize(
    "recipe",
    [
        unknown_start,
        lambda maze: overlapping_sessions(maze)[0],
        lambda maze: moved_wall(maze)[0],
    ],
)
def test_the_same_seed_gives_the_same_bits(recipe: Callable[[int], Recipe]) -> None:
    one, other = recipe(31001), recipe(31001)
    assert one.digest == other.digest
    first, second = record(one), record(other)
    for name in ("time", "motion", "views", "truth", "alive"):
        assert np.array_equal(getattr(first.log, name), getattr(second.log, name))
    assert first.log.digest == second.log.digest
    assert recipe(31002).digest != one.digest


def test_starts_differ_in_cell_and_direction_but_not_in_the_maze() -> None:
    poses = []
    for maze in range(31000, 31006):
        found = record(unknown_start(maze))
        assert found.log.length == LOCALISED
        assert not found.log.motion[0].any()
        assert changed_walls(maze_of(found.config), maze_of(ten_circuits(maze).config)) == 0
        loop = open_world(maze)[1]
        cells = cells_of(found.truth)
        assert cells[0] != loop[0] or cells[8] != loop[0]
        assert set(cells) <= set(loop)
        ahead = (loop.index(cells[20]) - loop.index(cells[0])) % len(loop)
        poses.append((loop.index(cells[0]), ahead < len(loop) // 2))
    assert {direction for _, direction in poses} == {True, False}
    assert len({number for number, _ in poses}) >= 4


def test_a_later_session_has_odometry_of_its_own() -> None:
    first, later = record(ten_circuits(31000)), record(same_maze(31000, 1))
    assert changed_walls(maze_of(first.config), maze_of(later.config)) == 0
    assert same_maze(31000, 0).digest == ten_circuits(31000).digest
    scale = [
        np.hypot(*s.log.motion[:, :2].T).sum() / np.hypot(*np.diff(s.truth[:, :2], axis=0).T).sum()
        for s in (first, later)
    ]
    assert abs(scale[0] - scale[1]) > 1e-3


def test_another_maze_has_other_walls() -> None:
    foreign = record(unknown_start(31001, FOREIGN, "foreign"))
    assert foreign.log.length == FOREIGN
    assert changed_walls(maze_of(foreign.config), open_world(31000)[0]) > 10


@pytest.mark.parametrize("maze", MAZES)
def test_overlapping_sessions_share_half_their_cells(maze: int) -> None:
    one, other, both = (set(cells_of(record(r).truth)) for r in overlapping_sessions(maze))
    assert len(one) == len(other) == 2 * len(one & other) >= 8
    assert both == one | other


@pytest.mark.parametrize("maze", MAZES)
def test_a_carried_robot_is_in_the_known_part_for_sixty_whisks_or_never(maze: int) -> None:
    *recipes, entry = carried_sessions(maze)
    first, back, away = (cells_of(record(recipe).truth) for recipe in recipes)
    known = set(first)
    assert not set(back[:entry]) & known
    assert set(back[entry:]) <= known
    assert len(back) == entry + REENTERED
    assert not set(away) & known
    assert len(away) == LOCALISED


@pytest.mark.parametrize("maze", MAZES)
@pytest.mark.parametrize(("change", "walls"), [(moved_wall, 2), (closed_door, 1)])
def test_a_change_is_beside_the_driven_way_and_leaves_it_clear(
    maze: int, change: Callable[[int], tuple[Recipe, np.ndarray]], walls: int
) -> None:
    after, places = change(maze)
    loop = open_world(maze)[1]
    assert changed_walls(maze_of(after.config), open_world(maze)[0]) == len(places) == walls
    truth = record(after).truth  # simulating it checks that the path passes no wall
    for place in places:
        assert np.hypot(*(truth[:, :2] - place).T).min() < 0.6 * CELL_SIDE
    assert set(loop) <= set(cells_of(truth))


def test_a_closed_door_is_driven_up_to_from_both_sides() -> None:
    after, places = closed_door(31000)
    loop = open_world(31000)[1]
    sides = [
        pair
        for pair in zip(loop, loop[1:] + loop[:1], strict=True)
        if np.allclose((cell_centre(pair[0]) + cell_centre(pair[1])) / 2, places[0])
    ]
    assert len(sides) == 1
    assert set(sides[0]) <= set(cells_of(record(after).truth))
