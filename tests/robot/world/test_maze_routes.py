"""Routes: circuits follow their letters, and no route passes a wall."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.world.maze import (
    Maze,
    check_route,
    circuit_route,
    closed_maze,
    exploration_route,
    make_anticlockwise,
    random_loop,
    random_maze,
    winding_loop,
)
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]


def world(seed: int) -> tuple[Maze, list[tuple[int, int]]]:
    loop = random_loop(7, 5, 20, stream(seed, "maze.loop"))
    return random_maze(7, 5, loop, 0.6, stream(seed, "maze.walls")), loop


@given(st.text("CAca", min_size=1, max_size=12), st.integers(0, 1000))
def test_each_letter_is_one_circuit(word: str, seed: int) -> None:
    _, loop = world(seed)
    way = circuit_route(loop, word)
    assert len(way) == len(word) * len(loop) + 1
    for k, letter in enumerate(word.upper()):
        lap = way[k * len(loop) : (k + 1) * len(loop) + 1]
        assert lap[0] == lap[-1] == loop[0]
        assert lap[:-1] == (loop if letter == "A" else [loop[0], *loop[:0:-1]])


@given(st.integers(0, 1000))
def test_routes_pass_no_wall(seed: int) -> None:
    maze, loop = world(seed)
    check_route(maze, circuit_route(loop, "CA"))
    way = exploration_route(maze, loop[0], 300, stream(seed, "path"))
    assert len(way) == 300
    check_route(maze, way)
    for before, here, after in zip(way, way[1:], way[2:], strict=False):
        assert after != before or maze.neighbours(here) == [before]


def test_exploration_visits_all_reachable_cells() -> None:
    maze, loop = world(1)
    there, edge = {loop[0]}, [loop[0]]
    while edge:
        edge = [cell for here in edge for cell in maze.neighbours(here) if cell not in there]
        there.update(edge)
    assert set(exploration_route(maze, loop[0], 20_000, stream(1, "path"))) == there


@given(st.integers(1, 8), st.integers(1, 8), st.integers(0, 1000))
def test_a_winding_loop_visits_every_cell_once(columns: int, rows: int, seed: int) -> None:
    columns, rows = 2 * columns, 2 * rows
    loop = winding_loop(columns, rows, stream(seed, "loop"))
    assert sorted(loop) == [(x, y) for x in range(columns) for y in range(rows)]
    for (x, y), (next_x, next_y) in pairwise([*loop, loop[0]]):
        assert abs(next_x - x) + abs(next_y - y) == 1


def test_winding_loops_differ_by_their_random_numbers() -> None:
    assert winding_loop(8, 8, stream(0, "loop")) != winding_loop(8, 8, stream(1, "loop"))


@pytest.mark.parametrize("word", ["", "CAB", "C A"])
def test_invalid_words_are_refused(word: str, refused: Callable[..., InputError]) -> None:
    refused(lambda: circuit_route(SQUARE, word), "simulation.path.circuits", repr(word))


def test_a_route_through_a_wall_is_refused_with_its_step(refused: Callable[..., InputError]) -> None:
    maze, loop = world(0)
    rows = [[(x, y) for x in range(7)] for y in range(5)]
    blocked = next([a, b] for row in rows for a, b in pairwise(row) if not maze.is_open(a, b))
    wall = f"the wall between cells {blocked[0]} and {blocked[1]}"
    refused(lambda: check_route(maze, blocked), "simulation.path.cells[0] to [1]", wall)
    refused(lambda: check_route(maze, [(0, 0), (7, 0)]), "cells[1]", "cell (7, 0)", "columns 0 to 6")
    refused(lambda: check_route(maze, [(0, -1), (0, 0)]), "cells[0]", "cell (0, -1)", "rows 0 to 4")
    refused(lambda: check_route(maze, [(0, 0), (0, 0)]), "cells[0] to [1]", "neighbouring")
    refused(lambda: check_route(maze, [*loop[:2], loop[5]], "here"), "here[1] to [2]", "neighbouring")


def test_a_walled_in_start_is_refused(refused: Callable[..., InputError]) -> None:
    refused(
        lambda: exploration_route(closed_maze(3, 3), (1, 1), 5, stream(0, "path")), "cell (1, 1) is walled in"
    )


@given(st.integers(0, 1000))
def test_a_loop_is_made_anticlockwise(seed: int) -> None:
    _, loop = world(seed)
    assert make_anticlockwise(loop) == loop
    assert make_anticlockwise([loop[0], *loop[:0:-1]]) == loop


def test_a_loop_has_at_least_four_different_cells(refused: Callable[..., InputError]) -> None:
    refused(lambda: make_anticlockwise([*SQUARE, *SQUARE]), "simulation.path.loop", "cell (0, 0) twice")
    refused(lambda: make_anticlockwise([]), "0 cells")


def test_an_exploration_stays_within_its_cells() -> None:
    maze, loop = world(1)
    way = exploration_route(maze, loop[2], 200, stream(1, "path"), loop[2:8])
    assert set(way) == set(loop[2:8])
