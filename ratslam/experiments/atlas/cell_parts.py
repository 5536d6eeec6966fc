"""Connected parts of a maze as sets of cells."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import networkx
import numpy as np

from robot.world.maze import CELL_SIDE, Cell, Maze, cell_centre, is_open, neighbours
from tactile.base.errors import InputError

TRIES = 1000
"""Largest number of random parts that are drawn until some fit."""
SMALLEST = 4
"""Fewest cells of a part."""


class TwoParts(NamedTuple):
    """Two lists of cells of a maze, each connected, in order of growth."""

    one: tuple[Cell, ...]
    other: tuple[Cell, ...]


def maze_graph(maze: Maze, start: Cell) -> networkx.Graph:
    """The cells that can be reached from `start`, with an edge between neighbours without a wall."""
    graph: networkx.Graph = networkx.Graph()
    edge = [start]
    graph.add_node(start)
    while edge:
        here = edge.pop()
        for cell in neighbours(maze, here):
            if cell not in graph:
                edge.append(cell)
            graph.add_edge(here, cell)
    return graph


def grow_part(
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


def overlapping_parts(graph: networkx.Graph, random: np.random.Generator) -> TwoParts:
    """Two connected parts of equal size that share half the cells of each, as large as they are found to fit.

    Raises:
        InputError: the graph has no room for two parts of `SMALLEST` cells.
    """
    cells = sorted(graph)
    for half in range(len(cells) // 3, SMALLEST // 2 - 1, -1):
        for _ in range(TRIES):
            first = cells[int(random.integers(len(cells)))]
            shared = grow_part(graph, [first], half - 1, (), random)
            one = shared and grow_part(graph, shared, half, (), random)
            other = one and shared and grow_part(graph, shared, half, one[half:], random)
            if one and other:
                return TwoParts(tuple(one), tuple(other))
    raise InputError("simulation.maze", f"{len(cells)} cells", "room for two parts that overlap")


def separate_parts(graph: networkx.Graph, random: np.random.Generator) -> TwoParts:
    """Two connected parts without a common cell that hold all cells: a random spanning tree, divided at the
    edge that leaves the parts most equal.

    Raises:
        InputError: the smaller part has fewer than `SMALLEST` cells in each of `TRIES` trees.
    """
    for _ in range(TRIES):
        tree = networkx.random_spanning_tree(graph, seed=int(random.integers(1 << 31)))
        sizes = {edge: _side(tree, edge) for edge in sorted(map(tuple, map(sorted, tree.edges)))}
        side = min(sizes.values(), key=lambda part: abs(2 * len(part) - len(graph)))
        rest = sorted(set(graph) - side)
        if min(len(side), len(rest)) >= SMALLEST:
            return TwoParts(tuple(sorted(side)), tuple(rest))
    raise InputError("simulation.maze", f"{len(graph)} cells", "room for two separate parts")


def _side(tree: networkx.Graph, edge: tuple[Cell, Cell]) -> set[Cell]:
    """The cells on the first cell's side of an edge of a tree."""
    without = networkx.restricted_view(tree, [], [edge])
    return set(networkx.node_connected_component(without, edge[0]))


def entrance(maze: Maze, part: Collection[Cell], outside: Collection[Cell]) -> list[tuple[Cell, Cell]]:
    """Pairs of an outside cell and a cell of the part that no wall separates, in order."""
    return sorted((a, b) for a in outside for b in neighbours(maze, a) if b in part)


def wall_middle(a: Cell, b: Cell) -> np.ndarray:
    """[2] middle of the wall between two neighbouring cells, m."""
    return (cell_centre(a) + cell_centre(b)) / 2


def walls_beside(maze: Maze, loop: Sequence[Cell], there: bool) -> list[tuple[Cell, Cell]]:
    """Pairs of neighbouring cells with (or without) a wall between them, the first on the loop, but not the
    steps of the loop."""
    steps = {frozenset(step) for step in zip(loop, [*loop[1:], loop[0]], strict=True)}
    pairs = []
    for x, y in loop:
        for b in ((x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)):
            inside = 0 <= b[0] < maze.columns and 0 <= b[1] < maze.rows
            known = (b, (x, y)) in pairs or frozenset(((x, y), b)) in steps
            if inside and not known and is_open(maze, (x, y), b) != there:
                pairs.append(((x, y), b))
    return pairs


def cells_of(poses: np.ndarray) -> list[Cell]:
    """The cell of each pose [T, 3]."""
    return [(int(x), int(y)) for x, y in np.floor(poses[:, :2] / CELL_SIDE)]
