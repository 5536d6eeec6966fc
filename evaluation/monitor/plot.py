"""Plot of a running job: path, current pose and outcomes of its steps."""

from __future__ import annotations

import numpy as np

from evaluation.metrics.trajectory import align
from evaluation.monitor.progress import RunProgress, step_count
from evaluation.plots import style
from evaluation.plots.map_plot import NO_WALLS, draw_walls, split_at_jumps
from evaluation.plots.style import BLUE, GREY, LABEL_GREY, LINE_GREY, VERMILLION, WIDTH, YELLOW
from tactile.base.se2 import between, compose

_HEIGHT, _BOTTOM, _COUNTS = 6.4, 0.95, 1.55  # inches: total height, below the map, and width of the counts
_DRAWN = 5000  # steps drawn of a long path, to limit the drawing time
_ROUND = 2 * np.pi * np.arange(49) / 48


def draw_watch(seen: RunProgress, walls: np.ndarray = NO_WALLS) -> style.Figure:
    """The online path over the truth, and the last pose with an ellipse of two standard deviations.

    With truth, everything is in its frame: the online path by the best rigid fit so far, odometry by its
    start pose. Odometry that drifts far off leaves the picture.

    Args:
        walls: [B, 5] west, south, east, north, height in m; drawn with truth.
    """
    figure = style.new_figure(_HEIGHT, seen.name, _line(seen))
    inner = WIDTH - style.LEFT - style.RIGHT - _COUNTS
    axes = style.add_axes(figure, style.LEFT, _BOTTOM, inner, _HEIGHT - style.TOP - _BOTTOM)
    axes.set_aspect("equal", adjustable="datalim")
    if len(seen.path):
        _paint(axes, seen, walls)
    axes.apply_aspect()
    style.metre_grid(axes, style.TRUTH if np.isfinite(seen.truth).any() else style.MAP)
    _paint_counts(figure, seen, style.LEFT + inner + 0.25)
    if len(seen.path):
        style.add_legend(figure, axes)
    return figure


def _line(seen: RunProgress) -> str:
    parts = [seen.status, step_count(seen)]
    if len(seen.path):
        x, y, turn = seen.sd
        parts.append(f"last pose ± {x:.2g} m, {y:.2g} m, {np.degrees(turn):.2g} degrees")
    parts += [] if seen.online_error is None else [f"error {seen.online_error:.3g} m"]
    return "  ·  ".join(parts)


def _paint(axes: style.Axes, seen: RunProgress, walls: np.ndarray) -> None:
    """Draws the layers in the order of the legend."""
    known = np.isfinite(seen.truth).all(axis=1)
    to_truth = align(seen.path[known], seen.truth[known]) if known.any() else np.zeros(3)
    rows = np.arange(len(seen.path) - 1, -1, -len(seen.path) // _DRAWN)[::-1]  # includes the last one
    path, truth = compose(to_truth, seen.path), seen.truth[rows]
    if known.any():
        if len(walls):
            draw_walls(axes, walls)
        axes.plot(*split_at_jumps(truth, truth).T, color=YELLOW, lw=3.5, zorder=2, label="truth")
    axes.plot(*split_at_jumps(path[rows, :2], truth).T, color=BLUE, lw=0.9, zorder=4, label="online path")
    _paint_now(axes, seen, to_truth)
    axes.margins(0.08)
    axes.apply_aspect()
    axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim(), adjustable="box")  # odometry may leave the plot
    reckoned = compose(compose(path[0], between(seen.odometry[0], np.zeros(3))), seen.odometry[rows])
    dashed = (0, (5, 3))
    axes.plot(*reckoned[:, :2].T, color=GREY, lw=0.8, ls=dashed, zorder=1, label="odometry")


def _paint_now(axes: style.Axes, seen: RunProgress, to_truth: np.ndarray) -> None:
    x, y, heading = compose(to_truth, seen.path[-1])
    around = np.column_stack([np.cos(_ROUND), np.sin(_ROUND)]) * 2 * seen.sd[:2]
    ellipse = compose(to_truth, np.column_stack([seen.path[-1, :2] + around, np.zeros(len(_ROUND))]))
    label = "current pose, 2 standard deviations"
    axes.plot(*ellipse[:, :2].T, color=VERMILLION, lw=1.2, zorder=6, label=label)
    ahead = (3, 0, float(np.degrees(heading)) - 90.0)
    axes.plot(x, y, color=VERMILLION, ls="", marker=ahead, ms=11, mec="white", mew=0.8, zorder=7)


def _paint_counts(figure: style.Figure, seen: RunProgress, left: float) -> None:
    """Number of steps by outcome, right of the map."""
    counts = sorted(seen.outcomes.items(), key=lambda item: -item[1])
    counts += [("lost", seen.lost)] if seen.lost else []
    steps = max(1, len(seen.path))
    for row, (name, count) in enumerate(counts):
        low = _HEIGHT - style.TOP - 0.45 * (row + 1)
        bar = style.add_axes(figure, left, low, _COUNTS - 0.3, 0.1)
        bar.barh([0, 0], [1, count / steps], color=[LINE_GREY, GREY if name == "ok" else BLUE])
        bar.set(xlim=(0, 1), ylim=(-0.4, 0.4), xticks=[], yticks=[])
        bar.set_title(f"{name}  {count} steps", fontsize=8.5, color=LABEL_GREY, loc="left", pad=2)
