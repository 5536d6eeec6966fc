"""Mazes: random loops, walls as boxes, the file format, routes, and the head's paths along them."""

from functools import partial
from itertools import pairwise

import networkx
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from robot.world import maze as mazes
from robot.world.maze import CELL_SIDE, Cell, Maze, circuit_route, closed_maze, random_loop, read_maze
from robot.world.scene import HeadPath, JitterConfig, MotionConfig, add_kidnaps, plan_path, poses_at
from tactile.base.random_streams import stream
from tactile.base.se2 import wrap

SEEDS, STEADY = st.integers(0, 10**6), JitterConfig(position=0, yaw_deg=0, speed=0)


def cells(text: str) -> list[Cell]:
    return [(int(column), int(row)) for column, row in text.split()]


SQUARE = cells("00 10 11 01")
GOOD = "\n\no---o---o\n|   |   |\no   o---o\n|   |   |\no---o---o\n"
DRAWN = """o---o---o---o---o
|   |           |
o   o   o   o   o
|   |   |       |
o---o   o   o   o
|               |
o---o---o---o---o
"""
TREE = """o---o---o---o---o
|   |           |
o   o   o---o   o
|           |   |
o---o---o---o   o
|               |
o---o---o---o---o
"""


def world(seed: int, share: float = 0.6, size: tuple[int, int] = (4, 3), length: int = 8):
    loop = random_loop(*size, length, stream(seed, "maze.loop"))
    return mazes.random_maze(*size, loop, share, stream(seed, "maze.walls")), loop


def boxes_of(maze: Maze, seed: int = 0, *heights: tuple[float, ...]) -> mazes.Walls:
    return mazes.wall_boxes(maze, stream(seed, "maze.heights"), *heights)


@given(SEEDS, st.sampled_from([(7, 5, 20), (5, 5, 20), (12, 8, 40), (2, 2, 4), (3, 2, 6)]))
def test_a_loop_is_closed_simple_and_anticlockwise(seed, size):
    loop = random_loop(*size, stream(seed, "maze.loop"))
    place = np.array(loop)
    assert len(set(loop)) == len(loop) == size[2]
    assert ((place >= 0) & (place < size[:2])).all()
    assert (np.abs(np.roll(place, -1, axis=0) - place).sum(axis=1) == 1).all()
    x, y = place.T
    assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0
    assert mazes.make_anticlockwise(loop) == loop
    assert mazes.make_anticlockwise([loop[0], *loop[:0:-1]]) == loop


@given(SEEDS, st.integers(1, 9), st.integers(1, 9))
def test_one_way_joins_each_two_cells_of_a_tree(seed, columns, rows):
    maze = mazes.tree_maze(columns, rows, np.random.default_rng(seed))
    every = [(column, row) for column in range(columns) for row in range(rows)]
    graph = networkx.Graph()
    graph.add_nodes_from(every)
    graph.add_edges_from((cell, other) for cell in every for other in maze.neighbours(cell))
    assert networkx.is_tree(graph)
    assert maze.across[[0, -1]].all()
    assert maze.along[:, [0, -1]].all()


def test_a_seed_gives_the_same_maze_and_route_for_ever():
    maze, loop = world(3)
    assert loop == cells("32 22 12 11 10 20 21 31")
    assert mazes.maze_text(maze) == DRAWN
    tree = mazes.tree_maze(4, 3, stream(3, "x"))
    assert mazes.maze_text(tree) == TREE
    way = mazes.exploration_route(tree, (0, 0), 12, stream(0, "path"))
    assert way == cells("00 10 20 30 31 32 22 12 11 01 02 01")
    within = mazes.exploration_route(maze, loop[2], 200, stream(1, "path"), loop[2:])
    assert set(within) == set(loop[2:])
    mazes.check_route(maze, within)
    assert mazes.winding_loop(4, 2, stream(3, "loop")) == cells("00 01 11 21 31 30 20 10")


