"""Plot of the cost of a step against the length of a session."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evaluation.plots import style
from evaluation.plots.style import BLUE, GREEN, PURPLE, VERMILLION, WIDTH

_TALL, _BOTTOM = 4.4, 1.15  # inches: height of the axes, and below them
_COLORS = (BLUE, VERMILLION, GREEN, PURPLE)
_DASHES = (("mean", "-", "o"), ("99 %", "--", "s"), ("largest", ":", "^"))


class GrowthCurve(NamedTuple):
    """The cost of a session's steps up to each of N lengths.

    Attributes:
        name: of the session. steps: [N] lengths. cost: [N, 3] mean, 99 % quantile and largest of the steps
            since the length before, positive.
    """

    name: str
    steps: np.ndarray
    cost: np.ndarray


def draw_growth(title: str, line: str, curves: Sequence[GrowthCurve], cost: str) -> style.Figure:
    """Draws mean, 99 % quantile and largest cost of each session on logarithmic axes.

    Args:
        curves: 1 to 4. cost: axis label with unit.
    """
    inner = WIDTH - style.LEFT - style.RIGHT
    figure = style.new_figure(style.TOP + _TALL + _BOTTOM, title, line)
    axes = style.add_axes(figure, style.LEFT, _BOTTOM, inner, _TALL)
    every = np.concatenate([curve.cost.ravel() for curve in curves])
    style.log_axes(axes, np.concatenate([curve.steps for curve in curves]), every)
    for curve, color in zip(curves, _COLORS, strict=False):
        for values, (name, dash, mark) in zip(curve.cost.T, _DASHES, strict=True):
            axes.plot(
                curve.steps, values, dash, color=color, lw=1.5, marker=mark, ms=4.5, mew=0,
                label=f"{curve.name}, {name}",
            )  # fmt: skip
    style.name_axes(axes, "length of the session (steps)", cost)
    style.add_legend(figure, axes, columns=len(curves))
    return figure
