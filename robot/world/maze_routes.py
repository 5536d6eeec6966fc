"""Ways through a maze: circuits spelled as a word, free exploration, given cells; each a list of cells.

`CCCAAACACA` is seed 2's protocol: three circuits one way, three the other, two of each in turn. The head
looks where it goes, and turns on the spot.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from robot.world.maze import Cell, Maze, is_open, neighbours
from tactile.base.errors import InputError


def circuit_route(loop: Sequence[Cell], word: str) -> list[Cell]:
    """A loop travelled once for each letter: C as clockwise seen from above, A anticlockwise.

    Args:
        loop: its cells, anticlockwise, not repeating the first.

    Raises:
        InputError: another letter, or none.
    """
    if not word or set(word.upper()) - set("CA"):
        raise InputError(
            "simulation.path.circuits", repr(word), "a word of C (clockwise) and A (anticlockwise)"
        )
    way = [loop[0]]
    for letter in word.upper():
        way += [*loop[1:], loop[0]] if letter == "A" else [*loop[:0:-1], loop[0]]
    return way


def exploration_route(maze: Maze, start: Cell, cells: int, random: np.random.Generator) -> list[Cell]:
    """So many cells of a way that chooses at random where it can, and turns back only in dead ends.

    Raises:
        InputError: the start lies outside, or there is no way out of it.
    """
    way = [start]
    before: Cell | None = None
    while len(way) < cells:
        options = neighbours(maze, way[-1])
        if not options:
            raise InputError("simulation.maze", f"cell {start} is walled in", "a way out of it")
        onward = [cell for cell in options if cell != before] or options
        before = way[-1]
        way.append(onward[int(random.integers(len(onward)))])
    return way


def make_anticlockwise(loop: Sequence[Cell]) -> list[Cell]:
    """The loop that way round, from the same cell.

    Raises:
        InputError: it passes a cell twice, or holds fewer than four.
    """
    if len(loop) < 4 or len(set(loop)) < len(loop):
        twice = next((cell for k, cell in enumerate(loop) if cell in loop[:k]), None)
        found = f"{len(loop)} cells" if twice is None else f"cell {twice} twice"
        raise InputError("simulation.path.loop", found, "at least four different cells")
    x, y = np.array(loop).T
    area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    return list(loop) if area > 0 else [loop[0], *loop[:0:-1]]


def check_route(maze: Maze, way: Sequence[Cell], where: str = "simulation.path.cells") -> None:
    """Refuses a way that leaves the maze or goes through a wall.

    Args:
        where: what messages call the way.

    Raises:
        InputError: naming the leg and the wall.
    """
    for number, cell in enumerate(way):
        if not (0 <= cell[0] < maze.columns and 0 <= cell[1] < maze.rows):
            raise InputError(
                f"{where}[{number}]",
                f"cell {tuple(cell)}",
                f"columns 0 to {maze.columns - 1} and rows 0 to {maze.rows - 1}",
            )
    for number, (a, b) in enumerate(pairwise(way)):
        leg = f"{where}[{number}] to [{number + 1}]"
        if abs(a[0] - b[0]) + abs(a[1] - b[1]) != 1:
            raise InputError(leg, f"from cell {tuple(a)} to {tuple(b)}", "a step to a neighbouring cell")
        if not is_open(maze, a, b):
            raise InputError(
                leg,
                f"a way through the wall between cells {tuple(a)} and {tuple(b)}",
                "a way around the walls",
                "take the wall out of the maze or lead the path around it",
            )
