"""One figure or table of pose cells, and what its modules share.

The error of the packet on the torus: decoded minus true pose, the shortest way round. Panels in rows and
columns under a title, in the style of all plots. Processor and wall time of calls.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter, process_time
from typing import TYPE_CHECKING

import numpy as np

from evaluation.cells.decoding import truth_in_sheet
from evaluation.cells.recording import CellRecording
from evaluation.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def torus_error(recording: CellRecording) -> np.ndarray:
    """[T, 3] decoded minus true pose along the x and y of the sheet and in heading (m, m, rad), 0 at the
    first known pose; each at most half a side of the torus."""
    return shortest(recording, recording.packet_pose - truth_in_sheet(recording))


def shortest(recording: CellRecording, difference: np.ndarray) -> np.ndarray:
    """Differences [..., 3] of poses (m, m, rad), the shortest way round the torus."""
    sides = np.array(recording.torus_sides)
    return difference - sides * np.round(difference / sides)


def error_size(error: np.ndarray) -> np.ndarray:
    """[..., 2] distance (m) and angle (rad, not negative) of errors [..., 3]."""
    return np.stack([np.hypot(error[..., 0], error[..., 1]), np.abs(error[..., 2])], axis=-1)


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
    bottoms = [whole - TOP - height - row * (height + GAP_UP) for row in range(rows)]
    return figure, [panel_row(figure, columns, GAP_ACROSS, bottom, height) for bottom in bottoms]


def panel_row(figure: Figure, count: int, gap: float, bottom: float, height: float) -> list[Axes]:
    """Axes side by side over the width of a figure, with a light grid; lengths in inches."""
    width = (style.WIDTH - style.LEFT - style.RIGHT - (count - 1) * gap) / count
    lefts = [style.LEFT + k * (width + gap) for k in range(count)]
    row = [style.add_axes(figure, left, bottom, width, height) for left in lefts]
    for axes in row:
        axes.grid(color=style.LINE_GREY, lw=0.7)
    return row


def name_panel(axes: Axes, title: str, across: str, up: str) -> None:
    """Puts a title above a panel, and names its axes, with units."""
    axes.set_title(title, fontsize=9.5, color=style.INK, loc="left")
    style.name_axes(axes, across, up)


def spread_dots(axes: Axes, at: Sequence[float], values: Sequence[Sequence[float]], colour: str) -> None:
    """A dot for each value of each group, at the group's place `at` along x."""
    for x, group in zip(at, values, strict=True):
        axes.plot([x] * len(group), group, "o", ms=3.5, mew=0, color=colour, alpha=0.5)


def time_call(call: Callable[[], object]) -> tuple[float, float]:
    """The time of a call, s: of all threads of this process on processors, and on the wall."""
    wall, processor = perf_counter(), process_time()
    call()
    return process_time() - processor, perf_counter() - wall
