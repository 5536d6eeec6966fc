"""Pose graphs as g2o files, and graphs as node-link JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ratslam.mapping.edges import Edges, information_matrices
from tactile.base.bounded import SPOILT, malformed, read_text

if TYPE_CHECKING:
    import networkx

EXPECTED = "a map.json written by ratslam"
UPPER = tuple(zip(*np.triu_indices(3), strict=True))


def write_g2o(path: Path, poses: np.ndarray, edges: Edges, fixed: Sequence[int] = ()) -> None:
    """Writes VERTEX_SE2 and EDGE_SE2 lines, and FIX lines for the vertices `fixed`; floats are exact (repr),
    so equal graphs give equal bytes."""
    lines = [f"VERTEX_SE2 {k} {_floats(pose)}" for k, pose in enumerate(poses)]
    lines += [f"FIX {k}" for k in fixed]
    information = information_matrices(edges.information)
    for i, j, motion, weight in zip(edges.i, edges.j, edges.motion, information, strict=True):
        lines.append(f"EDGE_SE2 {int(i)} {int(j)} {_floats(motion)} {_floats(weight[k] for k in UPPER)}")
    Path(path).write_text("".join(line + "\n" for line in lines), encoding="utf-8")


def write_json(path: Path, graph: networkx.DiGraph) -> None:
    """Writes node-link JSON, which `networkx.node_link_graph` reads."""
    import networkx  # slow to import

    content = networkx.node_link_data(graph, edges="edges")
    Path(path).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> networkx.DiGraph:
    """Reads a node-link JSON file.

    Raises:
        InputError: the file is not node-link JSON.
    """
    import networkx  # slow to import

    with malformed(path, EXPECTED, spoilt=(*SPOILT, networkx.NetworkXException)):
        content = json.loads(read_text(path, EXPECTED))
        return networkx.DiGraph(networkx.node_link_graph(content, edges="edges"))


def _floats(values) -> str:
    return " ".join(repr(float(value)) for value in values)