@given(SEEDS)
def test_the_loop_is_open_and_the_outer_wall_closed(seed):
    maze, loop = world(seed, share=1.0)
    assert maze.across[[0, -1]].all()
    assert maze.along[:, [0, -1]].all()
    for k, cell in enumerate(loop):
        assert set(maze.neighbours(cell)) == {loop[k - 1], loop[(k + 1) % 8]}
    assert (~maze.across).sum() + (~maze.along).sum() == 8
    bare, _ = world(seed, share=0.0)
    assert bare.across.sum() + bare.along.sum() == 2 * 4 + 2 * 3


@given(SEEDS, st.floats(0, 1), st.sampled_from([(7, 5), (12, 8), (2, 2)]))
def test_a_maze_file_is_read_back_equal(tmp_path_factory, seed, share, size):
    maze, _ = world(seed, share, size, 4)
    path, text = tmp_path_factory.getbasetemp() / "maze.txt", mazes.maze_text(maze)
    for written in (text, text.replace("o", "+"), "\n\n" + text + "\n", text.rstrip()):
        path.write_text(written)
        assert all(np.array_equal(a, b) for a, b in zip(read_maze(path), maze, strict=True))


def test_a_faulty_maze_file_is_refused(tmp_path, refused):
    path = tmp_path / "maze.txt"
    path.write_text(GOOD)
    read_maze(path)
    for change, where, found in (
        ((GOOD, "\n\n"), "", "0 lines"),
        (("|   |   |\no", "|   |    \no"), ":4:9", "gap in the east wall"),
        (("|   |   |\no", "    |   |\no"), ":4:1", "gap in the west wall"),
        (("|\no---o---o", "|\no---o   o"), ":7:6", "gap in the south wall"),
        (("\n\no---o", "\n\no   o"), ":3:2", "gap in the north wall"),
        (("o   o", "o-- o"), ":5:2", "'-- '"),
        (("o   o", "x   o"), ":5:1", "'x'"),
        (("|   |   |\no", "|   #   |\no"), ":4:5", "'#'"),
        (("\no   o", ""), "", "4 columns + 1"),
        (("|   |   |\n", ""), "", "4 lines of up to 9"),
    ):
        path.write_text(GOOD.replace(*change, 1))
        refused(lambda: read_maze(path), f"maze.txt{where}: ", found)


def test_boxes_are_at_the_walls_of_the_maze():
    """Two cells with a wall between: across, along, posts; west, south, east, north."""
    boxes, post, long = boxes_of(closed_maze(2, 1)), 0.006, CELL_SIDE - 0.006
    flat = [[x + post, y - post, x + long, y + post] for y in (0, CELL_SIDE) for x in (0, CELL_SIDE)]
    upright = [[x - post, post, x + post, long] for x in (0, CELL_SIDE, 2 * CELL_SIDE)]
    posts = [[x - post, y - post, x + post, y + post] for y in (0, 0.18) for x in (0, 0.18, 0.36)]
    np.testing.assert_allclose(boxes.box, [*flat, *upright, *posts], atol=1e-12)
    assert (boxes.height == 0.05).all()
    mixed = boxes_of(world(0)[0], 0, (0.03, 0.05, 0.04))
    assert set(mixed.height[:-20]) == {0.03, 0.04, 0.05}
    assert set(mixed.height[-20:]) == {0.05}
    names = [mazes.describe_box(boxes, k) for k in (0, 3, 4, 6, 7, 12)]
    kinds = ("wall south of cell", "wall west of cell", "post at corner")
    places = ("(0, 0)", "(1, 1)", "(0, 0)", "(2, 0)", "(0, 0)", "(2, 1)")
    assert names == [f"the {kinds[k // 2]} {place}" for k, place in enumerate(places)]
    assert mazes.cell_centre((2, 0)).tolist() == pytest.approx([0.45, 0.09])


