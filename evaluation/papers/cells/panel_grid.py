"""Panels in rows and columns under a title, in the style of all plots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from evaluation.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TOP, BOTTOM = 1.15, 0.85
"""Margins above and below the panels, inches; the legend is below."""
GAP_ACROSS, GAP_UP = 0.72, 0.80
"""Between panels, inches: labels of axes are there."""


def panel_grid(
    title: str, line: str, rows: int, columns: int, height: float = 2.2
) -> tuple[Figure, list[list[Axes]]]:
    """A figure with axes [rows][columns] from the top left on, with a light grid.

    Args:
        line: the result in one sentence. height: of a panel, inches.
    """
    whole = TOP + rows * height + (rows - 1) * GAP_UP + BOTTOM
    figure = style.new_figure(whole, title, line)
    width = (style.WIDTH - style.LEFT - style.RIGHT - (columns - 1) * GAP_ACROSS) / columns
    axes = [
        [
            style.add_axes(
                figure,
                style.LEFT + column * (width + GAP_ACROSS),
                whole - TOP - height - row * (height + GAP_UP),
                width,
                height,
            )
            for column in range(columns)
        ]
        for row in range(rows)
    ]
    for line_of_axes in axes:
        for each in line_of_axes:
            each.grid(color=style.LINE_GREY, lw=0.7)
    return figure, axes


def head_panel(axes: Axes, title: str) -> None:
    """Puts a title above a panel."""
    axes.set_title(title, fontsize=9.5, color=style.INK, loc="left")


def spread_dots(axes: Axes, at: Sequence[float], values: Sequence[Sequence[float]], colour: str) -> None:
    """A dot for each value of each group, at the group's place `at` along x."""
    for x, group in zip(at, values, strict=True):
        axes.plot([x] * len(group), group, "o", ms=3.5, mew=0, color=colour, alpha=0.5)
