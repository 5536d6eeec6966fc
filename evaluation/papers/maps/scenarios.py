"""Sessions of one maze, each derived from the seed of the maze alone, as recipes that are recorded on demand.

The map is that of ten circuits of the touch table. Later sessions have random streams of their own: another
calibration of the odometry, other noise, another start.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from hashlib import sha256
from typing import Any, NamedTuple

import networkx
import numpy as np

from evaluation.papers.tables.touch_table import KIDNAPS, MAIN, touch_config
from evaluation.papers.trial_sessions import collect_session
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import InMemorySource, cut_log
from robot.world.maze import CELL_SIDE, Cell, Maze, cell_centre, exploration_route
from robot.world.scene import PAPER_CIRCUITS, MazeConfig, PathConfig, make_maze
from tactile.base.errors import InputError
from tactile.base.random_streams import stream


class Recipe(NamedTuple):
    """How a session is made: a configuration, and the steps of its source from `first` up to but without
    `last` (None: to the end)."""

    config: RunConfig
    first: int = 0
    last: int | None = None

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the recipe."""
        text = f"{self.config.model_dump_json()} {self.first} {self.last}"
        return sha256(text.encode()).hexdigest()


class Recorded(NamedTuple):
    """A recorded session.

    Attributes:
        config: completed by its source. log: of observations, with the true pose of each step, rows of NaN
            where it is not known.
    """

    config: RunConfig
    log: InMemorySource

    @property
    def truth(self) -> np.ndarray:
        """[T, 3] true poses (m, m, rad), NaN where unknown."""
        assert self.log.truth is not None
        return self.log.truth


def record(recipe: Recipe) -> Recorded:
    """The session of a recipe; the same recipe gives the same bits.

    Raises:
        InputError: the source cannot be read or simulated, or has no true poses.
    """
    config, log = collect_session(recipe.config, every=recipe.config.simulation is not None)
    return Recorded(config, cut_log(log, recipe.first, recipe.last))


LOCALISED = 120
"""Length of a session that starts somewhere in a known maze, whisks."""
FOREIGN = 300
"""Length of a session in another maze, whisks."""
REENTERED = 60
"""Time for which a session that was carried stays in the known part, whisks."""
PART = 150
"""Length of an exploration of a part of a maze, in steps from cell to cell; about 1000 whisks."""
LEAD = 4
"""Largest number of unknown cells before a known part."""
NEAR_WALL = 2.0
"""Largest distance over which a wall is moved, in cells."""
AFTER = "CAAC"
"""Circuits of a session in a changed maze."""

TRIES = 1000
"""Largest number of random parts that are drawn until some fit."""
SMALLEST = 4
"""Fewest cells of a part."""


_Parts = tuple[tuple[Cell, ...], tuple[Cell, ...]]
"""Two lists of cells of a maze, each connected, in order of growth."""


def _maze_graph(maze: Maze, loop: Sequence[Cell]) -> networkx.Graph:
    """The cells that can be reached from a loop, with an edge between neighbours without a wall."""
    graph: networkx.Graph = networkx.Graph()
    edge = [loop[0]]
    graph.add_node(loop[0])
    while edge:
        here = edge.pop()
        for cell in maze.neighbours(here):
            if cell not in graph:
                edge.append(cell)
            graph.add_edge(here, cell)
    return graph


def _grow_part(
    graph: networkx.Graph,
    part: Sequence[Cell],
    count: int,
    avoid: Collection[Cell],
    random: np.random.Generator,
) -> list[Cell] | None:
    """A connected part with `count` further cells, none of `avoid`, each a random neighbour of those before;
    None if it has no room."""
    grown = list(part)
    for _ in range(count):
        rim = sorted({b for a in grown for b in graph[a] if b not in grown and b not in avoid})
        if not rim:
            return None
        grown.append(rim[int(random.integers(len(rim)))])
    return grown


