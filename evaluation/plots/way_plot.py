"""Plot of a way over the experiences of a map."""

from __future__ import annotations

import numpy as np

from evaluation.plots import style
from evaluation.plots.style import BLUE, GREEN, GREY, INK, VERMILLION


def draw_way(
    title: str, line: str, nodes: np.ndarray, links: np.ndarray, way: np.ndarray, felt: np.ndarray
) -> style.Figure:
    """Draws experiences, their links, contacts felt beside them and the way.

    Args:
        line: subtitle. nodes: [N, 2] experiences, m. links: [L, 2] their indices. way: [K, 3] poses of the
            way, K >= 1 (m, m, rad). felt: [n, 2] contacts in the map, m; may be empty.
    """
    from matplotlib.collections import LineCollection

    box = style.frame(np.concatenate([nodes, felt, way[:, :2]]))
    figure, axes = style.map_figure(box, title, line, style.MAP)
    if len(felt):
        axes.plot(*felt.T, ".", color=GREY, ms=2.2, mew=0, zorder=1, label="contact felt")
    if len(links):
        axes.add_collection(
            LineCollection(list(nodes[links]), colors=BLUE, lw=0.7, alpha=0.55, zorder=2, label="link")
        )
    axes.plot(*nodes.T, "o", color=BLUE, ms=2.4, mew=0, zorder=3, label="experience")
    axes.plot(*way[:, :2].T, color=VERMILLION, lw=3.2, solid_capstyle="round", zorder=4, label="way")
    axes.plot(*way[0, :2], "o", ms=9, mfc="white", mec=GREEN, mew=2.2, ls="none", zorder=5, label="start")
    axes.plot(*way[-1, :2], "*", ms=15, color=INK, mec="white", mew=0.8, ls="none", zorder=5, label="goal")
    style.add_legend(figure, axes, columns=6)
    return figure
