"""Reads the g2o files that the package writes."""

from pathlib import Path

import numpy as np

from ratslam.mapping.pose_graph import UPPER, Edges


def read_g2o(path: Path) -> tuple[np.ndarray, Edges]:
    """Poses [N, 3] of the vertices 0 to N - 1, and edges with information [E, 3, 3]."""
    lines = [line.split() for line in path.read_text().splitlines()]
    poses = np.array([line[2:] for line in lines if line[0] == "VERTEX_SE2"], float).reshape(-1, 3)
    rows = np.array([line[1:] for line in lines if line[0] == "EDGE_SE2"], float).reshape(-1, 11)
    information = np.zeros((len(rows), 3, 3))
    for k, (a, b) in enumerate(UPPER):
        information[:, a, b] = information[:, b, a] = rows[:, 5 + k]
    return poses, Edges(*rows[:, :2].astype(int).T, rows[:, 2:5], information)
