"""The picture of a run: the map over the truth, with raw odometry for comparison.

matplotlib is imported when something is drawn, and without pyplot: no window, no global state.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from evaluation.run import Run, known
from evaluation.scorecard import Scorecard
from evaluation.trajectory import align
from tactile.frames import between, compose

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours keep apart for every common kind of colour vision
_INK = "#222222"
_QUIET = "#767676"
_FAINT = "#e6e6e6"
_ODOMETRY = "#adadad"
_MAP = "#0072b2"
_CLOSURE = "#d55e00"
_START = "#009e73"

# inches; the axes take what the margins leave
_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 8.0, 0.62, 0.25, 0.90, 1.0
_FLATTEST, _TALLEST = 0.4, 1.15  # height / width of the axes
_ROOM, _MARGIN = 0.2, 0.08  # shares of the map's size: for drifting odometry, and all round


class _Drawing(NamedTuple):
    """What is drawn, in one frame (the truth's where there is one): positions [.., 2] in m."""

    truth: np.ndarray | None
    odometry: np.ndarray
    final: np.ndarray
    nodes: np.ndarray


def draw_map(run: Run, card: Scorecard) -> Figure:
    """Trajectory, experiences and links over truth and raw odometry, equal axes in m.

    With truth, map and odometry are each aligned to it as for ATE; without, odometry starts where the map
    does. The frame holds truth and map; odometry that drifts far off leaves it.

    Args:
        run: the run. card: its scorecard, for the headline.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawing = _placed(run)
    box = _frame(drawing)
    figure = Figure(figsize=_size(box), dpi=150, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    _paint(axes, run, drawing)
    _furnish(figure, axes, box, card)
    return figure


def save_map(path: str | Path, run: Run, card: Scorecard) -> None:
    """Writes `draw_map` to a file; the same run gives the same bytes."""
    draw_map(run, card).savefig(path)


def _placed(run: Run) -> _Drawing:
    rows = known(run)
    if run.truth is None or len(rows) == 0:
        to_map = compose(run.final[0], between(run.odometry[0], np.zeros(3)))
        return _Drawing(None, _xy(compose(to_map, run.odometry)), _xy(run.final), _xy(run.nodes))
    true = run.truth[rows]
    to_truth = align(run.final[rows], true)
    odometry = compose(align(run.odometry[rows], true), run.odometry)
    final, nodes = compose(to_truth, run.final), compose(to_truth, run.nodes)
    return _Drawing(_xy(run.truth), _xy(odometry), _xy(final), _xy(nodes))


def _xy(pose: np.ndarray) -> np.ndarray:
    return np.asarray(pose)[:, :2]


def _frame(drawing: _Drawing) -> np.ndarray:
    """Corners [[left, bottom], [right, top]] in m: truth and map, and what lies near them of the odometry."""
    shown = [drawing.final, drawing.nodes, *([] if drawing.truth is None else [drawing.truth])]
    low, high = _corners(np.concatenate(shown))
    room = _ROOM * (high - low).max()
    far_low, far_high = _corners(drawing.odometry)
    low, high = (
        np.minimum(low, np.maximum(far_low, low - room)),
        np.maximum(high, np.minimum(far_high, high + room)),
    )
    middle, size = (low + high) / 2, np.maximum(high - low + _MARGIN * (high - low).max(), 1e-3)
    size = np.maximum(size, size[::-1] * [1 / _TALLEST, _FLATTEST])
    return np.stack([middle - size / 2, middle + size / 2])


def _corners(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.nanmin(points, axis=0), np.nanmax(points, axis=0)


def _size(box: np.ndarray) -> tuple[float, float]:
    """Of the figure in inches, for axes that fill it but for the margins."""
    width, height = box[1] - box[0]
    return _WIDTH, (_WIDTH - _LEFT - _RIGHT) * height / width + _TOP + _BOTTOM


def _paint(axes: Axes, run: Run, drawing: _Drawing) -> None:
    """Draws the layers; the order of drawing is the order of the legend, `zorder` what covers what."""
    from matplotlib.collections import LineCollection

    crowd = min(1.0, np.sqrt(150 / max(1, len(drawing.nodes))))  # finer strokes for many experiences
    truth, odometry, final, nodes = drawing
    if truth is not None:
        axes.plot(*truth.T, color=_INK, lw=0.8, zorder=5, label="truth")
    axes.plot(*odometry.T, color=_ODOMETRY, lw=0.9, ls=(0, (5, 3)), zorder=1, label="raw odometry")
    axes.plot(*final.T, color=_MAP, lw=0.8, alpha=0.4, zorder=2, label="trajectory in the map")
    if len(nodes):
        dot = {"s": 26 * crowd**2, "color": _MAP, "edgecolors": "white", "linewidths": 0.6 * (crowd == 1)}
        axes.scatter(*nodes.T, zorder=4, label="experience", **dot)
    older = np.abs(run.links[:, 0] - run.links[:, 1]) > 1
    for links, color, label in (
        (run.links[~older], _MAP, "link"),
        (run.links[older], _CLOSURE, "link to an older experience"),
    ):
        if len(links):
            axes.add_collection(
                LineCollection(nodes[links], colors=color, lw=1.6 * crowd, zorder=3, label=label)
            )
    start = final if truth is None else truth[np.isfinite(truth).all(axis=1)]
    axes.plot(*start[0], "o", ms=9, mfc="none", mec=_START, mew=1.8, zorder=6, label="start")


def _furnish(figure: Figure, axes: Axes, box: np.ndarray, card: Scorecard) -> None:
    from matplotlib.ticker import MaxNLocator, MultipleLocator

    width, height = figure.get_size_inches()
    axes.set_position(
        (_LEFT / width, _BOTTOM / height, 1 - (_LEFT + _RIGHT) / width, 1 - (_TOP + _BOTTOM) / height)
    )
    axes.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal", axisbelow=True)
    axes.set_xlabel("x (m)", color=_QUIET, fontsize=9)
    axes.set_ylabel("y (m)", color=_QUIET, fontsize=9)
    step = np.diff(MaxNLocator(7, steps=[1, 2, 5, 10]).tick_values(*box[:, 0]))[0]
    axes.xaxis.set_major_locator(MultipleLocator(step))
    axes.yaxis.set_major_locator(MultipleLocator(step))
    axes.tick_params(length=0, labelsize=8.5, labelcolor=_QUIET)
    axes.grid(color=_FAINT, lw=0.7)
    axes.spines[:].set_visible(False)
    left = _LEFT / width
    figure.text(left, 1 - 0.42 / height, card.name, fontsize=15, weight="bold", color=_INK)
    figure.text(left, 1 - 0.70 / height, headline(card), fontsize=9.2, color=_QUIET)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(left, 0.08 / height),
        bbox_transform=figure.transFigure,
        borderaxespad=0,
        borderpad=0,
        ncols=4,
        frameon=False,
        fontsize=9,
        labelcolor=_INK,
        handlelength=1.8,
        columnspacing=1.8,
    )


def headline(card: Scorecard) -> str:
    """The few figures that matter most, in one line."""
    ate, online = card.quantities["ate_final"], card.quantities["ate_online"]
    parts = [f"{card.quantities['experiences'].value} experiences"]
    if ate.value is None:
        parts.append("no ground truth")
    else:
        parts.append(
            f"ATE {ate.value:.3g} m final, {online.value:.3g} m online, {ate.odometry:.3g} m raw odometry"
        )
    arr, arcr = card.quantities["exm_arr"].value, card.quantities["exm_arcr_strict"].value
    parts += [] if arr is None else [f"ARR {arr:.2f}"]
    parts += [] if arcr is None else [f"ARCR {arcr:.2f}"]
    return "  ·  ".join(parts)
