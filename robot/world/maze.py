"""Micromouse mazes with cells of 18 cm, random or from a text file.

A cell is (column, row), counted from the south-west. A maze stores the walls between its cells; `wall_boxes`
converts them to boxes. Text files have posts `o` or `+`, walls `---` and `|`.

A route is a list of cells: circuits around a loop, free exploration, a way through all cells. `CCCAAACACA` is
the protocol of Salman & Pearson 2016: three circuits clockwise, three anticlockwise, then four in alternating
directions.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from robot.world.walls import Walls, polygon_area
from tactile.base.bounded import read_text
from tactile.base.errors import InputError

CELL_SIDE = 0.18
"""Side length of a cell, m (IEEE micromouse rules)."""
WALL_THICKNESS = 0.012
"""Thickness of walls and posts, m (as above)."""
WALL_HEIGHT = 0.05
"""Height of walls and posts, m (as above)."""
POSE_CELL_SIZE = 0.05
"""Side length of a pose cell that suits these mazes, m."""

Cell = tuple[int, int]


class Maze(NamedTuple):
    """Attributes:
    across: [rows + 1, columns] bool, walls south of each cell, and north of the last row.
    along: [rows, columns + 1] bool, walls west of each cell, and east of the last column.
    """

    across: np.ndarray
    along: np.ndarray

    @property
    def columns(self) -> int:
        return self.across.shape[1]

    @property
    def rows(self) -> int:
        return self.along.shape[0]

    def between_cells(self, a: Cell, b: Cell) -> tuple[np.ndarray, tuple[int, int]]:
        """The array and index of the wall between two neighbouring cells.

        Raises:
            ValueError: the cells are not neighbours.
        """
        (x, y), (u, v) = a, b
        if abs(x - u) + abs(y - v) != 1:
            raise ValueError(f"cells {a} and {b} are not neighbours")
        return (self.along, (y, max(x, u))) if y == v else (self.across, (max(y, v), x))

    def is_open(self, a: Cell, b: Cell) -> bool:
        """Whether no wall separates two neighbouring cells."""
        wall, place = self.between_cells(a, b)
        return not wall[place]

    def neighbours(self, cell: Cell) -> list[Cell]:
        """Reachable neighbours of a cell, in the order east, north, west, south."""
        return [other for other in self.around(cell) if self.is_open(cell, other)]

    def around(self, cell: Cell) -> list[Cell]:
        """Cells beside a cell, in the same order, with or without a wall in between."""
        x, y = cell
        return [b for b in ((x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)) if self.is_inside(b)]

    def is_inside(self, cell: Cell) -> bool:
        """Whether the maze has a cell."""
        return 0 <= cell[0] < self.columns and 0 <= cell[1] < self.rows


def closed_maze(columns: int, rows: int) -> Maze:
    """A maze with all walls."""
    return Maze(np.ones((rows + 1, columns), bool), np.ones((rows, columns + 1), bool))


def random_maze(columns: int, rows: int, loop: list[Cell], share: float, random: np.random.Generator) -> Maze:
    """A maze with all outer walls, an open loop, and each other wall with this probability."""
    maze = Maze(random.random((rows + 1, columns)) < share, random.random((rows, columns + 1)) < share)
    maze.across[[0, -1]] = True
    maze.along[:, [0, -1]] = True
    for a, b in zip(loop, loop[1:] + loop[:1], strict=True):
        wall, place = maze.between_cells(a, b)
        wall[place] = False
    return maze


def tree_maze(columns: int, rows: int, random: np.random.Generator) -> Maze:
    """A maze in which exactly one way joins each two cells, by depth-first search in random order."""
    maze = closed_maze(columns, rows)
    way: list[Cell] = [(0, 0)]
    seen = {way[0]}
    while way:
        onward = [cell for cell in maze.around(way[-1]) if cell not in seen]
        if not onward:
            way.pop()
            continue
        way.append(onward[int(random.integers(len(onward)))])
        seen.add(way[-1])
        wall, place = maze.between_cells(*way[-2:])
        wall[place] = False
    return maze


def table_maze(columns: int, rows: int, share: float, random: np.random.Generator) -> Maze:
    """A table with a rim: about this share of the cells, but not the first, are objects, closed on all sides;
    the others are open, and every one of them can be reached."""
    maze = random_maze(columns, rows, [], 0.0, random)
    cells = [(x, y) for y in range(rows) for x in range(columns)]
    free = set(cells)
    for number in random.permutation(len(cells) - 1) + 1:
        if len(cells) - len(free) >= share * len(cells):
            break
        rest, reached = free - {cells[number]}, [(0, 0)]
        for cell in reached:
            reached += [b for b in maze.around(cell) if b in rest and b not in reached]
        if len(reached) == len(rest):
            free = rest
            x, y = cells[number]
            maze.across[y : y + 2, x] = maze.along[y, x : x + 2] = True
    return maze


def random_loop(columns: int, rows: int, length: int, random: np.random.Generator) -> list[Cell]:
    """A closed counter-clockwise path of this many different cells.

    It is the outline of a region on the lattice of the cell centres, which grows square by square, with a
    single outline, until the outline has this length.

    Raises:
        InputError: no such loop was found.
    """
    most = columns * rows - (columns * rows) % 2
    if length % 2 or not 4 <= length <= most or min(columns, rows) < 2:
        expected = f"an even number from 4 to {most} in {columns} x {rows}"
        raise InputError("simulation.maze.loop", f"{length} cells", expected)
    for _ in range(1000):
        blob = np.zeros((columns + 1, rows + 1), bool)  # squares between cell centres, with a margin
        blob[1 + int(random.integers(columns - 1)), 1 + int(random.integers(rows - 1))] = True
        for _ in range(8 * columns * rows):
            if _outline_length(blob) == length:
                return _trace_outline(blob, random)
            i, j = 1 + int(random.integers(columns - 1)), 1 + int(random.integers(rows - 1))
            if not blob[i, j] and _keeps_one_outline(blob, i, j):
                blob[i, j] = True
                if _outline_length(blob) > length:
                    blob[i, j] = False
    raise InputError("simulation.maze.loop", f"no loop of {length} cells found in {columns} x {rows}")


def _outline_length(blob: np.ndarray) -> int:
    return sum(int(np.diff(np.pad(blob, 1), axis=axis).sum()) for axis in (0, 1))


def _keeps_one_outline(blob: np.ndarray, i: int, j: int) -> bool:
    """Whether adding a square keeps a single outline: its neighbours in the region are connected."""
    padded = np.pad(blob, 1)
    ring = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]
    around = [bool(padded[i + 1 + di, j + 1 + dj]) for di, dj in ring]
    changes = sum(a != b for a, b in zip(around, around[1:] + around[:1], strict=True))
    alone = any(around[k] and not (around[k - 1] or around[(k + 1) % 8]) for k in (1, 3, 5, 7))
    return any(around[::2]) and changes == 2 and not alone


def _trace_outline(blob: np.ndarray, random: np.random.Generator) -> list[Cell]:
    """The cells of the outline in counter-clockwise order from a random one."""
    # Square (i, j) lies between the centres of cells i - 1 and i, j - 1 and j; the region is on the left.
    ways: dict[Cell, Cell] = {}
    padded = np.pad(blob, 1)
    for i, j in np.argwhere(blob).tolist():
        corners = [(i - 1, j - 1), (i, j - 1), (i, j), (i - 1, j)]
        beside = padded[i + 1, j], padded[i + 2, j + 1], padded[i + 1, j + 2], padded[i, j + 1]
        ways |= {corners[k]: corners[(k + 1) % 4] for k in range(4) if not beside[k]}
    start = sorted(ways)[int(random.integers(len(ways)))]
    loop = [start]
    while (following := ways[loop[-1]]) != start:
        loop.append(following)
    return loop


def change_walls(
    maze: Maze, added: Sequence[tuple[Cell, Cell]], removed: Sequence[tuple[Cell, Cell]]
) -> Maze:
    """The maze with walls between these pairs of neighbouring cells put up and others taken away.

    Raises:
        InputError: two cells are not neighbours in the maze, or the wall is there already, or not there.
    """
    changed = Maze(maze.across.copy(), maze.along.copy())
    for name, pairs, there in (("added", added, False), ("removed", removed, True)):
        for number, (a, b) in enumerate(pairs):
            where, cells = f"simulation.maze.{name}[{number}]", f"cells {tuple(a)} and {tuple(b)}"
            if not maze.is_inside(a) or tuple(b) not in maze.around(a):
                raise InputError(where, cells, "two neighbouring cells of the maze")
            wall, place = changed.between_cells(a, b)
            if wall[place] != there:
                found = f"{'no' if there else 'a'} wall between {cells}"
                raise InputError(where, found, f"{'a' if there else 'no'} wall there")
            wall[place] = not there
    return changed


def cell_centre(cell: Cell) -> np.ndarray:
    """Centre [2] of a cell, m; the south-west corner post of the maze is at the origin."""
    return (np.array(cell, float) + 0.5) * CELL_SIDE


def wall_boxes(maze: Maze, random: np.random.Generator, heights: tuple[float, ...] = (WALL_HEIGHT,)) -> Walls:
    """The maze as boxes: a post at every corner with the largest height (m), and walls with random
    heights."""
    posts = np.ones((maze.rows + 1, maze.columns + 1), bool)
    boxes = [_box_corners(maze.across, (1, 0)), _box_corners(maze.along, (0, 1)), _box_corners(posts, (0, 0))]
    count = len(boxes[0]) + len(boxes[1])
    height = random.choice(heights, count) if len(heights) > 1 else np.full(count, heights[0])
    return Walls(np.vstack(boxes), np.concatenate([height, np.full(posts.size, max(heights))]))


def _box_corners(there: np.ndarray, size: Cell) -> np.ndarray:
    """Boxes [B, 4] that extend by `size` cells (east, north) from each corner in `there`, less the posts."""
    corner, inset = np.argwhere(there)[:, ::-1], WALL_THICKNESS / 2 * (2 * np.array(size) - 1)
    return np.hstack([corner * CELL_SIDE + inset, (corner + size) * CELL_SIDE - inset])


def describe_box(walls: Walls, number: int) -> str:
    """A text that names a box of a maze."""
    x, y = (walls.box[number, :2] + walls.box[number, 2:]) / 2 / CELL_SIDE
    at_post = abs(x - round(x)) < 0.25, abs(y - round(y)) < 0.25
    if all(at_post):
        return f"the post at corner ({round(x)}, {round(y)})"
    side, cell = ("west", (round(x), int(y))) if at_post[0] else ("south", (int(x), round(y)))
    return f"the wall {side} of cell {cell}"


def read_maze(path: Path) -> Maze:
    """Read a maze file.

    Raises:
        InputError: the file is unreadable, has an unexpected character, or lacks an outer wall.
    """
    return parse_maze(read_text(path, "a micromouse maze as text", 1 << 20), path)


def parse_maze(text: str, path: Path) -> Maze:
    """The maze in a text."""
    lines = [line.rstrip() for line in text.rstrip().splitlines()]
    skipped = next((number for number, line in enumerate(lines) if line), 0)
    lines = lines[skipped:]
    rows, width = len(lines) // 2, max((len(line) for line in lines), default=0)
    columns = (width - 1) // 4
    if len(lines) % 2 == 0 or rows < 1 or columns < 1 or width != 4 * columns + 1:
        found = f"{len(lines)} lines of up to {width} characters"
        expected = "2 rows + 1 lines of 4 columns + 1 characters: posts `o`, walls `---` and `|`"
        raise InputError(str(path), found, expected)

    def expect(number: int, column: int, found: str, *kinds: str) -> None:
        if found not in kinds:
            expected = " or ".join(f"`{kind}`" if kind.strip() else f"{len(kind)} blank" for kind in kinds)
            raise InputError(f"{path}:{skipped + number + 1}:{column + 1}", f"{found!r}", expected)

    maze = Maze(np.zeros((rows + 1, columns), bool), np.zeros((rows, columns + 1), bool))
    for number, line in enumerate(lines):
        line = line.ljust(width)
        row = rows - (number + 1) // 2
        for column in range(columns + 1):
            post = 4 * column
            if number % 2:
                expect(number, post, line[post], "|", " ")
                maze.along[row, column] = line[post] == "|"
                continue
            expect(number, post, line[post], "o", "+", ".")
            if column < columns:
                expect(number, post + 1, line[post + 1 : post + 4], "---", "   ")
                maze.across[row, column] = line[post + 1] == "-"
    _check_outer_wall(path, maze, skipped)
    return maze


def _check_outer_wall(path: Path, maze: Maze, skipped: int) -> None:
    """Raise an error for a gap in the outer wall."""
    last = skipped + 2 * maze.rows + 1
    for side, present, place in (
        ("south", maze.across[0], lambda k: (last, 4 * k + 2)),
        ("north", maze.across[-1], lambda k: (skipped + 1, 4 * k + 2)),
        ("west", maze.along[:, 0], lambda k: (last - 1 - 2 * k, 1)),
        ("east", maze.along[:, -1], lambda k: (last - 1 - 2 * k, 4 * maze.columns + 1)),
    ):
        if not present.all():
            line, column = place(int(np.argmin(present)))
            where = f"{path}:{line}:{column}"
            raise InputError(where, f"a gap in the {side} wall", "a closed outer wall", "close it")


def maze_text(maze: Maze) -> str:
    """The maze in the file format; the inverse of `read_maze`."""
    lines = []
    for row in range(maze.rows, -1, -1):
        lines.append("o" + "".join(("---" if wall else "   ") + "o" for wall in maze.across[row]))
        if row:
            marks = ["|" if wall else " " for wall in maze.along[row - 1]]
            lines.append("   ".join(marks))
    return "\n".join(lines) + "\n"


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
        options = [cell for cell in maze.neighbours(way[-1]) if not within or cell in within]
        if not options:
            raise InputError("simulation.maze", f"cell {start} is walled in", "a way out of it")
        onward = [cell for cell in options if cell != before] or options
        before = way[-1]
        way.append(onward[int(random.integers(len(onward)))])
    return way


def winding_loop(columns: int, rows: int, random: np.random.Generator) -> list[Cell]:
    """A random loop through each cell of a rectangle once: the way around a random tree of 2 x 2 blocks."""
    tree = tree_maze(columns // 2, rows // 2, random)
    way: list[Cell] = [(0, 0)]
    while len(way) < columns * rows:
        x, y = way[-1]
        right, up = 2 * (x % 2) - 1, 2 * (y % 2) - 1  # the side of its block on which the cell lies
        block = x // 2, y // 2
        joined = tree.neighbours(block)
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
    return list(loop) if polygon_area(np.array(loop)) > 0 else [loop[0], *loop[:0:-1]]


def check_route(maze: Maze, way: Sequence[Cell], where: str = "simulation.path.cells") -> None:
    """Check that a route stays in the maze and passes no wall.

    Args:
        where: name of the route in errors.

    Raises:
        InputError: the route is not possible; the error gives the step and the wall.
    """
    for number, cell in enumerate(way):
        if not maze.is_inside(cell):
            expected = f"columns 0 to {maze.columns - 1} and rows 0 to {maze.rows - 1}"
            raise InputError(f"{where}[{number}]", f"cell {tuple(cell)}", expected)
    for number, (a, b) in enumerate(pairwise(way)):
        leg = f"{where}[{number}] to [{number + 1}]"
        if abs(a[0] - b[0]) + abs(a[1] - b[1]) != 1:
            raise InputError(leg, f"from cell {tuple(a)} to {tuple(b)}", "a step to a neighbouring cell")
        if not maze.is_open(a, b):
            found = f"a step through the wall between cells {tuple(a)} and {tuple(b)}"
            cure = "take the wall out of the maze or lead the path around it"
            raise InputError(leg, found, "a way around the walls", cure)
