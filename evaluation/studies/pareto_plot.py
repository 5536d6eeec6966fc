"""Plot of error against time per cycle for several configurations, with the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evaluation.plots import style
from evaluation.plots.style import BLUE, GREY, INK, LABEL_GREY, VERMILLION, WIDTH

_TALL, _EACH, _BOTTOM = 4.4, 0.13, 0.95  # inches: height of the axes, extra per point beyond 12, below
_FLOOR = 0.5  # an error of 0 is drawn at this share of the least positive error
# Pixels: grid of label positions, gap around labels (across, up), distance from which a line is drawn.
_GRID, _GAP, _NEAR = 3.0, (5.0, 2.0), 14.0
# Cost, in pixels of distance, of a label that crosses a bar, or is nearer to another point.
_CROSSING, _MISTAKEN = 8.0, 16.0
_SIZE = 7.6  # of labels, points


class ParetoPoint(NamedTuple):
    """One configuration.

    Attributes:
        name: its label. time, error: (minimum, median, maximum) over seeds. optimal: on the Pareto front.
    """

    name: str
    time: tuple[float, float, float]
    error: tuple[float, float, float]
    optimal: bool


def draw_pareto(title: str, line: str, marks: Sequence[ParetoPoint], time: str, error: str) -> style.Figure:
    """Draws the points on logarithmic axes, with bars from minimum to maximum over seeds.

    Args:
        marks: at least one point. time, error: axis labels with units.
    """
    inner = WIDTH - style.LEFT - style.RIGHT
    tall = _TALL + _EACH * max(0, len(marks) - 12)
    figure = style.new_figure(style.TOP + tall + _BOTTOM, title, line)
    axes = style.add_axes(figure, style.LEFT, _BOTTOM, inner, tall)
    spans = np.array([[mark.time, mark.error] for mark in marks])  # [N, 2, 3]
    positive = spans[:, 1][spans[:, 1] > 0]
    floor = _FLOOR * positive.min() if len(positive) else 1.0
    spans[:, 1] = np.maximum(spans[:, 1], floor)
    best = np.array([mark.optimal for mark in marks])
    style.log_axes(axes, spans[:, 0], spans[:, 1])
    _paint(axes, spans, best)
    none = bool((spans[:, 1] == floor).any())
    style.name_axes(axes, time, f"{error}{', 0 at the bottom' if none else ''}")
    style.add_legend(figure, axes)
    _label(axes, [mark.name for mark in marks], spans, best)
    return figure


def place_labels(
    size: np.ndarray, anchor: np.ndarray, area: np.ndarray, blocked: np.ndarray, crossed: np.ndarray
) -> np.ndarray:
    """Places labels one after the other, each at the free position nearest to its anchor.

    Labels overlap neither each other nor blocked boxes while the area has room; after that, a label goes
    where it hides the least.

    Args:
        size: [N, 2] size of the labels. anchor: [N, 2] points that they belong to. area: [4] left, bottom,
            right, top. blocked: [M, 4] boxes not to cover. crossed: [L, 4] boxes to avoid.

    Returns:
        [N, 2] lower left corners.
    """
    room = np.array([-_GAP[0], -_GAP[1], _GAP[0], _GAP[1]])
    taken, corners = list(np.asarray(blocked, float) + room / 2), np.zeros((len(size), 2))
    anchor = np.asarray(anchor, float)
    for k, ((width, height), at) in enumerate(zip(size, anchor, strict=True)):
        x = np.arange(area[0], max(area[2] - width, area[0]) + 1e-9, _GRID)
        y = np.arange(area[1], max(area[3] - height, area[1]) + 1e-9, _GRID)
        spots = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        boxes = np.concatenate([spots, spots + [width, height]], axis=1)
        away = _away(boxes, anchor)
        cost = away[:, k] + _MISTAKEN * (np.delete(away, k, axis=1) < away[:, k : k + 1]).sum(axis=1)
        # At equal distance, a label beside the point reads better than one above it.
        cost += 0.02 * np.abs((boxes[:, 1] + boxes[:, 3]) / 2 - at[1])
        cost += _CROSSING * (_overlap(boxes, np.reshape(crossed, (-1, 4))) > 0).sum(axis=1)
        hidden = _overlap(boxes, np.reshape(taken, (-1, 4))).sum(axis=1)
        chosen = np.lexsort((cost, hidden))[0]
        corners[k] = spots[chosen]
        taken.append(boxes[chosen] + room)
    return corners


def _away(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances [N, M] from boxes to points, pixels."""
    low, high = boxes[:, None, :2] - points, points - boxes[:, None, 2:]
    return np.hypot(*np.moveaxis(np.maximum(np.maximum(low, high), 0.0), -1, 0))


