"""Where a simulated robot goes: a maze, a way through it, and how the head moves along."""

from __future__ import annotations

from pathlib import Path as File
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from robot.sources.source_info import MazeInfo
from robot.world.head_trajectory import HeadPath, MotionConfig, add_kidnaps, plan_path, poses_at
from robot.world.maze import (
    CELL_SIDE,
    WALL_HEIGHT,
    Cell,
    Maze,
    closed_maze,
    describe_box,
    maze_text,
    random_loop,
    random_maze,
    read_maze,
    wall_boxes,
)
from robot.world.maze_routes import check_route, circuit_route, exploration_route, make_anticlockwise
from robot.world.walls import Surroundings, Walls
from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.whiskers.head_geometry import Head, tip_points

PAPER_CIRCUITS = "CCCAAACACA"
"""Seed 2's protocol (Salman & Pearson 2016, III-C)."""
POSE_STEP = 0.005
"""Distance (m) between the poses at which whiskers at rest must be free; turns count 10 cm for each rad."""


class MazeConfig(Settings):
    """A micromouse maze, from a seed or from a text file."""

    columns: Annotated[int, Field(ge=2, le=64)] = 7
    """Cells from west to east; with the rows below it fits the paper's 1.35 m x 1 m."""
    rows: Annotated[int, Field(ge=2, le=64)] = 5
    """Cells from south to north."""
    loop: PositiveInt = 20
    """Cells of the loop that is open for circuits."""
    share: Annotated[float, Field(ge=0, le=1)] = 0.6
    """Of walls that stand between cells, but for the loop."""
    file: File | None = None
    """A text file to take the maze from instead: posts `o` or `+`, walls `---` and `|`."""
    heights: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (WALL_HEIGHT,)
    """Of walls, m; each wall has one of them by chance, posts have the largest."""
    seed: NonNegativeInt | None = None
    """Of the maze; the simulation's own where there is none."""


class PathConfig(Settings):
    """Where the head goes: circuits, or free exploration, or given cells."""

    circuits: str = PAPER_CIRCUITS
    """A letter for each time around the loop: C clockwise seen from above, A anticlockwise; '' for none."""
    explore: NonNegativeFloat = 0.0
    """Seconds of free exploration instead, from the first cell of the loop."""
    cells: tuple[Cell, ...] = ()
    """Cells (column, row), counted from the south-west, to go through instead, in order."""
    loop: tuple[Cell, ...] = ()
    """Cells of the loop that circuits go around, for a maze from a file; else one is made."""

    @model_validator(mode="after")
    def _one(self) -> PathConfig:
        if "circuits" not in self.model_fields_set and (self.explore or self.cells):
            self.__dict__["circuits"] = ""  # they are what is done when nothing else is asked for
        asked = [name for name in ("circuits", "explore", "cells") if getattr(self, name)]
        if len(asked) != 1:
            there = " and ".join(asked) or "none"
            raise ValueError(f"{there} of circuits, explore and cells; give exactly one")
        return self


class KidnapConfig(Settings):
    """Times at which the head is carried along its path unknown to its odometry, over the last three quarters
    of the session."""

    count: NonNegativeInt = 0
    """How often."""
    ahead: PositiveFloat = 45.0
    """How far, seconds of the path."""


