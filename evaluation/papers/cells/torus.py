"""The figure of the torus: rate maps in a box larger than the torus, and in a smaller one.

In the larger box a cell has a place in every copy of the torus: on a square lattice whose spacing is the side
of the torus. The grid cells of the entorhinal cortex lie on a hexagonal one (Hafting et al. 2005, Nature
436:801). Odometry is exact and there are no views, so that the maps show the network and no drift.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.cells.fields import find_fields
from evaluation.cells.grid_score import (
    HEXAGONAL,
    SQUARE,
    Lattice,
    autocorrelogram,
    lattice_scores,
    measure_lattice,
)
from evaluation.cells.rate_map import place_index, sample_seconds, smooth_rates
from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import PathBins, ShuffledScores, shuffled_scores
from evaluation.papers.cells.panels import panel_row
from evaluation.papers.cells.rat_sessions import RatSessions, column_activity
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from evaluation.plots import style
from ratslam.core.compilation import prepare_precision

RATE = 10.0
"""Steps per second."""
LARGE, SMALL = (3.5, 2.5), (0.7, 0.7)
"""Boxes, m."""
BINS = 0.1, 0.05
"""Bins of maps in the large and in the small box, m."""
SECONDS = 900.0, 200.0
"""In the large and in the small box."""
SMOOTHING = 0.075
"""Standard deviation of the Gaussian over rate maps, m."""
FIELD = 0.02
"""Smallest field that counts, m^2."""
COLUMNS = 64
"""Places on the torus whose cells are recorded."""
SHUFFLES = 100
"""Of each cell."""
DARK = {"speed_white": 0.0, "heading_white": 0.0}
"""Exact odometry."""


class _LatticeFigures(NamedTuple):
    """Figures of n cells in one box.

    Attributes:
        size: of the box, m. bin: m. maps: [n, H, W] rates. hexagonal, square: lattice scores and shuffles.
            spacing: [n] of the square lattice, m. fields: [n] number.
    """

    size: tuple[float, float]
    bin: float
    maps: np.ndarray
    hexagonal: ShuffledScores
    square: ShuffledScores
    spacing: np.ndarray
    fields: np.ndarray


_Torus = tuple[_LatticeFigures, _LatticeFigures, float]
"""Columns in the large and in the small box; side of the torus, m."""


def measure_torus(
    task: Task, seconds: tuple[float, float] = SECONDS, columns: int = COLUMNS, shuffles: int = SHUFFLES
) -> _Torus:
    """The figures of a session in each box; the path is that of the first seed.

    Args:
        seconds: in the large and in the small box. columns: places on the torus. shuffles: of each.
    """
    prepare_precision("float64")
    rats = RatSessions.of_columns(columns, task.first, f"rat_simulation.rate_hz={RATE}")
    recordings = [
        rats.run(
            rats.rat(
                task.first, walk={"speed": 0.3, "speed_sd": 0.15}, seconds=time, odometry=DARK,
                box={"width": size[0], "height": size[1]}, phases=[{"start": 0, "dark": True}],
            )
        )
        for size, time in zip((LARGE, SMALL), seconds, strict=True)
    ]  # fmt: skip
    large, small = (
        measure_cells(each, column_activity(each.activity, columns), size, bin, shuffles, task.first)
        for each, size, bin in zip(recordings, (LARGE, SMALL), BINS, strict=True)
    )
    return large, small, rats.torus


def measure_cells(
    recording: CellRecording, activity: np.ndarray, size: tuple[float, float], bin: float, shuffles: int,
    seed: int, smoothing: float = SMOOTHING,
) -> _LatticeFigures:  # fmt: skip
    """The figures of activity [T, n] along the path of a recording.

    Args:
        size: of the box, m, with a corner at the origin. bin: m. shuffles: of each cell, at least 19.
            smoothing: standard deviation of the Gaussian over rate maps, m.

    Raises:
        InputError: see `shuffled_scores`.
    """
    x_edges, y_edges = (np.linspace(0.0, side, round(side / bin) + 1) for side in size)
    shape = len(y_edges) - 1, len(x_edges) - 1
    place = place_index(recording.truth, x_edges, y_edges)
    bins = PathBins(place, shape, sample_seconds(recording.time))

    def score(lattice: Lattice, rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        return lattice_scores(autocorrelogram(smooth_rates(rates, seconds, smoothing / bin)), lattice)

    hexagonal, square = (
        shuffled_scores(activity, bins, partial(score, lattice), shuffles, seed)
        for lattice in (HEXAGONAL, SQUARE)
    )
    inside, count = place >= 0, int(np.prod(shape))
    at, weight = place[inside], bins.seconds[inside]
    seconds = np.bincount(at, weight, count)
    sums = np.array([np.bincount(at, weight * cell, count) for cell in activity[inside].T])
    rates = (sums / np.where(seconds > 0, seconds, np.nan)).reshape(-1, *shape)
    maps = smooth_rates(rates, seconds.reshape(shape), smoothing / bin)
    spacing, _ = measure_lattice(autocorrelogram(maps), bin, SQUARE)
    fields = find_fields(maps, least_bins=round(FIELD / bin**2))
    return _LatticeFigures(size, bin, maps, hexagonal, square, spacing, fields.number)


def _table_torus(result: _Torus) -> list[str]:
    large, small, torus = result
    above = (
        f"{len(large.maps)} columns. Medians over cells, in brackets the 2.5th and 97.5th percentile; "
        "control: median of the 95th percentile of each cell's shuffles, and the share above theirs."
    )
    known = f"shuffles have none; found in {np.isfinite(large.spacing).sum()} of {len(large.maps)}"
    square, hexagonal = large.square, large.hexagonal
    rows = [
        ["larger box over torus", "above 1", _ratio(large, torus), "-"],
        ["columns: spacing m", f"side of the torus, {torus:.2f}", _spread(large.spacing, 3), known],
        ["columns: square score", "above control", _spread(square.score), _control(square)],
        ["columns: grid score", "no grid cell", _spread(hexagonal.score), _control(hexagonal)],
        ["columns: fields", "several", _counts(large.fields), "-"],
        ["smaller box over torus", "below 1", _ratio(small, torus), "-"],
        ["columns: fields", "one or none", _counts(small.fields), "-"],
    ]
    for name, scores in (("square", small.square), ("grid", small.hexagonal)):
        text = f"columns in the smaller box: {name} score"
        rows.append([text, "no lattice", _spread(scores.score), _control(scores)])
    below = (
        "Not shown: entorhinal grid cells, whose lattice is hexagonal, with several spacings; this torus is "
        "rigid and square, its activity a rate without spikes and theta, and its path integration here exact."
    )
    return table_lines([above], ("figure", "expectation", "measured", "control"), rows, [below])


def _draw_torus(result: _Torus, png: Path) -> None:
    """A row of maps and one of autocorrelograms for each box; histograms of the scores in the larger."""
    large, small, torus = result
    values = (large.spacing, large.square.score, large.hexagonal.score)
    spacing, square, hexagonal = (float(np.nanmedian(each)) for each in values)
    line = (
        f"Torus {torus:.2f} m. Larger box, medians: spacing {spacing:.2f} m, square score {square:.2f}, "
        f"grid score {hexagonal:.2f}."
    )
    scores = {"square score": large.square, "grid score": large.hexagonal}
    rows = [WIDE * box.size[1] / box.size[0] for box in (large, small) for _ in range(2)]
    height = style.TOP + sum(rows) + HEAD * len(rows) + 0.6 + HEIGHT + LOW
    figure = style.new_figure(height, "A torus cell in boxes of two sizes", line)
    top = height - style.TOP
    for box in (large, small):
        tall = WIDE * box.size[1] / box.size[0]
        shown = box.maps[:SHOWN]
        peak = np.nanmax(shown, axis=(1, 2), keepdims=True)
        rates = shown / np.maximum(peak, np.finfo(float).tiny)  # a silent column stays 0
        lags = autocorrelogram(shown)
        x, y = box.size
        reach_y, reach_x = (box.bin * side / 2 for side in lags.shape[1:])
        reach = -reach_x, reach_x, -reach_y, reach_y
        for name, images, extent, colours in (
            (f"rates, box {_ratio(box, torus)} of the torus", rates, (0, x, 0, y), ("viridis", 0, 1)),
            ("autocorrelograms over lags of x and y (m)", lags, reach, ("RdBu_r", -1, 1)),
        ):
            top -= HEAD
            figure.text(style.LEFT / style.WIDTH, (top + 0.08) / height, name, fontsize=9, color=style.INK)
            top -= tall
            palette, low, high = colours
            for column, values in enumerate(images):
                axes = style.add_axes(figure, style.LEFT + column * (WIDE + GAP), top, WIDE, tall)
                image = axes.imshow(values, origin="lower", extent=extent, cmap=palette, vmin=low, vmax=high)
                axes.set(xticks=[round(extent[0], 1), round(extent[1], 1)], yticks=[])
                axes.tick_params(labelsize=7, pad=1)
                labels = axes.get_xticklabels()
                labels[0].set_horizontalalignment("left")
                labels[-1].set_horizontalalignment("right")
                if column == 0:
                    axes.set_yticks([round(extent[2], 1), round(extent[3], 1)])
            bar = style.add_axes(figure, style.LEFT + len(images) * (WIDE + GAP), top, BAR, tall)
            figure.colorbar(image, cax=bar, ticks=(low, high))
            label = "rate / peak" if low == 0 else "correlation"
            bar.set_ylabel(label, fontsize=8, color=style.LABEL_GREY, labelpad=1)
    axes = _draw_histograms(figure, scores, large.spacing, torus)
    style.add_legend(figure, axes, columns=2).savefig(png)


def _ratio(found: _LatticeFigures, torus: float) -> str:
    x, y = found.size
    return f"{x:g} x {y:g} m / {torus:.2f} m = {x / torus:.2f} x {y / torus:.2f}"


def _spread(values: np.ndarray, digits: int = 2) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "none"
    middle, low, high = np.percentile(known, [50, 2.5, 97.5])
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def _control(scores: ShuffledScores) -> str:
    return f"{_spread(scores.percentile).split(' ')[0]}; {100 * scores.above.mean():.0f} % above"


def _counts(fields: np.ndarray) -> str:
    numbers, cells = np.unique(fields.astype(int), return_counts=True)
    return ", ".join(f"{number}: {count} cells" for number, count in zip(numbers, cells, strict=True))


FIGURE = Figure("A torus cell in boxes of two sizes", measure_torus, _table_torus, _draw_torus)


SHOWN = 4
"""Columns drawn."""
WIDE, GAP, BAR = 1.45, 0.16, 0.08
"""Inches: width of a map, between maps, width of a colour bar."""
HEIGHT, LOW, HEAD = 1.6, 0.95, 0.42
"""Inches: of a histogram, below it, above a row of maps."""


SCORES = np.linspace(-1.5, 1.5, 61).tolist()
"""Limits of the bins of lattice scores."""


def _draw_histograms(
    figure: style.Figure, scores: Mapping[str, ShuffledScores], spacing: np.ndarray, torus: float
) -> style.Axes:
    panels = panel_row(figure, len(scores) + 1, 0.5, LOW, HEIGHT)
    for axes, (name, found) in zip(panels, scores.items(), strict=False):
        known = found.score[np.isfinite(found.score)]
        shuffled = found.shuffled[np.isfinite(found.shuffled)]
        axes.hist(shuffled, SCORES, density=True, color=style.GREY, label="shuffled")
        axes.hist(known, SCORES, density=True, color=style.BLUE, alpha=0.7, label="columns")
        axes.set_xlim(-1.5, 1.5)
        style.name_axes(axes, f"{name}, larger box", "density" if axes is panels[0] else "")
    known = spacing[np.isfinite(spacing)]
    near = np.linspace(torus - 0.1, torus + 0.1, 41)
    panels[-1].hist(np.clip(known, near[0], near[-1]), near.tolist(), color=style.BLUE)
    panels[-1].axvline(torus, color=style.VERMILLION, lw=1.4)
    panels[-1].set_title("red: side of the torus", fontsize=8, color=style.LABEL_GREY, loc="left")
    style.name_axes(panels[-1], "spacing, larger box (m)", "columns")
    return panels[0]