def _overlap(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[N, M] area of each box that each other box covers, pixels squared."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return np.maximum(high - low, 0.0).prod(axis=2)


def _front(axes: style.Axes, spans: np.ndarray, best: np.ndarray) -> np.ndarray:
    """The corners [P, 2] of the staircase of the Pareto front, up to the right end; [0, 2] without points."""
    front = spans[best][:, :, 1]
    if not len(front):
        return front
    front = front[np.lexsort((front[:, 1], front[:, 0]))]
    end = np.array([[axes.get_xlim()[1], front[-1, 1]]])
    across = np.stack([np.append(front[1:, 0], end[0, 0]), front[:, 1]], axis=1)  # first right, then down
    return np.stack([front, across], axis=1).reshape(-1, 2)


def _paint(axes: style.Axes, spans: np.ndarray, best: np.ndarray) -> None:
    time, error = spans[:, 0], spans[:, 1]
    front = _front(axes, spans, best)
    if len(front):
        axes.plot(*front.T, color=VERMILLION, lw=1.3, label="Pareto front", zorder=2)
    for some, color, size, name in ((best, BLUE, 5.5, "Pareto-optimal"), (~best, GREY, 4.5, "dominated")):
        if some.any():
            bars = [np.abs(values[some][:, [0, 2]] - values[some][:, 1:2]).T for values in (time, error)]
            axes.errorbar(
                time[some, 1], error[some, 1], xerr=bars[0], yerr=bars[1], fmt="o", ms=size, mew=0,
                color=color, elinewidth=0.9, alpha=0.95, zorder=4 if some is best else 3, label=name,
            )  # fmt: skip


def _label(axes: style.Axes, names: Sequence[str], spans: np.ndarray, best: np.ndarray) -> None:
    """Labels the points, the optimal ones first; distant labels get a line to their point."""
    from matplotlib.patheffects import withStroke

    size = _SIZE * axes.figure.dpi / 72
    halo = [withStroke(linewidth=2.0, foreground="white")]
    texts = [
        axes.annotate(
            name, (0, 0), xycoords="figure pixels", fontsize=_SIZE, path_effects=halo, zorder=5,
            color=INK if top else LABEL_GREY,
        )
        for name, top in zip(names, best, strict=True)
    ]  # fmt: skip
    boxes = [text.get_window_extent() for text in texts]
    sizes = np.array([[box.width, box.height] for box in boxes])
    at = axes.transData.transform(spans[:, :, 1])
    low, high = axes.transData.transform(spans[:, :, 0]), axes.transData.transform(spans[:, :, 2])
    stairs = axes.transData.transform(_front(axes, spans, best).reshape(-1, 2))
    dots = np.concatenate([at - size / 2.2, at + size / 2.2], axis=1)
    ends = np.minimum(stairs[1:], stairs[:-1]) - 1, np.maximum(stairs[1:], stairs[:-1]) + 1
    blocked = np.concatenate([dots, np.concatenate(ends, axis=1)])
    across = np.stack([low[:, 0], at[:, 1] - 1, high[:, 0], at[:, 1] + 1], axis=1)
    up = np.stack([at[:, 0] - 1, low[:, 1], at[:, 0] + 1, high[:, 1]], axis=1)
    bars = np.concatenate([across, up])
    order = np.lexsort((at[:, 0], ~best))
    frame = np.array(axes.get_window_extent().extents)
    corners = place_labels(sizes[order], at[order], frame, blocked, bars)
    for k, corner in zip(order, corners, strict=True):
        texts[k].xyann = tuple(corner - [boxes[k].x0, boxes[k].y0])
        near = np.clip(at[k], corner, corner + sizes[k])
        away = _away(np.concatenate([corner, corner + sizes[k]])[None], at)[0]
        if away[k] > min(_NEAR, 1.5 * np.delete(away, k).min(initial=np.inf)):
            axes.annotate(
                "", at[k], near, xycoords="figure pixels", textcoords="figure pixels",
                arrowprops={"arrowstyle": "-", "color": GREY, "lw": 0.6, "shrinkA": 0, "shrinkB": 3},
            )  # fmt: skip
