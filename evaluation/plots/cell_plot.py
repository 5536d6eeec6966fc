"""Plots of recorded pose cells: rate maps, heading tuning, spikes on the path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from evaluation.cells.information import information
from evaluation.cells.rate_map import known_poses, rate_maps, recorded_sums, tuning_curves
from evaluation.cells.recording import BinnedSums, CellRecording
from evaluation.plots import style
from evaluation.plots.style import BLUE, GREY, INK, LABEL_GREY, VERMILLION
from tactile.base.errors import InputError

if TYPE_CHECKING:  # it loads parts of SciPy that a run needs late or never
    from evaluation.cells.cell_comparison import ComparedScore

MOST = 12
"""Largest number of cells in a plot of a run."""
_COLUMNS, _GAP = 6, 0.14  # panels in a row; inches between them
_SIDE = (style.INNER - (_COLUMNS - 1) * _GAP) / _COLUMNS  # of a map, inches
_DIAL = 0.62 * _SIDE  # of a tuning curve, inches
_LABEL = 0.5  # inches above a map


def choose_cells(recording: CellRecording, most: int = MOST) -> tuple[BinnedSums, np.ndarray]:
    """The sums of up to `most` recorded cells and their indices in the flattened network: of the more active
    half of the chosen ones, or of all cells if only sums were recorded, evenly spread over their indices.

    Raises:
        InputError: no cells were recorded, no pose is known or the path has no area.
    """
    sums, cell = recorded_sums(recording)
    total = sums.place.sum(axis=(1, 2))
    active = np.sort(np.argsort(-total, kind="stable")[: -(-len(cell) // 2)])
    chosen = active[np.unique(np.linspace(0, len(active) - 1, most).round().astype(int))]
    return sums._replace(place=sums.place[chosen], heading=sums.heading[chosen]), cell[chosen]


def draw_cells(title: str, sums: BinnedSums, cell: np.ndarray) -> style.Figure:
    """Draws the rate map of each `cell` [n], with its spatial information and its peak, and below it its
    activity over heading.

    Raises:
        InputError: no bin was visited long enough.
    """
    rates, tuning = rate_maps(sums), tuning_curves(sums)
    step = _LABEL + _SIDE + _DIAL + 0.1
    height = style.TOP + -(-len(cell) // _COLUMNS) * step + 0.1
    wide = float(sums.x_edges[-1] - sums.x_edges[0])
    line = f"activity over {wide:.3g} m of true places, dark 0 to yellow its own peak, and over true heading"
    line += "; peak: share of all"
    figure = style.new_figure(height, title, line)
    bits = information(rates, sums.seconds)
    for k in range(len(cell)):
        row, column = divmod(k, _COLUMNS)
        left, bottom = style.LEFT + column * (_SIDE + _GAP), height - style.TOP - _LABEL - _SIDE - row * step
        axes = style.add_axes(figure, left, bottom, _SIDE, _SIDE)
        draw_rate_map(axes, rates[k], sums.x_edges, sums.y_edges)
        peak = np.nanmax(rates[k])
        said = f"{bits[k]:.2f} bits/spike\npeak {peak:.2g}" if peak > 0 else "silent"
        label = f"cell {cell[k]}\n{said}"
        axes.set_title(label, fontsize=7, color=LABEL_GREY, pad=2, linespacing=1.15)
        dial = left + (_SIDE - _DIAL) / 2, bottom - _DIAL - 0.06
        draw_tuning(style.add_dial(figure, *dial, _DIAL), tuning[k])
    return figure


def draw_recorded_cells(title: str, recording: CellRecording) -> style.Figure:
    """Draws `choose_cells` of a recording; of one from which no map can be made, the reason."""
    try:
        return draw_cells(title, *choose_cells(recording))
    except InputError as error:
        return style.new_figure(style.TOP, title, f"no rate maps: {error}")


def draw_rate_map(axes: style.Axes, rates: np.ndarray, x_edges: np.ndarray, y_edges: np.ndarray) -> None:
    """Draws a rate map [H, W] into axes, in colours from 0 to its peak; NaN stay white."""
    extent = (x_edges[0], x_edges[-1], y_edges[0], y_edges[-1])
    peak = float(np.nanmax(rates))
    axes.imshow(rates, origin="lower", extent=extent, cmap="viridis", vmin=0, vmax=peak or 1.0)
    axes.set(xticks=[], yticks=[])


def draw_tuning(axes: style.Axes, curve: np.ndarray) -> None:
    """Draws activity over heading [B] into polar axes; headings that were not held are left out."""
    angle = 2 * np.pi * np.arange(len(curve) + 1) / len(curve)
    axes.plot(angle, np.append(curve, curve[0]), color=BLUE, lw=1.2)
    peak = np.nanmax(curve)
    axes.set(ylim=(0, peak or 1.0), yticks=[])


def draw_spikes_on_path(
    title: str, line: str, recording: CellRecording, spikes: Sequence[np.ndarray]
) -> style.Figure:
    """Draws the true path, and on it the pose at each spike, a panel for each chosen cell.

    Args:
        spikes: of each chosen cell its times, s.

    Raises:
        InputError: no pose is known.
    """
    rows = -(-len(spikes) // _COLUMNS)
    step = _SIDE + 0.3
    height = style.TOP + rows * step + 0.1
    figure = style.new_figure(height, title, line)
    known = known_poses(recording.truth)
    time, place = recording.time[known], recording.truth[known, :2].T
    for k, times in enumerate(spikes):
        row, column = divmod(k, _COLUMNS)
        bottom = height - style.TOP - (row + 1) * step
        axes = style.add_axes(figure, style.LEFT + column * (_SIDE + _GAP), bottom, _SIDE, _SIDE)
        axes.plot(*place, color=GREY, lw=0.4)
        axes.plot(*(np.interp(times, time, axis) for axis in place), ".", color=VERMILLION, ms=2.5, mew=0)
        axes.set(xticks=[], yticks=[], aspect="equal")
        label = f"cell {recording.cell[k]}, {len(times)} spike{'s' * (len(times) != 1)}"
        axes.set_title(label, fontsize=7, color=INK, pad=2)
    return figure


def draw_distributions(title: str, rows: Sequence[ComparedScore]) -> style.Figure:
    """Draws the share of cells up to each value of a score, of the model and of the data, a panel for each
    score; shares and turns have none."""
    drawn = [row for row in rows if np.isfinite(row.above[0])]
    columns, side, up = 4, 1.25, 1.75
    top = style.TOP + 0.35
    height = top + -(-len(drawn) // columns) * up
    figure = style.new_figure(height, title, "share of cells up to a value, of the model and of the data")
    width = (style.INNER - (columns - 1) * 0.5) / columns
    for k, row in enumerate(drawn):
        down, across = divmod(k, columns)
        bottom = height - top - side - down * up
        axes = style.add_axes(figure, style.LEFT + across * (width + 0.5), bottom, width, side)
        axes.grid(color=style.LINE_GREY, lw=0.7)
        for values, colour, label in zip(row.values, (BLUE, VERMILLION), ("model", "data"), strict=True):
            axes.ecdf(values, color=colour, lw=1.3, label=label)
        axes.set_title(f"{row.label}\nP(data > model) {row.above[0]:.2f}", fontsize=6.2, color=INK, pad=3)
        if not k:
            axes.legend(frameon=False, fontsize=7.5, labelcolor=INK)
    return figure