def _overlapping_parts(graph: networkx.Graph, random: np.random.Generator) -> _Parts:
    """Two connected parts of equal size that share half the cells of each, as large as they are found to fit.

    Raises:
        InputError: the graph has no room for two parts of `SMALLEST` cells.
    """
    cells = sorted(graph)
    for half in range(len(cells) // 3, SMALLEST // 2 - 1, -1):
        for _ in range(TRIES):
            first = cells[int(random.integers(len(cells)))]
            shared = _grow_part(graph, [first], half - 1, (), random)
            one = shared and _grow_part(graph, shared, half, (), random)
            other = one and shared and _grow_part(graph, shared, half, one[half:], random)
            if one and other:
                return tuple(one), tuple(other)
    raise InputError("simulation.maze", f"{len(cells)} cells", "room for two parts that overlap")


def _separate_parts(graph: networkx.Graph, random: np.random.Generator) -> _Parts:
    """Two connected parts without a common cell that hold all cells: a random spanning tree, divided at the
    edge that leaves the parts most equal.

    Raises:
        InputError: the smaller part has fewer than `SMALLEST` cells in each of `TRIES` trees.
    """
    for _ in range(TRIES):
        tree = networkx.random_spanning_tree(graph, seed=int(random.integers(1 << 31)))
        sides = []  # the cells on the first cell's side of each edge
        for edge in sorted(map(tuple, map(sorted, tree.edges))):
            without = networkx.restricted_view(tree, [], [edge])
            sides.append(set(networkx.node_connected_component(without, edge[0])))
        side = min(sides, key=lambda part: abs(2 * len(part) - len(graph)))
        rest = sorted(set(graph) - side)
        if min(len(side), len(rest)) >= SMALLEST:
            return tuple(sorted(side)), tuple(rest)
    raise InputError("simulation.maze", f"{len(graph)} cells", "room for two separate parts")


def _wall_middle(a: Cell, b: Cell) -> np.ndarray:
    """[2] middle of the wall between two neighbouring cells, m."""
    return (cell_centre(a) + cell_centre(b)) / 2


def _walls_beside(maze: Maze, loop: Sequence[Cell], there: bool) -> list[tuple[Cell, Cell]]:
    """Pairs of neighbouring cells with (or without) a wall between them, the first on the loop, but not the
    steps of the loop."""
    steps = {frozenset(step) for step in zip(loop, [*loop[1:], loop[0]], strict=True)}
    pairs = []
    for x, y in loop:
        for b in ((x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)):
            inside = 0 <= b[0] < maze.columns and 0 <= b[1] < maze.rows
            known = (b, (x, y)) in pairs or frozenset(((x, y), b)) in steps
            if inside and not known and maze.is_open((x, y), b) != there:
                pairs.append(((x, y), b))
    return pairs


def open_world(maze: int) -> tuple[Maze, list[Cell]]:
    """The unchanged maze of a seed, and its loop in anticlockwise order."""
    return make_maze(MazeConfig(seed=maze), PathConfig(), maze)


def ten_circuits(maze: int) -> Recipe:
    """The session that makes the map: that of the row `main` of the touch table."""
    return Recipe(touch_config(maze, maze % 100, MAIN))


def unknown_start(maze: int, whisks: int = LOCALISED, name: str = "start") -> Recipe:
    """A session in the same maze from another cell of the loop or between two, one way round or the other.

    Args:
        name: of its random streams; a further name gives a further session.
    """
    random = stream(maze, f"atlas.{name}.route")
    number = int(random.integers(1, len(open_world(maze)[1])))
    letter = "CA"[int(random.integers(2))]
    first = int(random.integers(8))  # a cell takes about 6 whisks, and a turn up to 4
    path = {"circuits": 3 * letter, "start": number}
    return Recipe(_later(maze, name, {"path": path}), first, first + whisks)


def same_maze(maze: int, number: int) -> Recipe:
    """Ten circuits in the same maze, number 0 those of the map, others from another cell of the loop."""
    if number == 0:
        return ten_circuits(maze)
    name = f"again {number}"
    start = int(stream(maze, f"atlas.{name}.route").integers(len(open_world(maze)[1])))
    return Recipe(_later(maze, name, {"path": {"circuits": PAPER_CIRCUITS, "start": start}}))


def overlapping_sessions(maze: int) -> tuple[Recipe, Recipe, Recipe]:
    """Explorations of two parts that share half their cells, and one as long as both together over both."""
    world, loop = open_world(maze)
    one, other = _overlapping_parts(_maze_graph(world, loop), stream(maze, "atlas.overlap.parts"))
    return (
        _explore_all(maze, world, "overlap one", one, PART),
        _explore_all(maze, world, "overlap other", other, PART),
        _explore_all(maze, world, "overlap both", tuple(dict.fromkeys(one + other)), 2 * PART),
    )


def carried_sessions(maze: int) -> tuple[Recipe, Recipe, Recipe, int]:
    """An exploration of one half of a maze; then the robot is carried to a known and to an unknown place.

    Returns:
        first: explores the known part. known: enters it, after up to `LEAD` cells of the other one, and stays
        there for `REENTERED` whisks. unknown: stays in the other part. The first step of `known` in the known
        part.
    """
    random = stream(maze, "atlas.carried.parts")
    world, loop = open_world(maze)
    parts = _separate_parts(_maze_graph(world, loop), random)
    if random.integers(2):
        parts = parts[::-1]
    way = _enter(world, parts, random)
    config = _later(maze, "carried known", {"path": {"cells": way}})
    truth = record(Recipe(config)).truth
    cells = map(tuple, np.floor(truth[:, :2] / CELL_SIDE).astype(int).tolist())
    entry = next((step for step, cell in enumerate(cells) if cell in parts[0]), len(truth))
    path = {"explore": float(LOCALISED), "within": _turned(parts[1], random)}
    return (
        _explore_all(maze, world, "carried first", parts[0], PART),
        Recipe(config, 0, entry + REENTERED),
        Recipe(_later(maze, "carried unknown", {"path": path})),
        entry,
    )


def moved_wall(maze: int) -> tuple[Recipe, np.ndarray]:
    """Circuits after a wall beside the loop has been taken away and put up at another place beside it; the
    middles [2, 2] of both places, m.

    Raises:
        InputError: no wall beside the loop has a gap beside the loop near it.
    """
    random = stream(maze, "atlas.wall")
    world, loop = open_world(maze)
    walls, gaps = (_walls_beside(world, loop, there) for there in (True, False))
    moves = [
        (wall, gap)
        for wall in walls
        for gap in gaps
        if np.hypot(*(_wall_middle(*wall) - _wall_middle(*gap))) <= NEAR_WALL * CELL_SIDE
    ]
    if not moves:
        raise InputError("simulation.maze", f"maze {maze} has no gap near a wall", "one beside the loop")
    wall, gap = moves[int(random.integers(len(moves)))]
    start = int(random.integers(len(loop)))
    settings = {"maze": {"added": [gap], "removed": [wall]}, "path": {"circuits": AFTER, "start": start}}
    places = np.array([_wall_middle(*wall), _wall_middle(*gap)])
    return Recipe(_later(maze, "wall moved", settings)), places


def closed_door(maze: int) -> tuple[Recipe, np.ndarray]:
    """A session after the loop has been closed between two cells: up to the door, back, all the way round to
    its other side, and so on, from a random cell; the middle [1, 2] of the door, m."""
    random = stream(maze, "atlas.door")
    _, loop = open_world(maze)
    shut = int(random.integers(len(loop)))
    line = [*loop[shut:], *loop[:shut]]  # from one side of the door to the other
    start = int(random.integers(1, len(line) - 1))
    way = [*line[start:], *line[-2::-1], *line[1:], *line[-2:0:-1]]
    settings = {"maze": {"added": [(line[0], line[-1])]}, "path": {"cells": way}}
    return Recipe(_later(maze, "door", settings)), _wall_middle(line[0], line[-1])[None]


def kidnapped(maze: int) -> Recipe:
    """Ten circuits with eight kidnaps: the row `kidnaps` of the touch table."""
    return Recipe(touch_config(maze, maze % 100, KIDNAPS, keyframes={"may_be_carried": True}))


def _later(maze: int, name: str, settings: dict[str, Any]) -> RunConfig:
    """The configuration of a further session of the maze; those of different names are independent."""
    seed = int(stream(maze, f"atlas.{name}").integers(1 << 31))
    return touch_config(maze, seed, MAIN | settings)


def _explore_all(seed: int, maze: Maze, name: str, cells: tuple[Cell, ...], steps: int) -> Recipe:
    """A session that enters each of these cells and no other, from a random one on.

    Raises:
        InputError: none of `TRIES` random routes enters all.
    """
    random = stream(seed, f"atlas.{name}.route")
    for _ in range(TRIES):
        start = cells[int(random.integers(len(cells)))]
        way = exploration_route(maze, start, steps, random, cells)
        if set(way) == set(cells):
            return Recipe(_later(seed, name, {"path": {"cells": way}}))
    raise InputError("simulation.path.cells", f"no route of {steps} cells", f"one through {len(cells)} cells")


def _turned(cells: tuple[Cell, ...], random: np.random.Generator) -> tuple[Cell, ...]:
    """The cells from a random one on, which is where an exploration starts."""
    first = int(random.integers(len(cells)))
    return cells[first:] + cells[:first]


def _enter(maze: Maze, parts: _Parts, random: np.random.Generator) -> list[Cell]:
    """A route of 0 to `LEAD` unknown cells and then known ones, longer than `REENTERED` whisks there."""
    lead, cells = int(random.integers(LEAD + 1)), REENTERED // 4
    if not lead:
        start = _turned(parts[0], random)[0]
        return exploration_route(maze, start, cells, random, parts[0])
    # Pairs of an outside cell and a cell of the part that no wall separates, in order.
    doors = sorted((a, b) for a in parts[1] for b in maze.neighbours(a) if b in parts[0])
    outside, inside = doors[int(random.integers(len(doors)))]
    before = exploration_route(maze, outside, lead, random, parts[1])[::-1] if lead > 1 else [outside]
    return [*before, *exploration_route(maze, inside, cells, random, parts[0])]
