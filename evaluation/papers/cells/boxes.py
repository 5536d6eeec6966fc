"""The figure of two boxes: rate maps of the same cells in box A, in A again, and in box B with other cues.

The rat is carried from A to B and set down elsewhere, with another heading, which odometry does not see. Grid
cells of one module keep their phases to each other in another box and turn and shift as one (Fyhn et al.
2007, Nature 446:190); place cells remap, each in its own way (Leutgeb et al. 2005, Science 309:619). The
maps of all cells are therefore compared as they are and after the best turn and shift common to all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy import fft

from evaluation.cells.rate_map import bin_activity, rate_maps
from evaluation.cells.recording import CellRecording
from evaluation.papers.cells.panels import name_panel, panel_row
from evaluation.papers.cells.rat_sessions import RatSessions, column_activity
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from evaluation.plots import style
from ratslam.core.compilation import prepare_precision
from tactile.base.se2 import wrap

RATE = 10.0
"""Steps per second, each with a view."""
SECONDS = 240.0
"""In A, in A again, and in B."""
PLACE = (0.25, 0.7)
"""Where the rat is set down in B, m."""
BOX = {
    "cards": [
        {"at_deg": 300, "extent_deg": 70, "brightness": 0.9},
        {"at_deg": 70, "extent_deg": 30, "brightness": 0.1},
        {"at_deg": 150, "extent_deg": 40, "brightness": 0.7},
    ],
    "distal": [
        {"at_deg": 190, "extent_deg": 50, "brightness": 0.8},
        {"at_deg": 20, "extent_deg": 30, "brightness": 0.5},
    ],
}
"""Box B: of the size of A, with other cues."""
COLUMNS = 64
"""Places on the torus whose cells are recorded."""
ANGLES = np.radians(np.arange(0, 360, 5))
"""Common turns tried, rad; of shifts all are tried, in steps of a cell."""
USUAL = 1
"""Sessions."""

_FLAT = 1e-12
"""A variance below this share of the mean square is rounding: the map is flat."""


_Alignment = tuple[float, tuple[int, int], np.ndarray]
"""The turn and shift common to all cells at which the mean correlation of their maps is highest: angle of the
second box, rad anticlockwise; (x, y) added afterwards, bins, from 0 to below the bins of the torus; [C]
correlation of each cell there, NaN where one of its maps is flat."""


def align_maps(first: np.ndarray, second: np.ndarray, bins: int, angles: Sequence[float]) -> _Alignment:
    """The best common turn and shift of the second maps onto the first.

    Args:
        first, second: [C, H, W] rates, NaN where unknown; bins of one size. bins: along a side of the torus,
            in bins of the maps: shifts wrap round it. angles: to try, rad.
    """
    laid = lay_on_torus(first, bins, 0.0)
    best: _Alignment = np.nan, (0, 0), np.full(len(first), -np.inf)
    for angle in angles:
        fits = correlate_shifts(laid, lay_on_torus(second, bins, angle))
        known = np.isfinite(fits)
        mean = np.where(known, fits, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        y, x = np.unravel_index(mean.argmax(), mean.shape)
        if mean[y, x] > _mean(best[2]):
            best = float(angle), (int(x), int(y)), fits[:, y, x]
    return best


def _mean(correlation: np.ndarray) -> float:
    """Mean over the cells [C] that have one; NaN if none has."""
    known = correlation[~np.isnan(correlation)]
    return float(known.mean()) if known.size else np.nan


def lay_on_torus(maps: np.ndarray, bins: int, angle: float) -> np.ndarray:
    """[C, N, N] maps [C, H, W] turned round the middle of the box and laid on a torus of N bins a side.

    Each bin goes to the nearest bin of the torus; the mean is taken where several meet, NaN where none.
    """
    height, width = maps.shape[1:]
    y, x = (np.mgrid[:height, :width].reshape(2, -1).T - [(height - 1) / 2, (width - 1) / 2]).T
    column = np.cos(angle) * x - np.sin(angle) * y + (width - 1) / 2
    row = np.sin(angle) * x + np.cos(angle) * y + (height - 1) / 2
    at = np.round(row).astype(int) % bins * bins + np.round(column).astype(int) % bins
    flat = maps.reshape(len(maps), -1)
    known = np.isfinite(flat)
    sums, count = (np.zeros((len(maps), bins * bins)) for _ in range(2))
    for cell in range(len(maps)):
        sums[cell] = np.bincount(at[known[cell]], flat[cell, known[cell]], bins * bins)
        count[cell] = np.bincount(at[known[cell]], minlength=bins * bins)
    return (sums / np.where(count > 0, count, np.nan)).reshape(-1, bins, bins)


def correlate_shifts(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[C, N, N] Pearson correlations of maps on a torus [C, N, N] with others shifted by (y, x) bins.

    The bins that both maps have take part; NaN where one of them is flat there.
    """
    f, g = fft.rfft2(_parts(first)), fft.rfft2(_parts(second))
    side = first.shape[-2:]

    def sums(a: int, b: int) -> np.ndarray:
        return fft.irfft2(f[a] * np.conj(g[b]), side)

    count = np.maximum(np.round(sums(0, 0)), 1)
    mean, shifted_mean = sums(1, 0) / count, sums(0, 1) / count
    square, shifted_square = sums(2, 0) / count, sums(0, 2) / count
    variance, shifted_variance = square - mean**2, shifted_square - shifted_mean**2
    flat = (variance <= _FLAT * square) | (shifted_variance <= _FLAT * shifted_square)
    product = np.where(flat, np.nan, variance * shifted_variance)
    return np.clip((sums(1, 1) / count - mean * shifted_mean) / np.sqrt(product), -1.0, 1.0)