class Scene(NamedTuple):
    """Attributes:
    maze, loop: the world; the loop is anticlockwise, empty where there is none.
    path: the head's way. duration: how much of it is the session, s. jumps: [J] s, when it was carried.
    surroundings: what whiskers may meet.
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
    """The scene of a seed.

    Raises:
        InputError: a maze that leaks, a path through walls, a whisker at rest inside one, walls higher than
            the head hangs, or kidnaps that the path is too short for.
    """
    maze, loop = _world(maze_config, path_config, seed)
    carriage = kidnaps.count * kidnaps.ahead
    explored = path_config.explore + carriage if path_config.explore else 0.0
    way = _way(path_config, maze, loop, explored, motion, seed)
    path = plan_path(motion, way, stream(seed, "motion"))
    duration = path_config.explore or path.duration - carriage
    if duration <= 0:
        raise InputError(
            "simulation.kidnaps",
            f"{kidnaps.count} times {kidnaps.ahead:g} s ahead",
            f"less than {path.duration:.4g} s, the whole path",
        )
    jumps = np.zeros(0)
    if kidnaps.count:
        when = np.linspace(0.25, 0.95, kidnaps.count) * duration
        path, jumps = add_kidnaps(path, when.tolist(), kidnaps.ahead)
    boxes = wall_boxes(maze, stream(_maze_seed(maze_config, seed), "maze.heights"), maze_config.heights)
    surroundings = check_surroundings(boxes, head, path)
    return Scene(maze, loop, path, duration, jumps, surroundings)


def other_surroundings(scene: Scene, config: MazeConfig, head: Head, seed: int) -> Surroundings:
    """What whiskers meet along the same path in another maze of the same size."""
    columns, rows = scene.maze.columns, scene.maze.rows
    maze = random_maze(
        columns, rows, scene.loop, config.share, stream(_maze_seed(config, seed), "later.walls")
    )
    boxes = wall_boxes(maze, stream(_maze_seed(config, seed), "later.heights"), config.heights)
    return check_surroundings(boxes, head, scene.path)


def check_surroundings(boxes: Walls, head: Head, path: HeadPath) -> Surroundings:
    """The walls, checked: along the path, no whisker at rest is inside one of them.

    Raises:
        InputError: naming time, cell, whisker and wall; or walls that are higher than the head hangs.
    """
    hangs, tallest = float(head.base[:, 2].min()), float(boxes.height.max())
    if tallest >= hangs:
        raise InputError(
            "simulation.maze.heights",
            f"a wall of {tallest:g} m",
            f"less than {hangs:g} m, where the head hangs",
        )
    surroundings = Surroundings(boxes, head)
    if tip_points(head, np.zeros(len(head.length)))[:, 2].min() > tallest:
        return surroundings  # at rest, whiskers are above everything
    time = _finely(path)
    pose = poses_at(path, time)
    met = surroundings.contact(pose)
    inside = met.angle <= 0
    if inside.any():
        row, whisker = (int(k) for k in np.argwhere(inside)[0])
        cell = tuple(int(k) for k in np.floor(pose[row, :2] / CELL_SIDE))
        raise InputError(
            "simulation.path",
            f"at {time[row]:.1f} s, in cell {cell}, whisker {whisker} at rest is inside "
            f"{describe_box(boxes, int(met.wall[row, whisker]))}",
            "whiskers that start free",
            "lower the walls, or hang the head higher (touch.head.rings)",
        )
    return surroundings


def maze_info(maze: Maze, config: MazeConfig, seed: int) -> MazeInfo:
    """The maze of a session with that seed, as its source states it."""
    return MazeInfo(text=maze_text(maze), heights=config.heights, seed=_maze_seed(config, seed))


def _maze_seed(config: MazeConfig, seed: int) -> int:
    return seed if config.seed is None else config.seed


def _world(config: MazeConfig, path: PathConfig, seed: int) -> tuple[Maze, list[Cell]]:
    seed = _maze_seed(config, seed)
    loop: list[Cell] = []
    maze = read_maze(config.file) if config.file else closed_maze(config.columns, config.rows)
    if path.loop:
        empty = Maze(np.zeros_like(maze.across), np.zeros_like(maze.along))
        check_route(maze if config.file else empty, [*path.loop, path.loop[0]], "simulation.path.loop")
        loop = make_anticlockwise(path.loop)
    if config.file:
        if path.circuits and not loop:
            raise InputError(
                "simulation.path.loop",
                "circuits without a loop",
                "the cells of a loop in the maze",
                "give them, or explore",
            )
        return maze, loop
    loop = loop or random_loop(config.columns, config.rows, config.loop, stream(seed, "maze.loop"))
    return random_maze(config.columns, config.rows, loop, config.share, stream(seed, "maze.walls")), loop


def _way(
    config: PathConfig, maze: Maze, loop: list[Cell], explored: float, motion: MotionConfig, seed: int
) -> list[Cell]:
    if config.circuits:
        way = circuit_route(loop, config.circuits)
    elif config.cells:
        way = list(config.cells)
        if len(way) < 2:
            raise InputError("simulation.path.cells", "one cell", "at least two")
    else:
        cells = int(1.2 * explored * motion.speed / CELL_SIDE) + 20  # more than can be reached by then
        way = exploration_route(maze, loop[0] if loop else (0, 0), cells, stream(seed, "path"))
    check_route(maze, way)
    return way


def _finely(path: HeadPath) -> np.ndarray:
    """Times (s) along a path between which it moves by `POSE_STEP` at most."""
    step = np.abs(np.diff(path.pose, axis=0))
    parts = np.maximum(np.ceil((np.hypot(step[:, 0], step[:, 1]) + 0.1 * step[:, 2]) / POSE_STEP), 1).astype(
        int
    )
    ends = zip(path.time[:-1], path.time[1:], parts, strict=True)
    return np.concatenate([*(np.linspace(a, b, n, endpoint=False) for a, b, n in ends), path.time[-1:]])