def test_changed_walls_are_those_named_and_a_change_that_is_none_is_refused(refused):
    before, _ = world(3)
    gap = next((c, r) for r in range(3) for c in range(3) if not before.along[r, c + 1])
    wall = next((c, r) for r in range(3) for c in range(3) if before.along[r, c + 1])
    added, removed = (gap, (gap[0] + 1, gap[1])), (wall, (wall[0] + 1, wall[1]))
    after = mazes.change_walls(before, [added], [removed[::-1]])
    assert np.argwhere(after.along != before.along).tolist() == sorted([[r, c + 1] for c, r in (gap, wall)])
    assert (after.across == before.across).all()
    assert mazes.change_walls(after, [removed], [added]).along.tolist() == before.along.tolist()
    for added, removed, found in (
        ([((0, 0), (1, 1))], [], "added[0]: cells"),
        ([], [((0, 0), (-1, 0))], "removed[0]: cells"),
        ([((0, 0), (1, 0))], [], "added[0]: a wall between"),
    ):
        refused(partial(mazes.change_walls, closed_maze(2, 2), added, removed), f"simulation.maze.{found}")
    with pytest.raises(ValueError, match="not neighbours"):
        closed_maze(2, 2).is_open((0, 0), (1, 1))


@given(st.text("CAca", min_size=1, max_size=12), st.integers(0, 1000))
def test_each_letter_is_one_circuit_and_explorations_turn_back_in_dead_ends_only(word, seed):
    maze, loop = world(seed)
    way = circuit_route(loop, word)
    mazes.check_route(maze, way)
    assert len(way) == len(word) * len(loop) + 1
    for k, letter in enumerate(word.upper()):
        lap = way[k * len(loop) : (k + 1) * len(loop) + 1]
        assert lap[0] == lap[-1] == loop[0]
        assert lap[:-1] == (loop if letter == "A" else [loop[0], *loop[:0:-1]])
    way = mazes.exploration_route(maze, loop[0], 200, stream(seed, "path"))
    assert len(way) == 200
    mazes.check_route(maze, way)
    for before, here, after in zip(way, way[1:], way[2:], strict=False):
        assert after != before or maze.neighbours(here) == [before]


@given(st.integers(1, 8), st.integers(1, 8), st.integers(0, 1000))
def test_a_winding_loop_visits_every_cell_once(columns, rows, seed):
    columns, rows = 2 * columns, 2 * rows
    loop = mazes.winding_loop(columns, rows, stream(seed, "loop"))
    assert sorted(loop) == [(x, y) for x in range(columns) for y in range(rows)]
    assert (np.abs(np.diff([*loop, loop[0]], axis=0)).sum(axis=1) == 1).all()


def test_impossible_loops_words_and_routes_are_refused(refused):
    for size in ((7, 5, 21), (7, 5, 2), (3, 3, 10), (7, 5, 36), (5, 1, 4)):
        refused(lambda size=size: random_loop(*size, stream(0, "x")), "maze.loop", f"{size[2]} cells")
    for word in ("", "CAB", "C A"):
        refused(lambda word=word: circuit_route(SQUARE, word), "simulation.path.circuits", repr(word))
    maze, loop = world(0)
    rows = [[(x, y) for x in range(4)] for y in range(3)]
    blocked = next([a, b] for row in rows for a, b in pairwise(row) if not maze.is_open(a, b))
    wall = f"the wall between cells {blocked[0]} and {blocked[1]}"
    for way, *pieces in (
        (blocked, "simulation.path.cells[0] to [1]", wall),
        ([(0, 0), (4, 0)], "cells[1]", "cell (4, 0)", "columns 0 to 3"),
        ([(0, -1), (0, 0)], "cells[0]", "cell (0, -1)", "rows 0 to 2"),
        ([(0, 0), (0, 0)], "cells[0] to [1]", "neighbouring"),
        ([*loop[:2], loop[5]], "cells[1] to [2]", "neighbouring"),
    ):
        refused(lambda way=way: mazes.check_route(maze, way), *pieces)
    alone = closed_maze(3, 3)
    refused(lambda: mazes.exploration_route(alone, (1, 1), 5, stream(0, "path")), "(1, 1) is walled in")
    refused(lambda: mazes.make_anticlockwise([*SQUARE, *SQUARE]), "simulation.path.loop", "(0, 0) twice")
    refused(lambda: mazes.make_anticlockwise(SQUARE[:3]), "3 cells")


