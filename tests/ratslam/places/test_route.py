"""Ways over the experience graph: the laws of a shortest way, in both modes."""

from itertools import pairwise

import networkx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.places import route as routes
from ratslam.places.route import NoWay, Travel, find_way, nearest_experience, position, travel_graph
from tactile.base.se2 import segment_distances

TRAVEL = Travel(speed=0.05, turn_rate=0.5, turn_radius=0.02)


def random_map(seed: int, count: int = 12) -> networkx.DiGraph:
    """Experiences at random, linked in a ring and at random."""
    random = np.random.default_rng(seed)
    graph = networkx.DiGraph()
    for k in range(count):
        x, y, heading = random.uniform([0, 0, -np.pi], [1, 1, np.pi]).tolist()
        graph.add_node(k, x=x, y=y, heading=heading)
    links = [random.choice(count, 2, replace=False).tolist() for _ in range(count)]
    for a, b in [*((k, (k + 1) % count) for k in range(count)), *links]:
        graph.add_edge(a, b, traversals=int(random.integers(1, 6)))
    return graph


def line_map(*headings: float, spacing: float = 0.1) -> networkx.DiGraph:
    """Experiences on a line, each linked to the next."""
    graph = networkx.DiGraph()
    for k, heading in enumerate(headings):
        graph.add_node(k, x=spacing * k, y=0.0, heading=heading)
    graph.add_edges_from(pairwise(range(len(headings))), traversals=1)
    return graph


@given(st.integers(0, 1000), st.integers(0, 11), st.integers(0, 11))
@settings(max_examples=25)
def test_no_other_path_is_expected_to_take_less_time_and_temporal_maps_are_descended(seed, start, goal):
    graph = travel_graph(random_map(seed), TRAVEL)
    way = find_way(graph, start, [goal])
    other = networkx.all_simple_paths(graph, start, goal, cutoff=4)
    costs = [sum(graph.edges[pair]["expected"] for pair in pairwise(path)) for path in other]
    assert way.expected <= min(costs, default=np.inf) + 1e-9
    assert way.expected == pytest.approx(find_way(graph, goal, [start]).expected), "symmetric"
    assert (way.experiences[0], way.experiences[-1]) == (start, goal)
    assert all(graph.has_edge(*pair) for pair in pairwise(way.experiences))
    assert len(way.poses) == len(way.experiences)
    way = find_way(graph, start, [goal], "temporal")
    left = networkx.single_source_dijkstra_path_length(graph, goal, weight="seconds")
    times = [left[place] for place in way.experiences]
    assert way.experiences[-1] == goal
    assert all(later < before for before, later in pairwise(times))
    for place, following in pairwise(way.experiences):
        assert left[following] == min(left[near] for near in graph[place])
    assert way.seconds >= left[start] - 1e-9


@given(st.integers(0, 1000))
@settings(max_examples=25)
def test_no_way_passes_an_obstacle(seed):
    experiences, standoff = random_map(seed), 0.05
    obstacle = np.random.default_rng(seed).uniform(0, 1, (2, 2))
    graph, free = travel_graph(experiences, TRAVEL, obstacle, standoff), travel_graph(experiences, TRAVEL)
    ends = np.array([[position(free, a), position(free, b)] for a, b in free.edges()])
    clear = segment_distances(obstacle, ends[:, 0], ends[:, 1]).min(axis=0) >= standoff
    assert set(graph.edges()) == {link for link, keep in zip(free.edges(), clear, strict=True) if keep}


def test_a_trusted_link_is_preferred_and_the_robot_turns_where_experiences_of_one_piece_share_a_place():
    graph = line_map(0.0, 0.0, 0.0)
    graph.add_node(3, x=0.1, y=0.0, heading=0.0)
    graph.add_edge(0, 3, traversals=9)
    graph.add_edge(3, 2, traversals=9)
    assert find_way(travel_graph(graph, TRAVEL), 0, [2]).experiences == (0, 3, 2)
    way = find_way(travel_graph(graph, TRAVEL), 0, [3])
    assert way.seconds == pytest.approx(0.1 / TRAVEL.speed)
    assert way.expected == pytest.approx(way.seconds * 11 / 10)
    graph = line_map(0.0, 0.0, np.pi, np.pi)
    graph.nodes[2]["x"], graph.nodes[3]["x"] = 0.11, 0.01
    made = travel_graph(graph, TRAVEL)
    assert find_way(made, 0, [3]).experiences == (0, 3)
    assert made.edges[0, 3]["seconds"] == pytest.approx(np.pi / TRAVEL.turn_rate)
    assert routes.experiences_near(made, 0, 0.02) == [0, 3]
    assert nearest_experience(travel_graph(networkx.DiGraph(), TRAVEL), np.zeros(2), np.inf) is None
    assert nearest_experience(made, np.array([0.0, 0.0, 3.0]), 0.1, heading_radius=0.2) == 3


def test_pieces_are_not_joined_even_where_they_overlap():
    graph = networkx.disjoint_union(line_map(0.0, 0.0), line_map(0.0, 0.0))
    with pytest.raises(NoWay, match="experience 3 is in piece 1 and experience 0 in piece 0"):
        find_way(travel_graph(graph, TRAVEL), 0, [3])
    wall = np.array([[0.05, 0.0]])
    with pytest.raises(NoWay, match="every way from experience 0 to experience 1 is blocked"):
        find_way(travel_graph(graph, TRAVEL, wall, 0.02), 0, [1])
    with pytest.raises(KeyError, match="no experience 9"):
        find_way(travel_graph(graph, TRAVEL), 0, [9])
