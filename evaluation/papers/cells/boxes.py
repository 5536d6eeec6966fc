"""The figure of two boxes: rate maps of the same cells in box A, in A again, and in box B with other cues.

The rat is carried from A to B and set down elsewhere, with another heading, which odometry does not see. Grid
cells of one module keep their phases to each other in another box and turn and shift as one (Fyhn et al.
2007, Nature 446:190); place cells remap, each in its own way (Leutgeb et al. 2005, Science 309:619). The
maps of all cells are therefore compared as they are and after the best turn and shift common to all.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import fft

from evaluation.cells.rate_map import bin_activity, rate_maps
from evaluation.cells.recording import CellRecording
from evaluation.papers.cells.rat_sessions import RatSessions, rat_config, rat_source
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.plots import style
from ratslam.core.compilation import prepare_precision
from ratslam.network.config import PoseCellConfig
from tactile.base.random_streams import stream
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


class _Alignment(NamedTuple):
    """The turn and shift common to all cells at which the mean correlation of their maps is highest.

    Attributes:
        angle: of the second box, rad anticlockwise. shift: (x, y) added afterwards, bins, from 0 to below the
            bins of the torus. correlation: [C] of each cell there; NaN where one of its maps is flat.
    """

    angle: float
    shift: tuple[int, int]
    correlation: np.ndarray


def align_maps(first: np.ndarray, second: np.ndarray, bins: int, angles: Sequence[float]) -> _Alignment:
    """The best common turn and shift of the second maps onto the first.

    Args:
        first, second: [C, H, W] rates, NaN where unknown; bins of one size. bins: along a side of the torus,
            in bins of the maps: shifts wrap round it. angles: to try, rad.
    """
    laid = lay_on_torus(first, bins, 0.0)
    best = _Alignment(np.nan, (0, 0), np.full(len(first), -np.inf))
    for angle in angles:
        fits = correlate_shifts(laid, lay_on_torus(second, bins, angle))
        known = np.isfinite(fits)
        mean = np.where(known, fits, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        y, x = np.unravel_index(mean.argmax(), mean.shape)
        if mean[y, x] > mean_correlation(best.correlation):
            best = _Alignment(float(angle), (int(x), int(y)), fits[:, y, x])
    return best


def mean_correlation(correlation: np.ndarray) -> float:
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


class _MapFit(NamedTuple):
    """How well maps of n cells fit. still: [n] correlation as they are. best: after the best common turn and
    shift. shuffled_still, shuffled_best: the same with the identities of the cells shuffled."""

    still: np.ndarray
    best: _Alignment
    shuffled_still: np.ndarray
    shuffled_best: _Alignment


class _BoxSession(NamedTuple):
    """One session.

    Attributes:
        maps: [3, n, H, W] of columns in A, in A again and in B. again, moved: fits of these: A with A and A
            with B. single_again, single_moved: those of one cell of each column. turn: of the sheet against B
            as the rat was set down, rad.
    """

    maps: np.ndarray
    again: _MapFit
    moved: _MapFit
    single_again: _MapFit
    single_moved: _MapFit
    turn: float


_Boxes = tuple[list[_BoxSession], float, float]


def measure_boxes(task: Task, seconds: float = SECONDS, columns: int = COLUMNS) -> _Boxes:
    """The fits of all sessions, and the sides of box and torus, m.

    Args:
        seconds: in A, in A again, and in B. columns: places on the torus.
    """
    prepare_precision("float64")
    config = rat_config(f"rat_simulation.rate_hz={RATE}")
    network = config.pose_cells
    chosen = choose_columns(network, columns, task.first)
    config = rat_config(
        f"rat_simulation.rate_hz={RATE}",
        "rat_simulation.views.every=1",
        f"cells={{chosen: {json.dumps(chosen)}}}",
    )
    phase: dict[str, Any] = {"start": 2 * seconds, "kidnap": PLACE, "box": BOX}
    rats, sessions = RatSessions(config), []
    for seed in task.seeds(USUAL):
        source = rat_source(config, seed, walk={}, seconds=3 * seconds, phases=[phase])
        side = source.config.box.width
        sessions.append(_fit_session(rats.run(source), seconds, side, columns))
    return sessions, side, network.cells_xy * network.cell_size


def _fit_session(recording: CellRecording, seconds: float, side: float, columns: int) -> _BoxSession:
    """The fits of a recording of columns in three parts of equal duration: A, A again, and B of the same
    size, with bins of one cell."""
    count = round(side / recording.cell_size)
    edges = np.linspace(0.0, side, count + 1)
    part = np.minimum((recording.time - recording.time[0]) // seconds, 2)
    all_maps = []
    for activity in (sum_columns(recording.activity, columns), one_of_each(recording.activity, columns)):
        sums = [
            bin_activity(recording.time[here], recording.truth[here], activity[here], edges, edges)
            for here in (part == number for number in range(3))
        ]
        all_maps.append([rate_maps(each) for each in sums])
    bins = recording.shape[2]
    again, moved, single_again, single_moved = (
        fit_maps(maps[k], maps[k + 1], bins) for maps in all_maps for k in (0, 1)
    )
    after = int(np.flatnonzero(part == 2)[0])
    turn = wrap(recording.truth[after - 1, 2] - recording.truth[after, 2])
    maps = np.array(all_maps[0])
    return _BoxSession(maps, again, moved, single_again, single_moved, float(turn))


def fit_maps(first: np.ndarray, second: np.ndarray, bins: int) -> _MapFit:
    """The fit of maps [n, H, W] with others of the same cells on a torus of so many bins a side.

    Shuffled identities: each cell is compared with the next one; cells are drawn in no order.
    """
    other = np.roll(second, 1, axis=0)
    still = [
        correlate_shifts(lay_on_torus(first, bins, 0.0), lay_on_torus(each, bins, 0.0))[:, 0, 0]
        for each in (second, other)
    ]
    best = [align_maps(first, each, bins, ANGLES.tolist()) for each in (second, other)]
    return _MapFit(still[0], best[0], still[1], best[1])


def _table_boxes(result: _Boxes) -> list[str]:
    """The lines of the table, and what it does not show."""
    sessions, side, torus = result
    lines = [
        f"Sessions: {len(sessions)}, of {sessions[0].maps.shape[1]} columns. Correlations: mean over cells, "
        "then the lowest and the highest session.",
        "",
        *markdown_header(("figure", "expectation", "measured", "control")).splitlines(),
    ]
    for kind, name in (("", "columns"), ("single_", "single cells")):
        again = [getattr(each, f"{kind}again") for each in sessions]
        moved = [getattr(each, f"{kind}moved") for each in sessions]
        rows = (
            ("A with A, no shift", "high", again, "still"),
            ("A with B, no shift", "about 0: the sheet has turned and shifted", moved, "still"),
            (
                "A with B, best common turn and shift",
                "far above the control: the sheet turns and shifts as a whole",
                moved,
                "best",
            ),
        )
        for figure, goal, fits, field in rows:
            control = f"{_range(fits, f'shuffled_{field}')} shuffled identities"
            lines.append(markdown_row([f"{name}: {figure}", goal, _range(fits, field), control]))
    found = ", ".join(f"{np.degrees(wrap(each.moved.best.angle)):.0f}" for each in sessions)
    down = ", ".join(f"{np.degrees(each.turn):.0f}" for each in sessions)
    lines.append(markdown_row(["common turn, degrees", "that of setting down", found, f"{down} set down"]))
    ratio = f"{side:.2f} / {torus:.2f} m = {side / torus:.2f}"
    lines.append(markdown_row(["box over torus", "-", ratio, "-"]))
    return [*lines, "", NOT_SHOWN]


NOT_SHOWN = (
    "A rigid torus has one map, which it can only turn and shift as a whole: a high correlation after that "
    "is built in, and global remapping of place cells cannot be shown by it. Activity is a rate, without "
    "spikes and without theta. A column is the cells of one place on the torus, every third heading."
)


def _draw_boxes(result: _Boxes, png: Path) -> None:
    """Maps of some columns in each box, and histograms of the correlations of all columns."""
    sessions, side, torus = result
    found = sessions[0].moved.best
    pairs: dict[str, dict[str, np.ndarray]] = {}
    for title, field in (("as they are", "still"), ("after the best common turn and shift", "best")):
        fits = {
            "A with A": ([each.again for each in sessions], field),
            "A with B": ([each.moved for each in sessions], field),
            "A with B, identities shuffled": ([each.moved for each in sessions], f"shuffled_{field}"),
        }
        pairs[title] = {name: _correlations(*each) for name, each in fits.items()}
    bins = round(torus / side * sessions[0].maps.shape[2])
    first, again, plain = (lay_on_torus(maps, bins, 0.0) for maps in sessions[0].maps)
    other = lay_on_torus(sessions[0].maps[2], bins, found.angle)
    fitted = np.roll(other, found.shift[::-1], axis=(1, 2))
    turned = f"B turned\n{np.degrees(found.angle):.0f}°, shifted"
    rows = {"A": first, "A again": again, "B": plain, turned: fitted}
    still, best = (_mean(each["A with B"]) for each in pairs.values())
    line = (
        f"Box {side:g} m, torus {torus:g} m (ratio {side / torus:.2f}). Mean "
        f"correlation of A with B: {still:.2f}, after one turn and shift of all {best:.2f}."
    )
    step = SIDE + GAP
    height = style.TOP + 0.2 + len(rows) * step + 0.75 + HEIGHT + LOW
    figure = style.new_figure(height, "Rate maps in two boxes", line)
    for k, (name, maps) in enumerate(rows.items()):
        bottom = height - style.TOP - 0.2 - SIDE - k * step
        figure.text(
            (MARGIN - 0.12) / style.WIDTH, (bottom + SIDE / 2) / height, name, ha="right", va="center",
            fontsize=9, color=style.INK,
        )  # fmt: skip
        for column, rates in enumerate(maps[:SHOWN]):
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
    style.add_legend(figure, axes, columns=3)
    figure.savefig(png)


def _correlations(fits: list[_MapFit], field: str) -> np.ndarray:
    values = [getattr(each, field) for each in fits]
    joined = np.concatenate([each.correlation if isinstance(each, _Alignment) else each for each in values])
    return joined[np.isfinite(joined)]


def _mean(values: np.ndarray) -> float:
    """The mean; NaN of none, as in a short session."""
    return float(values.mean()) if len(values) else np.nan


def _range(fits: list[_MapFit], field: str) -> str:
    means = [_mean(_correlations([each], field)) for each in fits]
    return f"{np.mean(means):.2f} ({min(means):.2f} to {max(means):.2f})"


FIGURE = Figure("Rate maps in two boxes", measure_boxes, _table_boxes, _draw_boxes)


SHOWN = 7
"""Columns whose maps are drawn."""
SIDE, GAP, MARGIN = 0.82, 0.09, 1.08
"""Inches: of a map, between maps, left of them."""
HEIGHT, LOW = 1.7, 0.95
"""Inches: of a histogram, below it."""
COLOURS = (style.GREY, style.BLUE, style.VERMILLION)
BINS = np.linspace(-1.0, 1.0, 41)


def _draw_histograms(figure: style.Figure, pairs: Mapping[str, Mapping[str, np.ndarray]]) -> style.Axes:
    gap = 0.7
    width = (style.WIDTH - style.LEFT - style.RIGHT - (len(pairs) - 1) * gap) / len(pairs)
    for k, (title, correlations) in enumerate(pairs.items()):
        axes = style.add_axes(figure, style.LEFT + k * (width + gap), LOW, width, HEIGHT)
        for (name, values), colour in zip(correlations.items(), COLOURS, strict=True):
            axes.hist(values, BINS.tolist(), color=colour, alpha=0.65, label=name)
            if len(values):
                axes.axvline(values.mean(), color=colour, lw=1.4, ls="--")
        axes.grid(color=style.LINE_GREY, lw=0.7)
        axes.set(xlim=(-1, 1), xticks=(-1, -0.5, 0, 0.5, 1))
        axes.set_title(title, fontsize=9.5, color=style.INK, loc="left")
        style.name_axes(
            axes, "correlation of two maps of a column (dashed: mean)", "columns" if k == 0 else ""
        )
    return axes


EVERY = 3
"""Every third heading is recorded: the packet is wider than the gap."""


def choose_columns(config: PoseCellConfig, count: int, seed: int) -> list[list[int]]:
    """Indices [x, y, heading] of the cells of `count` columns, drawn without repeats; a setting
    `cells.chosen`."""
    side = config.cells_xy
    drawn = stream(seed, "cells.columns").permutation(side * side)[:count].tolist()
    headings = range(0, config.cells_heading, EVERY)
    return [[at % side, at // side, heading] for at in drawn for heading in headings]


def sum_columns(activity: np.ndarray, columns: int) -> np.ndarray:
    """[T, columns] activity of columns, from that of their cells [T, C]."""
    return activity.reshape(len(activity), columns, -1).sum(axis=2)


def one_of_each(activity: np.ndarray, columns: int) -> np.ndarray:
    """[T, columns] activity of one cell of each column, at a heading that differs from column to column."""
    split = activity.reshape(len(activity), columns, -1)
    at = np.arange(columns)
    return split[:, at, at % split.shape[2]]
