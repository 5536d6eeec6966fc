"""Plots of occupancy maps: one with its paths, or several side by side.

Bright cells are occupied, as in the figures of Fox et al. 2012, on a fixed scale from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.occupancy_score import MAIN_CONVENTION, GridScore
from evaluation.plots import style
from evaluation.plots.style import GREEN, INK, LABEL_GREY, VERMILLION, WIDTH, YELLOW

NO_SEGMENTS = np.zeros((0, 4))

_SKY = "#56b4e9"  # Okabe and Ito's light blue, for lines on a dark background
_PALE = "#c9c9c9"
_KEY, _BAR = 0.72, 0.15  # inches: right of the maps, and width of the colour bar
_HEAD, _GAP, _BOTTOM = 0.48, 0.42, 1.0  # inches above a small map, between two, and below all


class GridPanel(NamedTuple):
    """A map to draw.

    Attributes:
        name: title. line: subtitle with its metrics. segments: [S, 4] true walls, m. paths: of a run, [T, 2]
            or [T, 3] each, m: the true path, which may have NaN rows, online poses of the filter, and dead
            reckoning.
    """

    name: str
    line: str
    grid: OccupancyGrid
    segments: np.ndarray = NO_SEGMENTS
    paths: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


def draw_grid(panel: GridPanel) -> style.Figure:
    """Draws one map with its walls and paths (Fox et al. 2012, Fig. 6)."""
    inner = style.INNER - _KEY
    tall = inner * _aspect(panel.grid)
    figure, axes = style.new_chart(tall, _BOTTOM, panel.name, panel.line, right=_KEY)
    _paint(axes, panel, errors=True)
    _paint_key(figure, style.LEFT + inner, _BOTTOM, min(tall, 2.4))
    return style.add_legend(figure, axes, columns=3)


def draw_grids(title: str, line: str, panels: Sequence[GridPanel], *, across: int = 3) -> style.Figure:
    """Draws maps side by side, `across` per row (Fox et al. 2012, Figs. 4 and 5)."""
    across = min(across, len(panels))
    rows = -(-len(panels) // across)
    inner = style.INNER - _KEY
    width = (inner - (across - 1) * _GAP) / across
    high = width * max(_aspect(panel.grid) for panel in panels)
    whole = style.TOP + rows * (_HEAD + high) + (rows - 1) * _GAP + _BOTTOM
    figure = style.new_figure(whole, title, line)
    for number, panel in enumerate(panels):
        row, column = divmod(number, across)
        left = style.LEFT + column * (width + _GAP)
        top = whole - style.TOP - row * (_HEAD + high + _GAP) - _HEAD
        tall = width * _aspect(panel.grid)
        axes = style.add_axes(figure, left, top - tall, width, tall)
        _paint(axes, panel)
        if column:
            axes.set_ylabel("")
            if axes.get_ylim() == figure.axes[-2].get_ylim():
                axes.set_yticklabels([])
        if number + across < len(panels):
            axes.set_xlabel("")
        axes.tick_params(labelsize=7.5)
        figure.text(left / WIDTH, (top + 0.24) / whole, panel.name, fontsize=9.5, color=INK)
        figure.text(left / WIDTH, (top + 0.08) / whole, panel.line, fontsize=8, color=LABEL_GREY)
    _paint_key(figure, style.LEFT + inner, whole - style.TOP - _HEAD - high, min(high, 2.4))
    fullest = max(figure.axes, key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    return style.add_legend(figure, fullest, columns=5)


def grid_headline(score: GridScore) -> str:
    """The main quantities in one line."""
    error, found = score.under(MAIN_CONVENTION), score.quantities
    parts = [f"map error (eq. 6) {error.error:.3f} (constant map {error.prior:.3f})"]
    skill, auc = found["map_brier_skill"].value, found["map_auc"].value
    ways = found["map_chamfer_map"].value, found["map_chamfer_walls"].value
    parts += [] if skill is None else [f"Brier skill {skill:.2f}"]
    parts += [] if auc is None else [f"wall AUC {auc:.2f}"]
    parts += [] if None in ways else [f"Chamfer {ways[0]:.3f} and {ways[1]:.3f} m"]
    return "  ·  ".join(parts)


def _aspect(grid: OccupancyGrid) -> float:
    height, width = grid.probability.shape
    return height / width


def _paint(axes: style.Axes, panel: GridPanel, *, errors: bool = False) -> None:
    """Draws the map, the walls and the paths in the order of the legend, which has their `errors`."""
    grid, (height, width) = panel.grid, panel.grid.probability.shape
    left, bottom = (float(value) for value in grid.origin)
    right, top = left + width * grid.cell, bottom + height * grid.cell
    axes.imshow(
        grid.probability, cmap="gray", vmin=0, vmax=1, origin="lower", extent=(left, right, bottom, top),
        interpolation="nearest", zorder=0.5,
    )  # fmt: skip
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", autoscale_on=False)
    style.metre_grid(axes, style.MAP)
    axes.grid(visible=False)
    axes.tick_params(axis="x", pad=6)  # clear of the lowest tick label of the other axis
    if len(panel.segments):
        walls = panel.segments.reshape(-1, 2, 2)
        style.add_lines(axes, walls, VERMILLION, lw=1.0, zorder=2, label="true walls")
    if panel.paths is None:
        return
    truth, estimate, odometry = (np.asarray(path)[:, :2] for path in panel.paths)

    def name(word: str, path: np.ndarray) -> str:
        away = np.hypot(*(path - truth).T)
        known = errors and np.isfinite(away).any()
        return f"{word}, mean error {float(np.nanmean(away)):.3f} m" if known else word

    dashed = (0, (4, 2))
    axes.plot(*odometry.T, color=_PALE, lw=0.8, ls=dashed, zorder=3, label=name("odometry", odometry))
    axes.plot(*truth.T, color=YELLOW, lw=2.4, alpha=0.8, zorder=4, label="truth")
    axes.plot(*estimate.T, color=_SKY, lw=1.0, zorder=5, label=name("online path", estimate))
    start = truth[np.isfinite(truth).all(axis=1)]
    if len(start):
        axes.plot(*start[0], "o", ms=9, mfc="none", mec=GREEN, mew=1.8, zorder=6, label="start")


def _paint_key(figure: style.Figure, left: float, bottom: float, tall: float) -> None:
    """Draws the grey scale of occupancy right of a map, in inches."""
    box, shades = (left + 0.2, bottom, _BAR, tall), np.linspace(0, 1, 256)[:, None]
    bar = style.add_scale(figure, box, shades, 1.0, "occupancy", 9)
    bar.set_yticks([0, 0.3, 0.5, 1.0])
    bar.tick_params(labelsize=7.5)
