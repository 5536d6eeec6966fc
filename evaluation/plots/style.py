"""Shared style of all plots.

matplotlib is imported on first use and without pyplot: no window, no global state, reproducible bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# Okabe and Ito's colours, distinguishable with common forms of colour blindness
INK = "#222222"
LABEL_GREY = "#767676"
LINE_GREY = "#e6e6e6"
GREY = "#adadad"
BLUE = "#0072b2"
YELLOW = "#f0e442"
GREEN = "#009e73"
VERMILLION = "#d55e00"
PURPLE = "#cc79a7"
ORANGE = "#e69f00"
SKY = "#56b4e9"

WIDTH, LEFT, RIGHT, TOP = 8.0, 0.62, 0.25, 0.90
INNER = WIDTH - LEFT - RIGHT
"""Width and margins of every plot, and width between the margins, inches."""
BOTTOM = 1.0
"""Room below the axes of a map, inches."""
MARGIN, FLATTEST, TALLEST = 0.08, 0.4, 1.15
"""Share of a map's size kept free around it; least and largest height / width of its axes."""
MAP, TRUTH = "the map", "the truth"
"""Frames that axes are in: commands take places of a map."""
ROOM = 0.12
"""Share of logarithmic axes kept free on each side."""


def new_figure(height: float, title: str, line: str) -> Figure:
    """A figure of `WIDTH` (1200 pixels) and a height in inches, with a title and a subtitle."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), dpi=150, facecolor="white")
    FigureCanvasAgg(figure)
    left = LEFT / WIDTH
    figure.text(left, 1 - 0.42 / height, title, fontsize=15, weight="bold", color=INK)
    figure.text(left, 1 - 0.70 / height, line, fontsize=9.2, color=LABEL_GREY)
    return figure


def new_chart(tall: float, bottom: float, title: str, line: str, right: float = 0.0) -> tuple[Figure, Axes]:
    """A figure with axes of a height above a bottom margin, up to an extra margin at the right, inches."""
    figure = new_figure(TOP + tall + bottom, title, line)
    return figure, add_axes(figure, LEFT, bottom, INNER - right, tall)


def add_axes(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Frameless axes at a position of the figure, in inches."""
    across, up = figure.get_size_inches()
    axes = figure.add_axes((left / across, bottom / up, width / across, height / up))
    axes.set_axisbelow(True)
    axes.tick_params(length=0, labelsize=8.5, labelcolor=LABEL_GREY)
    axes.spines[:].set_visible(False)
    return axes


def add_dial(figure: Figure, left: float, bottom: float, side: float) -> Axes:
    """Polar axes with a thin rim and no labels at a position of the figure, in inches."""
    across, up = figure.get_size_inches()
    axes = figure.add_axes((left / across, bottom / up, side / across, side / up), projection="polar")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set(color=GREY, lw=0.6)
    return axes


def add_scale(
    figure: Figure, box: Sequence[float], shades: np.ndarray, top: float, title: str, pad: float
) -> Axes:
    """A bar of greys [N, 1] or colours [N, 1, 3] from 0 to `top`, with ticks at its right, at a position in
    inches."""
    bar = add_axes(figure, *box)
    bar.imshow(shades, cmap="gray", vmin=0, vmax=1, extent=(0, 1, 0, top), origin="lower", aspect="auto")
    bar.set_xticks([])
    bar.yaxis.tick_right()
    bar.set_title(title, fontsize=8, color=LABEL_GREY, loc="left", pad=pad)
    return bar


def name_axes(axes: Axes, across: str, up: str) -> None:
    """Sets the axis labels, with units."""
    axes.set_xlabel(across, color=LABEL_GREY, fontsize=9)
    axes.set_ylabel(up, color=LABEL_GREY, fontsize=9)


def add_lines(axes: Axes, lines: np.ndarray, color: str, **how: Any) -> None:
    """Draws straight lines [n, 2, 2] of one colour."""
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(list(lines), colors=color, **how))


def log_axes(axes: Axes, across: np.ndarray, up: np.ndarray) -> None:
    """Sets logarithmic axes around positive values of any shapes, with round tick labels and a light grid."""
    axes.set(xscale="log", yscale="log")
    for axis, limit, values in ((axes.xaxis, axes.set_xlim, across), (axes.yaxis, axes.set_ylim, up)):
        low, high = np.log(values.min()), np.log(values.max())
        room = ROOM * max(high - low, np.log(2.0)) / (1 - 2 * ROOM)
        limit(np.exp(low - room), np.exp(high + room))
        log_ticks(axis, (1, 2, 5) if high - low < np.log(300) else (1,))
    axes.grid(color=LINE_GREY, lw=0.7)


def log_ticks(axis: Axis, steps: tuple[int, ...]) -> None:
    """Sets plain tick labels on a logarithmic axis, at these multiples of powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=steps, numticks=30))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.10g}"))


def frame(points: np.ndarray) -> np.ndarray:
    """Corners [[left, bottom], [right, top]] (m) around points [n, 2], neither too flat nor too tall."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle, size = (low + high) / 2, np.maximum(high - low + MARGIN * (high - low).max(), 1e-3)
    size = np.maximum(size, size[::-1] * [1 / TALLEST, FLATTEST])
    return np.stack([middle - size / 2, middle + size / 2])


def map_figure(box: np.ndarray, title: str, line: str, of: str) -> tuple[Figure, Axes]:
    """A figure with equal axes (m) that show a box [[left, bottom], [right, top]] in the frame `of` a map."""
    width, height = box[1] - box[0]
    figure, axes = new_chart(INNER * height / width, BOTTOM, title, line)
    axes.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal")
    metre_grid(axes, of)
    return figure, axes


def metre_grid(axes: Axes, of: str = "") -> None:
    """Sets equal tick steps on both axes (m), a light grid, and labels that say whose frame it is (`of`)."""
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    step = MaxNLocator(10, steps=[1, 2, 5, 10]).tick_values(*axes.get_xlim())
    axes.xaxis.set_major_locator(MultipleLocator(step[1] - step[0]))
    axes.yaxis.set_major_locator(MultipleLocator(step[1] - step[0]))
    axes.grid(color=LINE_GREY, lw=0.7)
    frame = f" in the frame of {of}" * bool(of)
    name_axes(axes, f"x{frame} (m)", f"y{frame} (m)")


def add_legend(figure: Figure, axes: Axes, *, columns: int = 4) -> Figure:
    """The figure with a legend at its bottom left, in the order of drawing."""
    handles, labels = axes.get_legend_handles_labels()
    across, up = figure.get_size_inches()
    figure.legend(
        handles, labels, loc="lower left", bbox_to_anchor=(LEFT / across, 0.08 / up), ncols=columns,
        bbox_transform=figure.transFigure, borderaxespad=0, borderpad=0, frameon=False, fontsize=9,
        labelcolor=INK, handlelength=1.8, columnspacing=1.8,
    )  # fmt: skip
    return figure
