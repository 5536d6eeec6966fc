"""Lines of the tables and pictures of saved maps.

A picture has paths in a maze or building on the left, and figures of all sessions on the right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from evaluation.papers.tables.markdown import markdown_header
from evaluation.plots import style
from evaluation.plots.map_plot import draw_walls
from robot.world.maze import Maze, wall_boxes
from tactile.base.random_streams import stream


def table(*rows: str) -> list[str]:
    """The lines of a table: a row is `figure | goal | measured | the same of the control`."""
    return [markdown_header(("figure", "goal", "measured", "control")), *(f"| {row} |" for row in rows)]


def at_least(share: float, total: int) -> str:
    """A goal: that share of all."""
    return f"{int(np.ceil(share * total))} of {total}"


def median(values: np.ndarray) -> float:
    """Median of values [n]; NaN of none."""
    return float(np.median(values)) if len(values) else np.nan


def spread(values: Sequence[float] | np.ndarray, digits: int = 2) -> str:
    """Median and largest of values; `-` without a finite one."""
    known = np.asarray(values, float)
    known = known[~np.isnan(known)]
    if not len(known):
        return "-"
    return f"{np.median(known):.{digits}f} ({known.max():.{digits}f})"


COLOURS = (style.GREY, style.BLUE, style.VERMILLION, style.GREEN, style.PURPLE)
HEIGHT = 4.6
"""Of a picture, inches."""
TOP, BOTTOM = 1.05, 0.75
"""Margins of the panels, inches."""
SPREAD = 0.18
"""Half the width over which the dots of one group are spread."""
MARKS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "truly changed": ("o", {"ms": 15, "mfc": "none", "mec": style.VERMILLION, "mew": 1.8, "zorder": 8}),
    "named": ("x", {"ms": 8, "mew": 2, "color": style.BLUE, "zorder": 9}),
    "goals": ("o", {"ms": 6, "mfc": style.VERMILLION, "mec": "white", "zorder": 9}),
}
"""How places are marked on paths, by label."""


class PathPanel(NamedTuple):
    """Paths [.., 2] (m) by label, over the walls of a maze if there is one; rows of NaN interrupt a path.

    Attributes:
        marks: labels of `MARKS`, each with places [n, 2], m.
    """

    title: str
    maze: Maze | None
    paths: Mapping[str, np.ndarray]
    marks: Sequence[tuple[str, np.ndarray]] = ()


def draw_panels(
    png: Path,
    title: str,
    line: str,
    names: tuple[str, str],
    *,
    dots: Mapping[str, Sequence[float] | np.ndarray] = MappingProxyType({}),
    curves: Mapping[str, Sequence[np.ndarray] | np.ndarray] = MappingProxyType({}),
    limits: Mapping[str, float] = MappingProxyType({}),
    paths: PathPanel | None = None,
) -> None:
    """Draws figures of all sessions, and paths on their left, into a new PNG file.

    Args:
        line: the result in one sentence. names: of the axes, up and across, with units. dots: in groups by
            name. curves: the same, over steps. limits: values at which lines are drawn, by label.
    """
    figure = style.new_figure(HEIGHT, title, line)
    left = style.LEFT
    if paths is not None:
        wide = 0.58 * style.WIDTH - left
        _draw_paths(style.add_axes(figure, left, BOTTOM, wide, HEIGHT - TOP - BOTTOM), paths)
        left += wide + 0.95
    axes = style.add_axes(figure, left, BOTTOM, style.WIDTH - left - style.RIGHT, HEIGHT - TOP - BOTTOM)
    for number, values in enumerate(dots.values()):
        known = np.sort(np.asarray(values, float))
        known = known[np.isfinite(known)]
        beside = np.linspace(-SPREAD, SPREAD, len(known)) if len(known) > 1 else np.zeros(len(known))
        axes.plot(number + beside, known, "o", ms=5, color=COLOURS[1 + number % 4], alpha=0.8)
        if len(known):
            axes.plot([number - 0.3, number + 0.3], 2 * [np.median(known)], color=style.INK, lw=1.4)
    if dots:
        axes.set_xticks(range(len(dots)), list(dots))
        axes.set_xlim(-0.6, len(dots) - 0.4)
    for number, (label, group) in enumerate(curves.items()):
        for curve in group:
            steps = 1 + np.arange(len(curve))
            axes.plot(steps, curve, color=COLOURS[1 + number % 4], lw=1.1, alpha=0.6, label=label)
            label = ""
    if len(curves) > 1:
        axes.legend(
            frameon=False, fontsize=8.5, labelcolor=style.INK,
            loc="lower right", bbox_to_anchor=(1, 1), ncols=len(curves),
        )  # fmt: skip
    for label, limit in limits.items():
        axes.axhline(limit, color=style.VERMILLION, lw=1.0, ls="--", zorder=0.8)
        across = axes.get_yaxis_transform()
        axes.text(
            1, limit, label, transform=across, ha="right", va="bottom", fontsize=8, color=style.VERMILLION
        )
    axes.set_ylim(0, 1.1 * max(axes.get_ylim()[1], *limits.values(), 0.0))
    axes.grid(axis="y", color=style.LINE_GREY, lw=0.8)
    style.name_axes(axes, names[1], names[0])
    figure.savefig(png)


def _draw_paths(axes: style.Axes, panel: PathPanel) -> None:
    axes.set_aspect("equal", anchor="W")
    if panel.maze is not None:
        walls = wall_boxes(panel.maze, stream(0, "maze.heights"))
        draw_walls(axes, np.column_stack([walls.box, walls.height]))
    for number, (label, path) in enumerate(panel.paths.items()):
        width, order = (1.6, 2 + number) if number else (1.0, 1)
        axes.plot(*path.T, color=COLOURS[number], lw=width, label=label, zorder=order)
    for label, places in panel.marks:
        if len(places):
            mark, options = MARKS[label]
            axes.plot(*places.T, mark, label=label, **options)
    axes.set_title(panel.title, fontsize=9.5, color=style.INK, loc="left")
    axes.set(xticks=[], yticks=[])
    axes.legend(
        loc="upper left", bbox_to_anchor=(0, -0.01), ncol=3, frameon=False, fontsize=8.5, labelcolor=style.INK
    )
