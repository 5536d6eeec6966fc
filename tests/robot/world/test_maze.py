"""Mazes: random loops, walls as boxes, and the file format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import networkx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.world.maze import (
    CELL_SIDE,
    WALL_HEIGHT,
    WALL_THICKNESS,
    Maze,
    cell_centre,
    change_walls,
    closed_maze,
    describe_box,
    maze_text,
    random_loop,
    random_maze,
    read_maze,
    tree_maze,
    wall_boxes,
)
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

SEEDS = st.integers(0, 10**6)


def maze_of(seed: int, columns: int = 7, rows: int = 5, length: int = 20, share: float = 0.6) -> Maze:
    loop = random_loop(columns, rows, length, stream(seed, "maze.loop"))
    return random_maze(columns, rows, loop, share, stream(seed, "maze.walls"))


@given(SEEDS, st.sampled_from([(7, 5, 20), (5, 5, 20), (12, 8, 20), (12, 8, 40), (2, 2, 4), (3, 2, 6)]))
def test_a_loop_is_closed_simple_and_anticlockwise(seed: int, size: tuple[int, int, int]) -> None:
    columns, rows, length = size
    loop = random_loop(columns, rows, length, stream(seed, "maze.loop"))
    cells = np.array(loop)
    assert len(set(loop)) == len(loop) == length
    assert (cells >= 0).all()
    assert (cells < [columns, rows]).all()
    steps = np.roll(cells, -1, axis=0) - cells
    assert (np.abs(steps).sum(axis=1) == 1).all()
    x, y = cells.T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0
    assert loop == random_loop(columns, rows, length, stream(seed, "maze.loop"))


@given(SEEDS, st.integers(1, 9), st.integers(1, 9))
def test_one_way_joins_each_two_cells_of_a_tree(seed: int, columns: int, rows: int) -> None:
    maze = tree_maze(columns, rows, np.random.default_rng(seed))
    cells = [(column, row) for column in range(columns) for row in range(rows)]
    graph = networkx.Graph()
    graph.add_nodes_from(cells)
    graph.add_edges_from((cell, other) for cell in cells for other in maze.neighbours(cell))
    assert networkx.is_tree(graph)
    assert maze.across[[0, -1]].all()
    assert maze.along[:, [0, -1]].all()


def test_mazes_of_different_seeds_differ() -> None:
    loops = {tuple(random_loop(7, 5, 20, stream(seed, "maze.loop"))) for seed in range(20)}
    assert len(loops) >= 18


@pytest.mark.parametrize(
    ("columns", "rows", "length"), [(7, 5, 21), (7, 5, 2), (3, 3, 10), (7, 5, 36), (5, 1, 4)]
)
def test_an_impossible_loop_length_is_refused(
    columns: int, rows: int, length: int, refused: Callable[..., InputError]
) -> None:
    refused(
        lambda: random_loop(columns, rows, length, stream(0, "x")), "simulation.maze.loop", f"{length} cells"
    )


@given(SEEDS)
def test_the_loop_is_open_and_the_outer_wall_closed(seed: int) -> None:
    loop = random_loop(7, 5, 20, stream(seed, "maze.loop"))
    maze = random_maze(7, 5, loop, 1.0, stream(seed, "maze.walls"))
    assert maze.across[[0, -1]].all()
    assert maze.along[:, [0, -1]].all()
    for k, cell in enumerate(loop):
        assert set(maze.neighbours(cell)) == {loop[k - 1], loop[(k + 1) % 20]}
    assert (~maze.across).sum() + (~maze.along).sum() == 20
    bare = random_maze(7, 5, loop, 0.0, stream(seed, "maze.walls"))
    assert bare.across.sum() + bare.along.sum() == 2 * 7 + 2 * 5


def test_the_share_of_walls_is_configurable() -> None:
    mazes = [maze_of(seed, share=0.6) for seed in range(60)]
    inner = np.concatenate([maze.across[1:-1].ravel() for maze in mazes])
    # About 10 of the 20 openings of a loop are in the 28 `across` walls.
    assert abs(inner.mean() - 0.6 * (1 - 10 / 28)) < 0.04


@given(SEEDS, st.floats(0, 1), st.sampled_from([(7, 5), (12, 8), (2, 2)]))
def test_a_maze_file_is_read_back_equal(
    tmp_path_factory: pytest.TempPathFactory, seed: int, share: float, size: tuple[int, int]
) -> None:
    maze = maze_of(seed, *size, length=4, share=share)
    path = tmp_path_factory.getbasetemp() / "maze.txt"
    for written in (
        maze_text(maze),
        maze_text(maze).replace("o", "+"),
        "\n\n" + maze_text(maze) + "\n",
        maze_text(maze).rstrip(),
    ):
        path.write_text(written)
        read = read_maze(path)
        assert (read.across == maze.across).all()
        assert (read.along == maze.along).all()


def test_the_first_line_of_a_maze_file_is_the_north_wall(tmp_path: Path) -> None:
    (tmp_path / "maze.txt").write_text("o---o---o\n|     S |\no   o---o\n|   | G |\no---o---o\n")
    maze = read_maze(tmp_path / "maze.txt")
    assert maze.is_open((0, 1), (1, 1))
    assert maze.is_open((0, 0), (0, 1))
    assert not maze.is_open((1, 0), (1, 1))
    assert not maze.is_open((0, 0), (1, 0))


@pytest.mark.parametrize(
    ("change", "where", "found"),
    [
        (("|   |   |\no", "|   |    \no"), "maze.txt:4:9", "gap in the east wall"),
        (("|   |   |\no", "    |   |\no"), "maze.txt:4:1", "gap in the west wall"),
        (("|\no---o---o", "|\no---o   o"), "maze.txt:7:6", "gap in the south wall"),
        (("\n\no---o", "\n\no   o"), "maze.txt:3:2", "gap in the north wall"),
        (("o   o", "o-- o"), "maze.txt:5:2", "'-- '"),
        (("o   o", "x   o"), "maze.txt:5:1", "'x'"),
        (("|   |   |\no", "|   #   |\no"), "maze.txt:4:5", "'#'"),
        (("\no   o", ""), "maze.txt", "4 columns + 1"),
    ],
)
def test_a_faulty_maze_file_is_refused(
    tmp_path: Path, change: tuple[str, str], where: str, found: str, refused: Callable[..., InputError]
) -> None:
    good = "\n\no---o---o\n|   |   |\no   o---o\n|   |   |\no---o---o\n"
    path = tmp_path / "maze.txt"
    path.write_text(good)
    read_maze(path)
    path.write_text(good.replace(*change, 1))
    refused(lambda: read_maze(path), where, found)


def test_a_binary_file_is_refused(tmp_path: Path, refused: Callable[..., InputError]) -> None:
    refused(lambda: read_maze(tmp_path / "none.txt"), "none.txt", "no such file")
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe\x00")
    refused(lambda: read_maze(tmp_path / "bytes.txt"), "bytes.txt", "malformed")
    (tmp_path / "empty.txt").write_text("\n\n")
    refused(lambda: read_maze(tmp_path / "empty.txt"), "empty.txt", "0 lines")


@given(SEEDS)
def test_boxes_are_at_the_walls_of_the_maze(seed: int) -> None:
    maze = maze_of(seed)
    boxes = wall_boxes(maze, stream(seed, "maze.heights"))
    posts = 8 * 6
    assert len(boxes.box) == maze.across.sum() + maze.along.sum() + posts
    assert (boxes.height == WALL_HEIGHT).all()
    size = boxes.box[:, 2:] - boxes.box[:, :2]
    assert np.allclose(size.min(axis=1), WALL_THICKNESS)
    assert np.allclose(size[:-posts].max(axis=1), CELL_SIDE - WALL_THICKNESS)
    # Between two cells there is a box exactly where there is a wall.
    inside = boxes.box[:-posts]
    for a, b in (((2, 2), (3, 2)), ((2, 2), (2, 3)), ((0, 0), (1, 0)), ((6, 3), (6, 4))):
        x, y = (cell_centre(a) + cell_centre(b)) / 2
        hit = (inside[:, 0] < x) & (x < inside[:, 2]) & (inside[:, 1] < y) & (y < inside[:, 3])
        assert hit.any() != maze.is_open(a, b)
    # No two boxes overlap.
    west, south, east, north = (boxes.box + [1e-9, 1e-9, -1e-9, -1e-9]).T
    over = (
        (west[:, None] < east) & (west < east[:, None]) & (south[:, None] < north) & (south < north[:, None])
    )
    assert over.sum() == len(boxes.box)


def test_walls_have_the_given_heights_and_posts_the_largest() -> None:
    boxes = wall_boxes(maze_of(0), stream(0, "maze.heights"), (0.03, 0.05, 0.04))
    assert set(boxes.height[:-48]) == {0.03, 0.04, 0.05}
    assert set(boxes.height[-48:]) == {0.05}


def test_boxes_have_names() -> None:
    maze = maze_of(0, share=1.0)
    boxes = wall_boxes(maze, stream(0, "maze.heights"))
    names = [describe_box(boxes, k) for k in range(len(boxes.box))]
    assert len(set(names)) == len(names)
    assert names[0] == "the wall south of cell (0, 0)"
    assert names[-1] == "the post at corner (7, 5)"
    assert names[int(maze.across.sum())] == "the wall west of cell (0, 0)"


def test_cells_that_are_not_neighbours_are_a_programming_error() -> None:
    with pytest.raises(ValueError, match="not neighbours"):
        maze_of(0).is_open((0, 0), (1, 1))


def test_changed_walls_are_those_named() -> None:
    before = maze_of(3)
    gap = next((c, r) for r in range(5) for c in range(6) if not before.along[r, c + 1])
    wall = next((c, r) for r in range(5) for c in range(6) if before.along[r, c + 1])
    added, removed = (gap, (gap[0] + 1, gap[1])), (wall, (wall[0] + 1, wall[1]))
    after = change_walls(before, [added], [removed[::-1]])
    assert np.argwhere(after.along != before.along).tolist() == sorted([[r, c + 1] for c, r in (gap, wall)])
    assert (after.across == before.across).all()
    assert change_walls(after, [removed], [added]).along.tolist() == before.along.tolist()


@pytest.mark.parametrize(
    ("pair", "key", "found"),
    [
        (((0, 0), (1, 1)), "added", "cells"),
        (((0, 0), (-1, 0)), "removed", "cells"),
        (((0, 0), (1, 0)), "added", "a wall between"),
    ],
)
def test_a_change_that_is_none_is_refused(
    pair: tuple[tuple[int, int], tuple[int, int]], key: str, found: str, refused: Callable[..., InputError]
) -> None:
    changes: dict[str, list[tuple[tuple[int, int], tuple[int, int]]]] = {
        "added": [],
        "removed": [],
        key: [pair],
    }
    refused(lambda: change_walls(closed_maze(2, 2), **changes), f"simulation.maze.{key}[0]: {found}")
