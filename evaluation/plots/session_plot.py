"""Plot of a map that was merged of several sessions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.metrics.map_pieces import arrange_pieces
from evaluation.metrics.run_arrays import RunArrays
from evaluation.plots import style
from evaluation.plots.map_plot import NAMED, PIECES
from evaluation.plots.style import GREEN


def draw_sessions(title: str, path: np.ndarray, piece: np.ndarray, steps: Sequence[int]) -> style.Figure:
    """Draws the paths of the sessions of a merged map, each in a colour of its own; pieces that nothing joins
    beside each other.

    Args:
        path: [T, 3] poses of all steps in the map, m, m, rad. piece: [T] the piece of each. steps: number of
            steps of each session, in the order of `path`.
    """
    shown = _beside_each_other(path, piece)
    pieces, largest = len(np.unique(piece)), int(np.bincount(piece).argmax())
    joined = "joined" if pieces == 1 else f"{pieces} pieces"
    line = f"{len(steps)} sessions, {len(path)} steps  ·  {joined}"
    of = style.MAP if pieces == 1 else f"piece {largest + 1}, the largest"
    figure, axes = style.map_figure(style.frame(shown), title, line, of)
    ends = np.cumsum(steps).tolist()
    for number, (count, end) in enumerate(zip(steps, ends, strict=True)):
        own = slice(end - count, end)
        parted = np.flatnonzero(np.diff(piece[own])) + 1  # no line from one piece to the next
        drawn = np.insert(shown[own], parted, np.nan, axis=0)
        colour = PIECES[min(number, NAMED)]
        axes.plot(
            *drawn.T, color=colour, lw=0.9, alpha=0.8, zorder=3, label=f"map {number + 1}, {count} steps"
        )
        label = "start" if number == 0 else "_"
        axes.plot(*shown[end - count], "o", ms=8, mfc="none", mec=GREEN, mew=1.6, zorder=4, label=label)
    style.add_legend(figure, axes)
    return figure


def _beside_each_other(path: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """[T, 2] positions with the pieces where pictures show them."""
    none, count = np.zeros(0, int), len(path)
    run = RunArrays(
        time=np.arange(float(count)), truth=None, online=path, final=path, odometry=path,
        experience=np.full(count, -1), created=none, nodes=np.zeros((0, 3)), links=np.zeros((0, 2), int),
        piece=piece,
    )  # fmt: skip
    return arrange_pieces(run).final[:, :2]
