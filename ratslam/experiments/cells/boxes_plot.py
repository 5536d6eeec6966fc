"""The picture of two boxes: maps of some columns, and histograms of correlations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.plots import style

SHOWN = 7
"""Columns whose maps are drawn."""
SIDE, GAP, MARGIN = 0.82, 0.09, 1.08
"""Inches: of a map, between maps, left of them."""
HEIGHT, LOW = 1.7, 0.95
"""Inches: of a histogram, below it."""
COLOURS = (style.GREY, style.BLUE, style.VERMILLION)
BINS = np.linspace(-1.0, 1.0, 41)


class MapPairs(NamedTuple):
    """Correlations [n] of pairs of maps, by name."""

    title: str
    correlations: Mapping[str, np.ndarray]


def draw_boxes(
    title: str, line: str, rows: Mapping[str, np.ndarray], torus: float, pairs: Sequence[MapPairs], png: Path
) -> None:
    """Draws rows of maps [n, N, N] on the torus and a histogram for each of the pairs.

    Args:
        torus: side of the torus, m.
    """
    step = SIDE + GAP
    height = style.TOP + 0.2 + len(rows) * step + 0.75 + HEIGHT + LOW
    figure = style.new_figure(height, title, line)
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


def _draw_histograms(figure: style.Figure, pairs: Sequence[MapPairs]) -> style.Axes:
    gap = 0.7
    width = (style.WIDTH - style.LEFT - style.RIGHT - (len(pairs) - 1) * gap) / len(pairs)
    for k, pair in enumerate(pairs):
        axes = style.add_axes(figure, style.LEFT + k * (width + gap), LOW, width, HEIGHT)
        for (name, values), colour in zip(pair.correlations.items(), COLOURS, strict=True):
            axes.hist(values, BINS.tolist(), color=colour, alpha=0.65, label=name)
            if len(values):
                axes.axvline(values.mean(), color=colour, lw=1.4, ls="--")
        axes.grid(color=style.LINE_GREY, lw=0.7)
        axes.set(xlim=(-1, 1), xticks=(-1, -0.5, 0, 0.5, 1))
        axes.set_title(f"{pair.title}", fontsize=9.5, color=style.INK, loc="left")
        style.name_axes(
            axes, "correlation of two maps of a column (dashed: mean)", "columns" if k == 0 else ""
        )
    return axes
