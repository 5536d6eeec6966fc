"""Ways over the experience graph of a map, by expected time or by RatSLAM's goal temporal map.

Assumption: the robot drives backwards and turns on the spot. It takes the poses of the experiences, so a link
is used in either direction (backwards with the heading in which it was driven), and where two experiences of
one piece stand within `turn_radius` of each other it may turn from one to the other. A robot that only drives
forwards must not use these ways.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from tactile.base.se2 import segment_distances, wrap

if TYPE_CHECKING:
    import networkx

Mode = Literal["time", "temporal"]
LEAST_SECONDS = 1e-6
"""Least duration of a link: times to the goal fall strictly along a way."""


class Travel(NamedTuple):
    """How the robot travels.

    Attributes:
        speed: m/s. turn_rate: rad/s. turn_radius: largest distance of two experiences between which it turns
            without a link, m; less than half the width of what separates two corridors.
    """

    speed: float = 0.03
    turn_rate: float = 0.4
    turn_radius: float = 0.03


class Way(NamedTuple):
    """A way over experiences.

    Attributes:
        experiences: [K] from start to goal. poses: [K, 3] of them (m, m, rad). length: m. seconds: of the
            motion. expected: seconds with the trust in each link.
    """

    experiences: tuple[int, ...]
    poses: np.ndarray
    length: float
    seconds: float
    expected: float


class NoWay(Exception):
    """No way joins two experiences: they are in different pieces, or every way between them is blocked."""


def travel_graph(
    experiences: networkx.DiGraph, travel: Travel, obstacles: np.ndarray | None = None, standoff: float = 0.0
) -> networkx.Graph:
    """The graph of travel: an edge for each link, in both directions, and for each turn on the spot.

    Edges carry `length` (m), `seconds` of the motion, in which the robot moves and turns at once, and the
    `expected` seconds: a link driven n times is passable with probability (n + 1) / (n + 2) (Laplace's rule
    of succession), and the expected time is seconds / probability; a turn without a link has n = 0. Nodes
    carry x, y, heading and `piece`: connected by links, numbered in the order of their first experiences.

    Args:
        experiences: as `KeyframeMap.graph`. obstacles: [n, 2] points in the map, m; links that pass within
            `standoff` (m) of one are left out.
    """
    import networkx  # slow to import

    graph: networkx.Graph = networkx.Graph()
    for place, data in sorted(experiences.nodes(data=True)):
        graph.add_node(place, x=data["x"], y=data["y"], heading=data["heading"])
    for a, b, data in experiences.edges(data=True):
        known = graph.edges[a, b]["traversals"] if graph.has_edge(a, b) else 0
        graph.add_edge(a, b, traversals=known + data["traversals"])
    for number, piece in enumerate(sorted(networkx.connected_components(graph), key=min)):
        for place in piece:
            graph.nodes[place]["piece"] = number
    # Turns on the spot between experiences of one piece that stand together and have no link.
    numbers = list(graph.nodes())
    if len(numbers) > 1:
        tree = cKDTree(np.array([position(graph, number) for number in numbers]))
        for i, j in sorted(tree.query_pairs(travel.turn_radius)):
            a, b = numbers[i], numbers[j]
            if graph.nodes[a]["piece"] == graph.nodes[b]["piece"] and not graph.has_edge(a, b):
                graph.add_edge(a, b, traversals=0)
    for a, b, data in graph.edges(data=True):
        one, other, traversals = graph.nodes[a], graph.nodes[b], data["traversals"]
        length = float(np.hypot(one["x"] - other["x"], one["y"] - other["y"]))
        turn = abs(float(wrap(one["heading"] - other["heading"])))
        seconds = max(length / travel.speed, turn / travel.turn_rate, LEAST_SECONDS)
        expected = seconds * (traversals + 2) / (traversals + 1)
        data |= {"length": length, "seconds": seconds, "expected": expected}
    if obstacles is not None and len(obstacles):
        links = list(graph.edges())
        ends = np.array([[position(graph, a), position(graph, b)] for a, b in links]).reshape(-1, 2, 2)
        near = segment_distances(obstacles, ends[:, 0], ends[:, 1]).min(axis=0) < standoff
        graph.remove_edges_from([link for link, blocked in zip(links, near, strict=True) if blocked])
    return graph


def find_way(graph: networkx.Graph, start: int, goals: Sequence[int], mode: Mode = "time") -> Way:
    """The way from an experience to one of some others.

    `time`: the least expected time (Dijkstra). `temporal`: RatSLAM's rule (Milford & Wyeth 2010, III-F: the
    goal temporal map): each experience gets its least duration to a goal over the links, and from each the
    way goes on to the neighbour that is nearest to a goal in time. A map keeps no times of travel; the
    duration of a link is that of its motion.

    Raises:
        NoWay: nothing joins them. KeyError: there is no such experience.
    """
    import networkx

    for place in (start, *goals):
        if place not in graph:
            raise KeyError(f"the map has no experience {place}")
    # From the goals: the edges have no direction.
    weight = "expected" if mode == "time" else "seconds"
    left: dict[int, float]
    left, ways = networkx.multi_source_dijkstra(graph, set(goals), weight=weight)  # type: ignore[assignment]
    if start not in left:
        goal, here = goals[0], graph.nodes[start]["piece"]
        there = graph.nodes[goal]["piece"]
        if here != there:
            raise NoWay(f"experience {goal} is in piece {there} and experience {start} in piece {here}")
        raise NoWay(f"every way from experience {start} to experience {goal} is blocked")
    experiences = ways[start][::-1]
    if mode == "temporal":  # from each to the neighbour with the least time to a goal
        experiences = [start]
        while left[experiences[-1]] > 0:
            neighbours = graph[experiences[-1]]
            experiences.append(min(neighbours, key=lambda place: (left[place], place)))
    links = [graph.edges[pair] for pair in pairwise(experiences)]
    nodes = [graph.nodes[place] for place in experiences]
    poses = np.array([[node["x"], node["y"], node["heading"]] for node in nodes])
    total = [float(sum(link[name] for link in links)) for name in ("length", "seconds", "expected")]
    return Way(tuple(experiences), poses, *total)


def experiences_near(graph: networkx.Graph, place: int, radius: float) -> list[int]:
    """An experience, and the others of its piece within a distance (m), at any heading."""
    here, piece = np.array(position(graph, place)), graph.nodes[place]["piece"]
    others = [other for other in graph if other != place and graph.nodes[other]["piece"] == piece]
    near = (other for other in others if np.hypot(*(np.array(position(graph, other)) - here)) <= radius)
    return [place, *near]


def nearest_experience(
    graph: networkx.Graph, place: np.ndarray, farthest: float, heading_radius: float | None = None
) -> int | None:
    """The experience nearest to a point [2] or pose [3]; None if none is within `farthest`, m.

    Args:
        heading_radius: distance (m) that a difference in heading of 1 rad counts for, with a pose; None:
            headings do not count.
    """
    numbers = list(graph.nodes())
    if not numbers:
        return None
    apart = np.array([position(graph, number) for number in numbers]) - place[:2]
    far = np.hypot(*apart.T)
    counted = far
    if heading_radius is not None:
        turn = wrap(np.array([graph.nodes[number]["heading"] for number in numbers]) - place[2])
        counted = far + heading_radius * np.abs(turn)
    counted = np.where(far <= farthest, counted, np.inf)
    best = int(np.argmin(counted))
    return numbers[best] if np.isfinite(counted[best]) else None


def position(graph: networkx.Graph, place: int) -> tuple[float, float]:
    """x and y of an experience, m."""
    node = graph.nodes[place]
    return node["x"], node["y"]
