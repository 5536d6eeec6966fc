"""Pieces of a map: connected components of its keyframes."""

from __future__ import annotations

import networkx
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.keyframe_graph import number_pieces

law = settings(derandomize=True, deadline=None, max_examples=100)


@st.composite
def maps(draw):
    """Cuts [N] and closures [M, 2]."""
    count = draw(st.integers(1, 30))
    frame = st.integers(0, count - 1)
    cut = np.array([False, *draw(st.lists(st.booleans(), min_size=count - 1, max_size=count - 1))])
    closures = draw(st.lists(st.tuples(frame, frame), max_size=12))
    return cut, np.array(closures, int).reshape(-1, 2)


@law
@given(maps())
def test_pieces_are_the_connected_components_in_order(found):
    cut, closures = found
    graph = networkx.Graph()
    graph.add_nodes_from(range(len(cut)))
    graph.add_edges_from((k - 1, k) for k in np.flatnonzero(~cut).tolist() if k)
    graph.add_edges_from(closures.tolist())
    piece = number_pieces(cut, closures)
    components = sorted(networkx.connected_components(graph), key=min)
    assert [set(np.flatnonzero(piece == k).tolist()) for k in range(len(components))] == components


@law
@given(maps())
def test_a_map_without_cuts_is_one_piece(found):
    cut, closures = found
    assert (number_pieces(np.zeros_like(cut), closures) == 0).all()


@law
@given(maps())
def test_a_closure_joins_at_most_two_pieces(found):
    cut, closures = found
    before = number_pieces(cut, closures[:-1]).max()
    assert before - 1 <= number_pieces(cut, closures).max() <= before


def test_a_map_without_keyframes_has_no_pieces():
    assert number_pieces(np.zeros(0, bool), np.zeros((0, 2), int)).tolist() == []