def _parts(maps: np.ndarray) -> np.ndarray:
    """[3, C, N, N] mask, values and squares, of maps scaled to a peak of 1."""
    known = np.isfinite(maps)
    values = np.where(known, maps, 0.0)
    peak = np.abs(values).max(axis=(1, 2), keepdims=True)
    values = values / np.where(peak > 0, peak, 1.0)
    return np.array([known.astype(float), values, values**2])


PAIRS = "A with A", "A with B"
_Fit = tuple[dict[str, np.ndarray], float, tuple[int, int]]
"""Correlations [n] of maps as they are (`still`) and after the best common turn and shift (`best`), each also
with the identities of the cells shuffled (`shuffled still`, ...); that turn, rad, and that shift, bins."""
_Session = tuple[np.ndarray, dict[str, _Fit], float]
"""Maps [3, n, H, W] of columns in A, in A again and in B; the fits of `PAIRS`; turn of the sheet against B as
the rat was set down, rad."""
_Boxes = tuple[list[_Session], float, float]


def measure_boxes(task: Task, seconds: float = SECONDS, columns: int = COLUMNS) -> _Boxes:
    """The fits of all sessions, and the sides of box and torus, m.

    Args:
        seconds: in A, in A again, and in B. columns: places on the torus.
    """
    prepare_precision("float64")
    rats = RatSessions.of_columns(
        columns, task.first, f"rat_simulation.rate_hz={RATE}", "rat_simulation.views.every=1"
    )
    phase: dict[str, Any] = {"start": 2 * seconds, "kidnap": PLACE, "box": BOX}
    sessions = []
    for seed in task.seeds(USUAL):
        source = rats.rat(seed, walk={}, seconds=3 * seconds, phases=[phase])
        side = source.config.box.width
        sessions.append(_fit_session(rats.run(source), seconds, side, columns))
    return sessions, side, rats.torus


