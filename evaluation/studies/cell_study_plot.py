"""Plots of a study of many networks: a score over the parameters, and rate maps of chosen sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from evaluation.plots import style
from evaluation.plots.cell_plot import draw_rate_map
from evaluation.plots.style import BLUE, LABEL_GREY, WIDTH

_PANEL, _GAP_ACROSS, _GAP_UP = 1.9, 0.62, 0.75  # inches: height of a panel, between panels
_COLUMNS = 3
_MAP_GAP = 0.12  # inches between rate maps


class MapRow(NamedTuple):
    """The rate maps of one network. name: of the row. maps: [C, H, W] mean activity, NaN where never."""

    name: str
    maps: np.ndarray


def draw_scores(
    title: str, line: str, parameters: Mapping[str, np.ndarray], score: np.ndarray, label: str
) -> style.Figure:
    """Draws a score [B] against each parameter [B], a point for each network.

    Args:
        parameters: by label with unit. score: on a logarithmic axis if positive. label: with unit.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    size = float(np.clip(40 / np.sqrt(len(score)), 4, 10))
    rows = -(-len(parameters) // _COLUMNS)
    height = style.TOP + rows * (_PANEL + _GAP_UP)
    figure = style.new_figure(height, title, line)
    width = (WIDTH - style.LEFT - style.RIGHT - (_COLUMNS - 1) * _GAP_ACROSS) / _COLUMNS
    for k, (name, values) in enumerate(parameters.items()):
        row, column = divmod(k, _COLUMNS)
        left = style.LEFT + column * (width + _GAP_ACROSS)
        bottom = height - style.TOP - _PANEL - row * (_PANEL + _GAP_UP)
        axes = style.add_axes(figure, left, bottom, width, _PANEL)
        axes.plot(values, score, ".", color=BLUE, ms=size, mew=0, alpha=0.6)
        axes.grid(color=style.LINE_GREY, lw=0.7)
        if score.min() > 0:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=30))
            axes.yaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))
            axes.set_ylim(0.5 * score.min(), 2 * score.max())
        axes.locator_params(axis="x", nbins=4)
        axes.ticklabel_format(axis="x", style="sci", scilimits=(-3, 4))
        style.name_axes(axes, name, label if column == 0 else "")
    return figure


def draw_rate_maps(
    title: str, line: str, rows: Sequence[MapRow], x_edges: np.ndarray, y_edges: np.ndarray
) -> style.Figure:
    """Draws the rate maps of networks, a row for each and a column for each cell; each map has a colour scale
    of its own, from 0 to the value above it.

    Args:
        x_edges, y_edges: [W + 1], [H + 1] edges of the place bins, m.
    """
    columns = max(len(row.maps) for row in rows)
    side = (WIDTH - style.LEFT - style.RIGHT - (columns - 1) * _MAP_GAP) / columns
    step = side + 0.5
    height = style.TOP + len(rows) * step + 0.1
    figure = style.new_figure(height, title, line)
    for k, row in enumerate(rows):
        bottom = height - style.TOP - side - 0.18 - k * step
        for column, rates in enumerate(row.maps):
            axes = style.add_axes(figure, style.LEFT + column * (side + _MAP_GAP), bottom, side, side)
            draw_rate_map(axes, rates, x_edges, y_edges)
            axes.set_title(f"{np.nanmax(rates):.2g}", fontsize=7, color=LABEL_GREY, pad=2)
        figure.text(
            0.5 * style.LEFT / WIDTH, (bottom + side / 2) / height, row.name, rotation=90, fontsize=9,
            ha="center", va="center", color=style.INK,
        )  # fmt: skip
    return figure
