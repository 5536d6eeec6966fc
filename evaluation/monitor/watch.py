"""Live progress of a run in another process: an image and a status line.

It only reads the run directory, so it does not slow the run (Fox et al. 2012, II-D: monitors are separate
processes).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from evaluation.artifacts.manifest import RUNNING
from evaluation.artifacts.run_reader import read_walls
from evaluation.metrics.run_metrics import DOUBTED
from evaluation.metrics.trajectory import align
from evaluation.monitor.run_progress import WATCH_IMAGE, RunMonitor, RunProgress, step_count
from evaluation.plots import style
from evaluation.plots.map_plot import NO_WALLS, draw_walls, split_at_jumps
from evaluation.plots.style import BLUE, GREY, LABEL_GREY, LINE_GREY, VERMILLION, WIDTH, YELLOW
from tactile.base.atomic_write import write_atomically
from tactile.base.errors import os_errors_of
from tactile.base.se2 import between, compose

SILENCE_LIMIT = 300.0
"""A run without output for this long counts as killed, s; compiling and the final plots take less."""
SILENCE_SHOWN = 10.0
"""The status line reports silence longer than this, s."""
REST_FACTOR = 9.0
"""Pause as a multiple of the working time; limits the monitor to a tenth of a processor core."""


def watch_run(
    directory: Path,
    report: Callable[[str], None],
    *,
    every: float = 2.0,
    patience: float = SILENCE_LIMIT,
    once: bool = False,
) -> RunProgress:
    """Updates watch.png in a run directory and reports the status, until the run ends.

    Args:
        report: called with the status line after each update. every: least time between updates, s.
        patience: silence after which the run counts as killed, s. once: whether to stop after one update.

    Returns:
        the last state.

    Raises:
        InputError: the directory holds no run or cannot be written to.
    """
    monitor, before, last = RunMonitor(directory), None, 0.0
    while True:
        began = time.monotonic()
        seen = monitor.read()
        pace = seen.rate
        if before is not None and seen.status == RUNNING:
            pace = (len(seen.path) - len(before.path)) / (began - last)
        if before is None or (len(seen.path), seen.status) != (len(before.path), before.status):
            figure, file = draw_watch(seen, read_walls(directory)), directory / WATCH_IMAGE
            with os_errors_of(file, "cannot be written", "a run directory that can be written to"):
                write_atomically(file, figure.savefig)
        report(status_line(seen, pace))
        if once or seen.status != RUNNING or seen.silence > patience:
            return seen
        before, last = seen, began
        time.sleep(max(every, REST_FACTOR * (time.monotonic() - began)))


def status_line(seen: RunProgress, pace: float | None) -> str:
    """The state of a run in one line; `pace` is in steps per second."""
    parts = [f"{seen.name}: {seen.status}", step_count(seen), f"{path_length(seen.odometry):.1f} m"]
    parts += [] if pace is None else [f"{pace:.0f} steps/s"]
    parts += [] if seen.online_error is None else [f"error {seen.online_error:.3g} m"]
    parts += [f"{count} {name}" for name, count in sorted(seen.outcomes.items(), key=lambda item: -item[1])]
    parts += [f"{seen.lost} lost"] if seen.lost else []
    parts += [f"map_doubted ({seen.doubt:.0%})"] if (seen.doubt or 0.0) > DOUBTED else []
    parts += [f"input warned ({len(seen.warnings)})"] if seen.warnings else []
    parts += [f"checkpoint at {seen.checkpoint}"] if seen.checkpoint else []
    if seen.status == RUNNING and seen.silence > SILENCE_SHOWN:
        parts.append(f"silent for {seen.silence:.0f} s")
    return ", ".join(parts)


def path_length(odometry: np.ndarray) -> float:
    """Length of the path by odometry [N, 3] from the start of the run, m."""
    return float(np.hypot(*np.diff(odometry[:, :2], axis=0, prepend=np.zeros((1, 2))).T).sum())


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