def route(seed: int, word: str = "CA") -> list[tuple[int, int]]:
    return circuit_route(random_loop(5, 4, 12, stream(seed, "maze.loop")), word)


def path_of(seed: int, **changes: object) -> HeadPath:
    return plan_path(MotionConfig(**changes), route(seed), stream(seed, "motion"))


@given(SEEDS)
def test_without_jitter_the_path_joins_cell_centres_and_faces_ahead(seed):
    path = path_of(seed, jitter=STEADY)
    passed = path.pose[np.concatenate([[True], np.abs(np.diff(path.pose[:, :2], axis=0)).sum(axis=1) > 1e-9])]
    assert np.allclose(passed[:, :2], [mazes.cell_centre(cell) for cell in route(seed)], atol=1e-12)
    step, took = np.diff(path.pose, axis=0), np.diff(path.time)
    driven = np.hypot(step[:, 0], step[:, 1])
    straight = driven > 1e-9
    assert np.allclose(driven[straight] / took[straight], 0.03)
    assert np.allclose(step[straight, 2], 0)
    course = np.arctan2(step[straight, 1], step[straight, 0])
    assert np.allclose(wrap(course - path.pose[1:][straight, 2]), 0, atol=1e-9)
    assert np.allclose(np.abs(step[~straight, 2]) / took[~straight], 0.4)
    assert (np.abs(step[:, 2]) <= np.pi + 1e-12).all()
    assert np.isclose(path.duration, 24 * CELL_SIDE / 0.03 + np.abs(step[:, 2]).sum() / 0.4)
    there, back = (
        plan_path(MotionConfig(jitter=STEADY, backwards=way < 0), route(seed, "A")[::way], stream(seed, "m"))
        for way in (1, -1)
    )
    assert np.isclose(there.duration, back.duration)
    time = np.linspace(0, there.duration, 200)
    one, other = poses_at(there, time), poses_at(back, there.duration - time)
    assert np.allclose(one[:, :2], other[:, :2], atol=1e-9)
    assert np.allclose(wrap(one[:, 2] - other[:, 2]), 0, atol=1e-9)
    assert (poses_at(there, np.array([-5.0, 1e9])) == there.pose[[0, -1]]).all()


def test_the_path_of_a_seed_stays_the_same_with_the_configured_jitter():
    path = path_of(3, jitter=JitterConfig(position=0.005, yaw_deg=3.0, speed=0.1))
    assert (np.diff(path.time) > 0).all()
    np.testing.assert_allclose(path.time[[1, 2, -1]], [6.165587, 10.092578, 191.124197], atol=1e-6)
    np.testing.assert_allclose(path.pose[0], [0.634887, 0.088557, 1.548726], atol=1e-6)
    np.testing.assert_allclose(path.pose[-1], [0.630716, 0.094068, 4.738440], atol=1e-6)


@settings(max_examples=40)
@given(SEEDS, st.lists(st.floats(0.05, 0.7), min_size=1, max_size=4), st.floats(1.0, 30.0))
@example(0, [0.95], 45.0)
def test_a_kidnap_continues_at_the_later_pose(seed, shares, ahead):
    path = path_of(seed)
    when = [share * path.duration for share in shares]
    there, jumps = add_kidnaps(path, when, ahead)
    assert (np.diff(there.time) >= 0).all()
    # Kidnap k, from 0, leads to `when + (k + 1) * ahead` of the path; the path ends at the first one beyond.
    beyond = np.sort(when) + ahead * np.arange(1, len(when) + 1) >= path.duration
    count = int(beyond.argmax()) if beyond.any() else len(when)
    assert np.allclose(jumps, np.sort(when)[:count])
    ended = np.sort(when)[count] if beyond.any() else path.duration - ahead * count
    assert there.duration == pytest.approx(min(ended, path.duration - ahead * count))
    time = np.linspace(0, there.duration, 300)
    skipped = ahead * (time[:, None] > jumps).sum(axis=1)
    away = np.abs(time[:, None] - jumps).min(axis=1, initial=np.inf) > 1e-6
    assert np.allclose(poses_at(there, time)[away], poses_at(path, time + skipped)[away], atol=1e-9)
