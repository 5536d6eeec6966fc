"""Routes through a maze as lists of cells: circuits around a loop, free exploration, a way through all cells.

`CCCAAACACA` is the protocol of Salman & Pearson 2016: three circuits clockwise, three anticlockwise, then
four in alternating directions.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise

import numpy as np

from robot.world.maze import Cell, Maze, is_inside, is_open, neighbours, tree_maze
from tactile.base.errors import InputError


def circuit_route(loop: Sequence[Cell], word: str) -> list[Cell]:
    """Circuits around a loop, one per letter: C clockwise seen from above, A anticlockwise.

    Args:
        loop: its cells in anticlockwise order, without repeating the first.

    Raises:
        InputError: the word is empty or has another letter.
    """
    if not word or set(word.upper()) - set("CA"):
        expected = "a word of C (clockwise) and A (anticlockwise)"
        raise InputError("simulation.path.circuits", repr(word), expected)
    way = [loop[0]]
    for letter in word.upper():
        way += [*loop[1:], loop[0]] if letter == "A" else [*loop[:0:-1], loop[0]]
    return way


def exploration_route(
    maze: Maze, start: Cell, cells: int, random: np.random.Generator, within: Collection[Cell] = ()
) -> list[Cell]:
    """A random route of this many cells, which turns back only in dead ends.

    Args:
        within: the cells that it may enter; empty: all.

    Raises:
        InputError: the start is outside the maze or walled in.
    """
    way = [start]
    before: Cell | None = None
    while len(way) < cells:
        options = [cell for cell in neighbours(maze, way[-1]) if not within or cell in within]
        if not options:
            raise InputError("simulation.maze", f"cell {start} is walled in", "a way out of it")
        onward = [cell for cell in options if cell != before] or options
        before = way[-1]
        way.append(onward[int(random.integers(len(onward)))])
    return way


def winding_loop(columns: int, rows: int, random: np.random.Generator) -> list[Cell]:
    """A random loop through each cell of a rectangle once: the way around a random tree of 2 x 2 blocks.

    Args:
        columns, rows: even.
    """
    tree = tree_maze(columns // 2, rows // 2, random)
    way: list[Cell] = [(0, 0)]
    while len(way) < columns * rows:
        x, y = way[-1]
        right, up = 2 * (x % 2) - 1, 2 * (y % 2) - 1  # the side of its block on which the cell lies
        block = x // 2, y // 2
        joined = neighbours(tree, block)
        beside = (x + right, y) if (block[0] + right, block[1]) in joined else (x, y - up)
        above = (x, y + up) if (block[0], block[1] + up) in joined else (x - right, y)
        way.append(above if way[-2:-1] == [beside] else beside)
    return way


def make_anticlockwise(loop: Sequence[Cell]) -> list[Cell]:
    """The loop in anticlockwise order from the same cell.

    Raises:
        InputError: the loop has a cell twice, or fewer than four cells.
    """
    if len(loop) < 4 or len(set(loop)) < len(loop):
        twice = next((cell for k, cell in enumerate(loop) if cell in loop[:k]), None)
        found = f"{len(loop)} cells" if twice is None else f"cell {twice} twice"
        raise InputError("simulation.path.loop", found, "at least four different cells")
    x, y = np.array(loop).T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    return list(loop) if area > 0 else [loop[0], *loop[:0:-1]]


def check_route(maze: Maze, way: Sequence[Cell], where: str = "simulation.path.cells") -> None:
    """Check that a route stays in the maze and passes no wall.

    Args:
        where: name of the route in errors.

    Raises:
        InputError: the route is not possible; the error gives the step and the wall.
    """
    for number, cell in enumerate(way):
        if not is_inside(maze, cell):
            expected = f"columns 0 to {maze.columns - 1} and rows 0 to {maze.rows - 1}"
            raise InputError(f"{where}[{number}]", f"cell {tuple(cell)}", expected)
    for number, (a, b) in enumerate(pairwise(way)):
        leg = f"{where}[{number}] to [{number + 1}]"
        if abs(a[0] - b[0]) + abs(a[1] - b[1]) != 1:
            raise InputError(leg, f"from cell {tuple(a)} to {tuple(b)}", "a step to a neighbouring cell")
        if not is_open(maze, a, b):
            found = f"a step through the wall between cells {tuple(a)} and {tuple(b)}"
            cure = "take the wall out of the maze or lead the path around it"
            raise InputError(leg, found, "a way around the walls", cure)
