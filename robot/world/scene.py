"""The scene of a head session from its settings: maze, route, head trajectory, kidnaps and walls.

The trajectory is the poses of the head over time along a route, with random variation between visits.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path as File
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, model_validator

from robot.sources.source import MazeInfo
from robot.world.maze import (
    CELL_SIDE,
    WALL_HEIGHT,
    Cell,
    Maze,
    cell_centre,
    change_walls,
    check_route,
    circuit_route,
    describe_box,
    exploration_route,
    make_anticlockwise,
    maze_text,
    random_loop,
    random_maze,
    read_maze,
    table_maze,
    tree_maze,
    wall_boxes,
)
from robot.world.walls import Surroundings, Walls
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import wrap
from tactile.base.settings import Settings
from tactile.pokes import TURN_LENGTH
from tactile.whisker_geometry import Head, tip_height


class JitterConfig(Settings):
    """Random variation between visits, as standard deviations; drawn anew in every cell."""

    position: NonNegativeFloat = 0.002
    """Position off the cell centre along each axis, m."""
    yaw_deg: NonNegativeFloat = 0.5
    """Heading off the direction of travel, degrees."""
    speed: NonNegativeFloat = 0.0
    """Speed, as a fraction of it."""


class MotionConfig(Settings):
    """Motion of the arm."""

    speed: PositiveFloat = 0.03
    """Speed along the route, m/s."""
    turn_rate: PositiveFloat = 0.4
    """Turn rate on the spot, rad/s."""
    backwards: bool = False
    """Whether the head faces backwards (reverse tracking)."""
    jitter: JitterConfig = JitterConfig()
    """Variation between visits."""


class HeadPath(NamedTuple):
    """Poses in order of time, with uniform motion in between.

    Attributes:
        time: [K] s. pose: [K, 3] m, m, rad; headings are not wrapped.
    """

    time: np.ndarray
    pose: np.ndarray

    @property
    def duration(self) -> float:
        return float(self.time[-1])


def plan_path(config: MotionConfig, way: Sequence[Cell], random: np.random.Generator) -> HeadPath:
    """The path along cells: straight from centre to centre, with turns on the spot."""
    jitter = config.jitter
    count = len(way)
    offset = jitter.position * random.standard_normal((count, 2))
    yaw = np.radians(jitter.yaw_deg) * random.standard_normal(count)
    pace = config.speed * np.clip(1 + jitter.speed * random.standard_normal(count), 0.2, 5.0)
    middle = np.array([cell_centre(cell) for cell in way])
    step = np.diff(middle, axis=0)
    course = np.arctan2(step[:, 1], step[:, 0]) + (np.pi if config.backwards else 0.0)
    heading = np.concatenate([course[:1], course[:1] + np.cumsum(wrap(np.diff(course)))])

    place = middle + offset
    time, pose = [0.0], [[*place[0], heading[0] + yaw[0]]]
    for k in range(count - 1):
        turn = heading[k] - (heading[k - 1] if k else heading[0])
        if turn:
            time.append(time[-1] + abs(turn) / config.turn_rate)
            pose.append([*place[k], heading[k] + yaw[k]])
        time.append(time[-1] + float(np.hypot(*step[k])) / pace[k])
        pose.append([*place[k + 1], heading[k] + yaw[k + 1]])
    return HeadPath(np.array(time), np.array(pose))


def poses_at(path: HeadPath, time: np.ndarray) -> np.ndarray:
    """Poses [..., 3] at times [...] s; clamped to the ends of the path."""
    return np.stack([np.interp(time, path.time, path.pose[:, k]) for k in range(3)], axis=-1)


def moved_length(path: HeadPath) -> np.ndarray:
    """Way [K] of the arm up to each pose of a path, m; turns count too."""
    step = np.abs(np.diff(path.pose, axis=0))
    way = np.hypot(step[:, 0], step[:, 1]) + TURN_LENGTH * step[:, 2]
    return np.concatenate([[0.0], np.cumsum(way)])


def add_kidnaps(path: HeadPath, at_times: Sequence[float], ahead: float) -> tuple[HeadPath, np.ndarray]:
    """The path with kidnaps: at each of these times the head jumps to its pose `ahead` s later.

    Returns:
        the path, and the times [J] of the kidnaps, s.
    """
    times, poses, start, done = [], [], 0.0, 0.0
    jumps = []
    for when in [*sorted(at_times), np.inf]:
        stop = min(max(when + start - done, start), path.duration)
        inner = (path.time > start) & (path.time < stop)
        part = np.concatenate([[start], path.time[inner], [stop]])
        times.append(part - start + done)
        poses.append(poses_at(path, part))
        done += stop - start
        start = stop + ahead
        if start >= path.duration or not np.isfinite(when):
            break
        jumps.append(done)
    return HeadPath(np.concatenate(times), np.concatenate(poses)), np.array(jumps)


PAPER_CIRCUITS = "CCCAAACACA"
"""Circuits of the protocol of Salman & Pearson 2016, III-C."""
POSE_STEP = 0.005
"""Distance between the poses at which whiskers at rest must be free, m; turns count too."""


class MazeConfig(Settings):
    """A micromouse maze, random or from a text file."""

    columns: Annotated[int, Field(ge=2, le=64)] = 7
    """Cells from west to east; 7 x 5 cells fit the 1.35 m x 1 m of the paper."""
    rows: Annotated[int, Field(ge=2, le=64)] = 5
    """Cells from south to north."""
    loop: Annotated[int, Field(ge=1, le=4096)] = 20
    """Length of the open loop for circuits, cells."""
    kind: Literal["loop", "tree", "table"] = "loop"
    """`loop`: an open loop, and each other wall with the probability `share`; `tree`: one way between each
    two cells, no loops; `table`: no walls but the rim's, and objects, each of one cell. The last two are to
    explore."""
    share: Annotated[float, Field(ge=0, le=1)] = 0.6
    """Probability of each wall between cells outside the loop, or share of the cells that are objects."""
    file: File | None = None
    """A maze file to use instead: posts `o` or `+`, walls `---` and `|`."""
    heights: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (WALL_HEIGHT,)
    """Wall heights, m, chosen at random for each wall; posts have the largest."""
    seed: NonNegativeInt | None = None
    """Seed of the maze; null: that of the simulation."""
    added: tuple[tuple[Cell, Cell], ...] = ()
    """Walls to put up afterwards, each between two neighbouring cells: a maze that has changed since."""
    removed: tuple[tuple[Cell, Cell], ...] = ()
    """Walls to take away afterwards, likewise."""

    @model_validator(mode="after")
    def _one_height(self) -> MazeConfig:
        if (self.added or self.removed) and len(self.heights) > 1:
            cause = "several are drawn in order of the walls"
            raise ValueError(f"added and removed walls need one height; {cause}")
        return self


class PathConfig(Settings):
    """Route of the head: circuits, free exploration or given cells."""

    circuits: str = PAPER_CIRCUITS
    """One letter per circuit: C clockwise seen from above, A anticlockwise; '' for none."""
    explore: Annotated[float, Field(ge=0, le=100_000)] = 0.0
    """Duration of a free exploration instead, from the first cell of the loop, s."""
    start: NonNegativeInt = 0
    """Number of the cell of the loop, counted anticlockwise from its first, at which circuits or an
    exploration start."""
    within: tuple[Cell, ...] = ()
    """Cells that an exploration may enter, the first of them its start; empty: all."""
    cells: tuple[Cell, ...] = ()
    """Cells (column, row), counted from the south-west, to visit instead, in order."""
    loop: tuple[Cell, ...] = ()
    """Cells of the loop for circuits in a maze from a file; a random maze has its own loop."""

    @model_validator(mode="after")
    def _one(self) -> PathConfig:
        if "circuits" not in self.model_fields_set and (self.explore or self.cells):
            self.__dict__["circuits"] = ""  # the default applies only without explore and cells
        given = [name for name in ("circuits", "explore", "cells") if getattr(self, name)]
        if len(given) != 1:
            there = " and ".join(given) or "none"
            raise ValueError(f"{there} of circuits, explore and cells; give exactly one")
        if self.cells and self.start:
            raise ValueError("start: cells begin at their first one")
        if self.within and (self.start or not self.explore):
            raise ValueError("within: it is for an exploration, and its first cell is the start")
        return self


class KidnapConfig(Settings):
    """Kidnaps: jumps of the head along its path that its odometry does not measure, evenly spread over the
    last three quarters of the session."""

    count: NonNegativeInt = 0
    """Number of kidnaps."""
    ahead: PositiveFloat = 45.0
    """Length of a jump as duration of the path, s."""


class Scene(NamedTuple):
    """Attributes:
    maze: the maze. loop: its cells in anticlockwise order, empty without a loop.
    path: poses of the head. duration: of the session, s. jumps: [J] times of the kidnaps, s.
    surroundings: walls for contact queries.
    """

    maze: Maze
    loop: list[Cell]
    path: HeadPath
    duration: float
    jumps: np.ndarray
    surroundings: Surroundings


def make_scene(
    maze_config: MazeConfig,
    path_config: PathConfig,
    motion: MotionConfig,
    kidnaps: KidnapConfig,
    head: Head,
    seed: int,
) -> Scene:
    """The scene of a session.

    Raises:
        InputError: a gap in the outer wall, a path through walls, a whisker at rest inside one, walls higher
            than the head, or a path too short for the kidnaps.
    """
    maze, loop = make_maze(maze_config, path_config, seed)
    carriage = kidnaps.count * kidnaps.ahead
    explored = path_config.explore + carriage if path_config.explore else 0.0
    way = _plan_route(path_config, maze, loop, explored, motion, seed)
    path = plan_path(motion, way, stream(seed, "motion"))
    duration = path_config.explore or path.duration - carriage
    if duration <= 0:
        found = f"{kidnaps.count} times {kidnaps.ahead:g} s ahead"
        raise InputError("simulation.kidnaps", found, f"less than {path.duration:.4g} s, the whole path")
    jumps = np.zeros(0)
    if kidnaps.count:
        when = np.linspace(0.25, 0.95, kidnaps.count) * duration
        path, jumps = add_kidnaps(path, when.tolist(), kidnaps.ahead)
    boxes = wall_boxes(maze, stream(maze_seed(maze_config, seed), "maze.heights"), maze_config.heights)
    return Scene(maze, loop, path, duration, jumps, _check_surroundings(boxes, head, path))


def other_surroundings(scene: Scene, config: MazeConfig, head: Head, seed: int) -> Surroundings:
    """Walls of another maze of the same size, checked along the same path."""
    columns, rows = scene.maze.columns, scene.maze.rows
    seed = maze_seed(config, seed)
    maze = _draw_walls(config, columns, rows, scene.loop, stream(seed, "later.walls"))
    boxes = wall_boxes(maze, stream(seed, "later.heights"), config.heights)
    return _check_surroundings(boxes, head, scene.path)


def _check_surroundings(boxes: Walls, head: Head, path: HeadPath) -> Surroundings:
    """Walls for contact queries, after checking that no whisker at rest is inside a wall along the path."""
    hangs, tallest = float(head.base[:, 2].min()), float(boxes.height.max())
    if tallest >= hangs:
        expected = f"less than {hangs:g} m, the height of the head"
        raise InputError("simulation.maze.heights", f"a wall of {tallest:g} m", expected)
    surroundings = Surroundings(boxes, head)
    if tip_height(head, np.zeros(len(head.length))).min() > tallest:
        return surroundings  # at rest, whiskers are above all walls
    # Times (s) along a path with a motion of at most `POSE_STEP` in between.
    step = np.abs(np.diff(path.pose, axis=0))
    parts = np.ceil((np.hypot(step[:, 0], step[:, 1]) + TURN_LENGTH * step[:, 2]) / POSE_STEP)
    parts = np.maximum(parts, 1).astype(int)
    ends = zip(path.time[:-1], path.time[1:], parts, strict=True)
    time = np.concatenate([*(np.linspace(a, b, n, endpoint=False) for a, b, n in ends), path.time[-1:]])
    pose = poses_at(path, time)
    met = surroundings.contact(pose)
    inside = met.angle <= 0
    if inside.any():
        row, whisker = (int(k) for k in np.argwhere(inside)[0])
        cell = tuple(int(k) for k in np.floor(pose[row, :2] / CELL_SIDE))
        box = describe_box(boxes, int(met.wall[row, whisker]))
        found = f"at {time[row]:.1f} s, in cell {cell}, whisker {whisker} at rest is inside {box}"
        cure = "lower the walls, or raise the head (touch.head.rings)"
        raise InputError("simulation.path", found, "whiskers at rest without contact", cure)
    return surroundings


def maze_info(maze: Maze, config: MazeConfig, seed: int) -> MazeInfo:
    """The maze of a session with this seed, for the `SourceInfo` of its source."""
    return MazeInfo(text=maze_text(maze), heights=config.heights, seed=maze_seed(config, seed))


def maze_seed(config: MazeConfig, seed: int) -> int:
    return seed if config.seed is None else config.seed


def make_maze(config: MazeConfig, path: PathConfig, seed: int) -> tuple[Maze, list[Cell]]:
    """The maze of a session with this seed, and its loop in anticlockwise order, empty without one.

    Raises:
        InputError: the maze or its loop is not possible, or the path needs a loop and there is none.
    """
    seed = maze_seed(config, seed)
    loop: list[Cell] = []
    columns, rows = config.columns, config.rows
    empty = Maze(np.zeros((rows + 1, columns), bool), np.zeros((rows, columns + 1), bool))
    maze = read_maze(config.file) if config.file else empty
    if path.loop:
        check_route(maze, [*path.loop, path.loop[0]], "simulation.path.loop")
        loop = make_anticlockwise(path.loop)
    if config.file:
        if path.circuits and not loop:
            cure = "set the loop, or explore instead of circuits"
            expected = "the cells of a loop in the maze"
            raise InputError("simulation.path.loop", "circuits without a loop", expected, cure)
    else:
        if config.kind != "loop" and (path.circuits or loop):
            cure = "explore, or use `simulation.maze.kind: loop`"
            raise InputError("simulation.path", "circuits in a maze without loops", "an exploration", cure)
        if config.kind == "loop" and not loop:
            loop = random_loop(columns, rows, config.loop, stream(seed, "maze.loop"))
        maze = _draw_walls(config, columns, rows, loop, stream(seed, "maze.walls"))
    return change_walls(maze, config.added, config.removed), loop


def _draw_walls(
    config: MazeConfig, columns: int, rows: int, loop: list[Cell], random: np.random.Generator
) -> Maze:
    if config.kind == "tree":
        return tree_maze(columns, rows, random)
    if config.kind == "table":
        return table_maze(columns, rows, config.share, random)
    return random_maze(columns, rows, loop, config.share, random)


def _plan_route(
    config: PathConfig, maze: Maze, loop: list[Cell], explored: float, motion: MotionConfig, seed: int
) -> list[Cell]:
    if config.start:
        if config.start >= len(loop):
            expected = f"less than {len(loop)}, the cells of the loop"
            raise InputError("simulation.path.start", str(config.start), expected)
        loop = loop[config.start :] + loop[: config.start]
    if config.circuits:
        way = circuit_route(loop, config.circuits)
    elif config.cells:
        way = list(config.cells)
        if len(way) < 2:
            raise InputError("simulation.path.cells", "one cell", "at least two")
    else:
        cells = int(1.2 * explored * motion.speed / CELL_SIDE) + 20  # upper limit for that time
        first = [*config.within, *loop, (0, 0)][0]
        way = exploration_route(maze, first, cells, stream(seed, "path"), config.within)
    check_route(maze, way)
    return way
