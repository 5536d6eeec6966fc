"""Maps written and read back."""

from __future__ import annotations

import networkx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.pose_graph import Edges, read_json, write_g2o, write_json
from tactile.base.errors import InputError
from tests.helpers.g2o import read_g2o

FINITE = st.floats(allow_nan=False, allow_infinity=False)


def example(seed=0):
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(6, 3, 3))
    i, j = np.arange(6), np.array([1, 2, 3, 4, 0, 2])
    return rng.normal(size=(7, 3)), Edges(i, j, rng.normal(size=(6, 3)), half + np.swapaxes(half, 1, 2))


@given(values=st.lists(FINITE, min_size=9, max_size=9))
def test_g2o_reads_back_exactly(values, tmp_path_factory):
    """Every finite float survives, bit for bit."""
    path = tmp_path_factory.mktemp("g2o") / "map.g2o"
    values = np.array(values)
    poses = np.stack([values[:3], values[3:6]])
    write_g2o(path, poses, Edges(np.array([0]), np.array([1]), values[None, 6:], np.ones((1, 3))))
    again, edges = read_g2o(path)
    assert again.tobytes() == poses.tobytes()
    assert edges.motion.tobytes() == values[None, 6:].tobytes()
    assert (edges.information == np.eye(3)).all()


def test_g2o_keeps_full_information(tmp_path):
    """All six entries of an information matrix are read back at their places."""
    poses, edges = example()
    write_g2o(tmp_path / "map.g2o", poses, edges)
    again, read = read_g2o(tmp_path / "map.g2o")
    assert (again == poses).all()
    for ours, theirs in zip(edges, read, strict=True):
        assert (ours == theirs).all()


def graph():
    made = networkx.DiGraph()
    made.add_node(0, x=0.1, y=1 / 3, heading=-1e-300, template=4)
    made.add_node(1, x=1.0, y=2.0, heading=3.0, template=0)
    made.add_edge(0, 1, dx=0.1, dy=2 / 3, dtheta=0.0, traversals=2, length=1.5, duration=3.0, closure=True)
    return made


def test_json_reads_back_exactly(tmp_path):
    """Ids, numbers, flags and directions all survive."""
    write_json(tmp_path / "map.json", graph())
    again = read_json(tmp_path / "map.json")
    assert isinstance(again, networkx.DiGraph)
    assert dict(again.nodes(data=True)) == dict(graph().nodes(data=True))
    assert list(again.edges(data=True)) == list(graph().edges(data=True))


def test_the_same_map_is_the_same_bytes(tmp_path):
    """Written, read and written again: nothing changes."""
    a, b, c = (tmp_path / name for name in "abc")
    write_g2o(a, *example())
    write_g2o(b, *example())
    write_g2o(c, *read_g2o(a))
    assert a.read_bytes() == b.read_bytes() == c.read_bytes()
    write_json(a, graph())
    write_json(b, graph())
    write_json(c, read_json(a))
    assert a.read_bytes() == b.read_bytes() == c.read_bytes()


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "3", '{"nodes": 3, "edges": []}', '{"nodes": [{}]}'])
def test_files_that_are_not_graphs_are_refused(tmp_path, text):
    """The error names the file."""
    path = tmp_path / "map.json"
    path.write_text(text)
    with pytest.raises(InputError) as raised:
        read_json(path)
    assert raised.value.where.startswith(str(path))
