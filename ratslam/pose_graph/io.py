"""Pose graphs as g2o files, and graphs as node-link JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ratslam.pose_graph.edges import Edges, information_matrices
from tactile.base import bounded
from tactile.base.bounded import read_text
from tactile.base.errors import InputError

if TYPE_CHECKING:
    import networkx

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


def read_g2o(path: Path) -> tuple[np.ndarray, Edges]:
    """Reads poses [N, 3] in order of id, and edges with information [E, 3, 3]; ignores other lines.

    Raises:
        InputError: a malformed line, or an edge to an unknown vertex.
    """
    poses: dict[int, list[float]] = {}
    rows: list[tuple[int, int, list[float]]] = []
    for number, line in enumerate(read_text(path, "a graph (.g2o)").splitlines(), start=1):
        word, *cells = line.split() or [""]
        try:
            if word == "VERTEX_SE2":
                node, values = int(cells[0]), [float(cell) for cell in cells[1:]]
                _expect(len(values) == 3)
                poses[node] = values
            elif word == "EDGE_SE2":
                i, j, values = int(cells[0]), int(cells[1]), [float(cell) for cell in cells[2:]]
                _expect(len(values) == 9)
                rows.append((i, j, values))
        except (ValueError, IndexError):
            raise InputError(
                f"{path}:{number}",
                repr(line),
                "VERTEX_SE2 id x y th, or EDGE_SE2 i j x y th and 6 information entries",
            ) from None
    row = {node: k for k, node in enumerate(sorted(poses))}
    unknown = next((node for i, j, _ in rows for node in (i, j) if node not in row), None)
    if unknown is not None:
        raise InputError(
            str(path), f"an edge to node {unknown}, which has no vertex", "a VERTEX_SE2 line for every node"
        )
    measured = np.array([values for _, _, values in rows]).reshape(-1, 9)
    information = np.zeros((len(rows), 3, 3))
    for k, (a, b) in enumerate(UPPER):
        information[:, a, b] = information[:, b, a] = measured[:, 3 + k]
    start = np.array([row[i] for i, _, _ in rows], int)
    end = np.array([row[j] for _, j, _ in rows], int)
    return np.array([poses[node] for node in row]).reshape(-1, 3), Edges(
        start, end, measured[:, :3], information
    )


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

    def parse(content: Any) -> networkx.DiGraph:
        try:
            return networkx.DiGraph(networkx.node_link_graph(content, edges="edges"))
        except networkx.NetworkXException as error:
            raise ValueError(str(error)) from None

    return bounded.read_json(path, "a map.json written by ratslam", parse)


def _floats(values) -> str:
    return " ".join(repr(float(value)) for value in values)


def _expect(right: bool) -> None:
    if not right:
        raise ValueError