def _fit_session(recording: CellRecording, seconds: float, side: float, columns: int) -> _Session:
    """The fits of a recording of columns in three parts of equal duration: A, A again, and B of the same
    size, with bins of one cell."""
    count = round(side / recording.cell_size)
    edges = np.linspace(0.0, side, count + 1)
    part = np.minimum((recording.time - recording.time[0]) // seconds, 2)
    activity = column_activity(recording.activity, columns)
    maps = [
        rate_maps(bin_activity(recording.time[here], recording.truth[here], activity[here], edges, edges))
        for here in (part == number for number in range(3))
    ]
    fits = {pair: fit_maps(maps[k], maps[k + 1], recording.shape[2]) for k, pair in enumerate(PAIRS)}
    after = int(np.flatnonzero(part == 2)[0])
    turn = wrap(recording.truth[after - 1, 2] - recording.truth[after, 2])
    return np.array(maps), fits, float(turn)


def fit_maps(first: np.ndarray, second: np.ndarray, bins: int) -> _Fit:
    """The fit of maps [n, H, W] with others of the same cells on a torus of so many bins a side.

    Shuffled identities: each cell is compared with the next one; cells are drawn in no order.
    """
    laid, other = lay_on_torus(first, bins, 0.0), np.roll(second, 1, axis=0)
    still, shuffled = (
        correlate_shifts(laid, lay_on_torus(each, bins, 0.0))[:, 0, 0] for each in (second, other)
    )
    angle, shift, best = align_maps(first, second, bins, ANGLES.tolist())
    fits = {"still": still, "best": best, "shuffled still": shuffled}
    return fits | {"shuffled best": align_maps(first, other, bins, ANGLES.tolist())[2]}, angle, shift


def _table_boxes(result: _Boxes) -> list[str]:
    sessions, side, torus = result

    def spread(pair: str, name: str) -> str:
        means = [_mean(fits[pair][0][name]) for _, fits, _ in sessions]
        return f"{np.mean(means):.2f} ({min(means):.2f} to {max(means):.2f})"

    whole = "far above the control: the sheet turns and shifts as a whole"
    figures = (
        ("A with A", "no shift", "high", "still"),
        ("A with B", "no shift", "about 0: the sheet has turned and shifted", "still"),
        ("A with B", "best common turn and shift", whole, "best"),
    )
    rows = []
    for pair, how, goal, name in figures:
        control = f"{spread(pair, f'shuffled {name}')} shuffled identities"
        rows.append([f"columns: {pair}, {how}", goal, spread(pair, name), control])
    found = ", ".join(f"{np.degrees(wrap(fits['A with B'][1])):.0f}" for _, fits, _ in sessions)
    down = ", ".join(f"{np.degrees(turn):.0f}" for _, _, turn in sessions)
    rows.append(["common turn, degrees", "that of setting down", found, f"{down} set down"])
    rows.append(["box over torus", "-", f"{side:.2f} / {torus:.2f} m = {side / torus:.2f}", "-"])
    above = (
        f"Sessions: {len(sessions)}, of {sessions[0][0].shape[1]} columns. Correlations: mean over cells, "
        "then the lowest and the highest session."
    )
    below = (
        "A rigid torus has one map, which it can only turn and shift as a whole: a high correlation after"
        " that is built in, and global remapping of place cells cannot be shown by it. Activity is a rate,"
        " without spikes and without theta. A column is the cells of one place on the torus, every third"
        " heading."
    )
    return table_lines([above], ("figure", "expectation", "measured", "control"), rows, [below])


SHOWN = 7
"""Columns whose maps are drawn."""
SIDE, GAP, MARGIN = 0.82, 0.09, 1.08
"""Inches: of a map, between maps, left of them."""
HEIGHT, LOW = 1.7, 0.95
"""Inches: of a histogram, below it."""
COLOURS = (style.GREY, style.BLUE, style.VERMILLION)
BINS = np.linspace(-1.0, 1.0, 41)


def _draw_boxes(result: _Boxes, png: Path) -> None:
    """Maps of some columns in each box, and histograms of the correlations of all columns."""
    sessions, side, torus = result
    maps, fits, _ = sessions[0]
    _, angle, shift = fits["A with B"]

    def correlations(pair: str, name: str) -> np.ndarray:
        """Of all columns of all sessions that have one."""
        joined = np.concatenate([fits[pair][0][name] for _, fits, _ in sessions])
        return joined[np.isfinite(joined)]

    pairs = {
        title: {pair: correlations(pair, name) for pair in PAIRS}
        | {"A with B, identities shuffled": correlations("A with B", f"shuffled {name}")}
        for title, name in (("as they are", "still"), ("after the best common turn and shift", "best"))
    }
    bins = round(torus / side * maps.shape[2])
    first, again, plain = (lay_on_torus(each, bins, 0.0) for each in maps)
    fitted = np.roll(lay_on_torus(maps[2], bins, angle), shift[::-1], axis=(1, 2))
    rows = {"A": first, "A again": again, "B": plain, f"B turned\n{np.degrees(angle):.0f}°, shifted": fitted}
    still, best = (_mean(each["A with B"]) for each in pairs.values())
    line = (
        f"Box {side:g} m, torus {torus:g} m (ratio {side / torus:.2f}). Mean "
        f"correlation of A with B: {still:.2f}, after one turn and shift of all {best:.2f}."
    )
    step = SIDE + GAP
    height = style.TOP + 0.2 + len(rows) * step + 0.75 + HEIGHT + LOW
    figure = style.new_figure(height, "Rate maps in two boxes", line)
    for k, (name, shown) in enumerate(rows.items()):
        bottom = height - style.TOP - 0.2 - SIDE - k * step
        figure.text(
            (MARGIN - 0.12) / style.WIDTH, (bottom + SIDE / 2) / height, name, ha="right", va="center",
            fontsize=9, color=style.INK,
        )  # fmt: skip
        for column, rates in enumerate(shown[:SHOWN]):
            axes = style.add_axes(figure, MARGIN + column * step, bottom, SIDE, SIDE)
            peak = max(np.nanmax(rates), np.finfo(float).tiny)
            image = axes.imshow(
                rates / peak, origin="lower", extent=(0, torus, 0, torus), cmap="viridis", vmin=0, vmax=1
            )
            axes.set(xticks=[], yticks=[])
            if k == 0:
                axes.set_title(f"column {column + 1}", fontsize=7.5, color=style.LABEL_GREY, pad=3)
    top = height - style.TOP - 0.2 - len(rows) * step
    bar = style.add_axes(figure, MARGIN + SHOWN * step - GAP + 0.06, top + GAP, 0.08, len(rows) * step - GAP)
    figure.colorbar(image, cax=bar, ticks=(0, 1))
    bar.set_ylabel("rate / peak", fontsize=8, color=style.LABEL_GREY, labelpad=1)
    figure.text(
        MARGIN / style.WIDTH, (top - 0.08) / height,
        f"each map: the torus, {torus:g} x {torus:g} m; white: not visited or outside the box",
        fontsize=7.5, color=style.LABEL_GREY,
    )  # fmt: skip
    axes = _draw_histograms(figure, pairs)
    style.add_legend(figure, axes, columns=3).savefig(png)


def _draw_histograms(figure: style.Figure, pairs: Mapping[str, Mapping[str, np.ndarray]]) -> style.Axes:
    row = panel_row(figure, len(pairs), 0.7, LOW, HEIGHT)
    for axes, (title, correlations) in zip(row, pairs.items(), strict=True):
        for (name, values), colour in zip(correlations.items(), COLOURS, strict=True):
            axes.hist(values, BINS.tolist(), color=colour, alpha=0.65, label=name)
            if len(values):
                axes.axvline(values.mean(), color=colour, lw=1.4, ls="--")
        axes.set(xlim=(-1, 1), xticks=(-1, -0.5, 0, 0.5, 1))
        across = "correlation of two maps of a column (dashed: mean)"
        name_panel(axes, title, across, "columns" if axes is row[0] else "")
    return axes


FIGURE = Figure("Rate maps in two boxes", measure_boxes, _table_boxes, _draw_boxes)
