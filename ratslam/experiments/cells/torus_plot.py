"""The picture of the torus: rate maps and autocorrelograms in two boxes, and lattice scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.cells.autocorrelogram import autocorrelogram
from evaluation.cells.shuffling import ShuffledScores
from evaluation.plots import style

SHOWN = 4
"""Columns drawn."""
WIDE, GAP, BAR = 1.45, 0.16, 0.08
"""Inches: width of a map, between maps, width of a colour bar."""
HEIGHT, LOW, HEAD = 1.6, 0.95, 0.42
"""Inches: of a histogram, below it, above a row of maps."""


class BoxMaps(NamedTuple):
    """Maps in a box. name: with its size. size: m. bin: m. maps: [n, H, W] rates."""

    name: str
    size: tuple[float, float]
    bin: float
    maps: np.ndarray


SCORES = np.linspace(-1.5, 1.5, 61).tolist()
"""Limits of the bins of lattice scores."""


def draw_torus(
    title: str, line: str, boxes: Sequence[BoxMaps], scores: Mapping[str, ShuffledScores],
    spacing: np.ndarray, torus: float, png: Path,
) -> None:  # fmt: skip
    """Draws for each box a row of maps and one of autocorrelograms, and histograms below.

    Args:
        scores: of the first box, by name. spacing: [n] in the first box, m. torus: its side, m.
    """
    rows = [WIDE * box.size[1] / box.size[0] for box in boxes for _ in range(2)]
    height = style.TOP + sum(rows) + HEAD * len(rows) + 0.6 + HEIGHT + LOW
    figure = style.new_figure(height, title, line)
    top = height - style.TOP
    for box in boxes:
        tall = WIDE * box.size[1] / box.size[0]
        shown = box.maps[:SHOWN]
        peak = np.nanmax(shown, axis=(1, 2), keepdims=True)
        rates = shown / np.maximum(peak, np.finfo(float).tiny)  # a silent column stays 0
        lags = autocorrelogram(shown)
        x, y = box.size
        reach_y, reach_x = (box.bin * side / 2 for side in lags.shape[1:])
        for name, images, extent, colours in (
            (f"rates, {box.name}", rates, (0, x, 0, y), ("viridis", 0, 1)),
            (
                "autocorrelograms over lags of x and y (m)",
                lags,
                (-reach_x, reach_x, -reach_y, reach_y),
                ("RdBu_r", -1, 1),
            ),
        ):
            top -= HEAD
            figure.text(style.LEFT / style.WIDTH, (top + 0.08) / height, name, fontsize=9, color=style.INK)
            top -= tall
            _draw_row(figure, top, tall, images, extent, colours)
    axes = _draw_histograms(figure, scores, spacing, torus)
    style.add_legend(figure, axes, columns=2)
    figure.savefig(png)


def _draw_row(
    figure: style.Figure, bottom: float, tall: float, images: np.ndarray,
    extent: tuple[float, float, float, float],
    colours: tuple[str, float, float],
) -> None:  # fmt: skip
    name, low, high = colours
    for column, values in enumerate(images):
        axes = style.add_axes(figure, style.LEFT + column * (WIDE + GAP), bottom, WIDE, tall)
        image = axes.imshow(values, origin="lower", extent=extent, cmap=name, vmin=low, vmax=high)
        axes.set(xticks=[round(extent[0], 1), round(extent[1], 1)], yticks=[])
        axes.tick_params(labelsize=7, pad=1)
        labels = axes.get_xticklabels()
        labels[0].set_horizontalalignment("left")
        labels[-1].set_horizontalalignment("right")
        if column == 0:
            axes.set_yticks([round(extent[2], 1), round(extent[3], 1)])
    left = style.LEFT + len(images) * (WIDE + GAP)
    bar = style.add_axes(figure, left, bottom, BAR, tall)
    figure.colorbar(image, cax=bar, ticks=(low, high))
    label = "rate / peak" if low == 0 else "correlation"
    bar.yaxis.set_label_position("right")
    bar.set_ylabel(label, fontsize=8, color=style.LABEL_GREY, labelpad=1)


def _draw_histograms(
    figure: style.Figure, scores: Mapping[str, ShuffledScores], spacing: np.ndarray, torus: float
) -> style.Axes:
    gap, count = 0.5, len(scores) + 1
    width = (style.WIDTH - style.LEFT - style.RIGHT - (count - 1) * gap) / count
    panels = [
        style.add_axes(figure, style.LEFT + k * (width + gap), LOW, width, HEIGHT) for k in range(count)
    ]
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
    for axes in panels:
        axes.grid(color=style.LINE_GREY, lw=0.7)
    return panels[0]
