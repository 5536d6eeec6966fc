"""Figures of the papers' reproductions, drawn from arrays."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from evaluation.metrics.exm import ExperienceMetric, creation_rows
from evaluation.plots import style
from evaluation.plots.style import BLUE, GREEN, GREY, INK, LINE_GREY, PURPLE, VERMILLION, YELLOW
from evaluation.studies.metrics import ViewDifferences

_SERIES_COLORS = (GREY, BLUE, VERMILLION, GREEN, PURPLE, YELLOW)
"""Colours of the compared series, in this order."""
_GAP, _BOTTOM = 0.75, 0.9  # inches between panels, and below them
_DOTS = (0, (2, 2))
_MEDIAN = 0.3  # half width of a median bar, share of a condition's width


def draw_drift(
    title: str, line: str, paths: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> style.Figure:
    """Draws true path and odometry side by side for several kinds of odometry error; later laps are darker
    (Salman & Pearson 2016, Fig. 2).

    Args:
        paths: by kind, true and dead-reckoned positions [T, 2] from the same start, m, and the number of the
            lap [T], from 0.
    """
    figure, panels = _panels(title, line, paths, 3.2)
    for axes, (truth, odometry, lap_of) in zip(panels, paths.values(), strict=True):
        axes.plot(*truth.T, ".", ms=3, color=INK, zorder=3, label="truth")
        laps = np.unique(lap_of)
        for lap in laps:
            rows = lap_of == lap
            shade = 0.3 + 0.7 * (lap + 1) / len(laps)
            label = "odometry, later laps darker" if lap == laps[-1] else None
            axes.plot(*odometry[rows].T, "-", lw=1.2, color=VERMILLION, alpha=shade, label=label)
        axes.plot(*truth[0], "o", ms=9, mfc="none", mec=GREEN, mew=1.8, zorder=6, label="start")
        _map_axes(axes)
    return style.add_legend(figure, panels[0])


def draw_experiences(
    title: str, line: str, runs: Mapping[str, tuple[np.ndarray, ExperienceMetric | None]]
) -> style.Figure:
    """Draws the experience at each step, the end of the base set and the verdicts (Fig. 3).

    Args:
        runs: by name, the current experience at each of T steps, [T], -1 for none, and the verdict of the
            Experience Metric; None: no step is a re-localisation.
    """
    figure, panels = _panels(title, line, runs, 3.4)
    for axes, (place, metric) in zip(panels, runs.values(), strict=True):
        known = place >= 0
        # [T] whether a step is a re-localisation, a correct one, and of an experience that is invalid: the
        # last re-localisation before it was created was wrong. Steps of the base set.
        counted, right, invalid, base = *np.zeros((3, len(place)), bool), 0
        if metric is not None:
            counted[known], right[known] = metric.counted, metric.right
            last = np.maximum.accumulate(np.where(counted, np.arange(len(counted)), -1))
            wrong = (last >= 0) & ~right[last]
            invalid[known] = wrong[creation_rows(place[known])]
            base = int(np.flatnonzero(known)[metric.base - 1]) + 1
        new = known & ~counted
        for rows, color, mark, label in (
            (new & ~invalid, GREY, "o", "valid experience"),
            (new & invalid, YELLOW, "o", "invalid experience"),
            (counted & right, BLUE, "o", "correct re-localisation"),
            (counted & ~right, VERMILLION, "x", "incorrect re-localisation"),
        ):
            steps = np.flatnonzero(rows)
            axes.plot(steps, place[steps], mark, ms=2.6 if mark == "o" else 3.6,
                      mew=0.9 if mark == "x" else 0, color=color, label=label)  # fmt: skip
        axes.axvline(base - 0.5, color=INK, lw=1.1, ls=_DOTS, label="end of the base set")
        style.name_axes(axes, "step", "experience")
    return style.add_legend(figure, panels[0], columns=3)


def draw_measured(
    title: str,
    line: str,
    conditions: Sequence[str],
    measured: Sequence[tuple[str, Mapping[str, np.ndarray], np.ndarray, bool]],
) -> style.Figure:
    """Draws a dot per data set, a bar for the median, a line for the paper's value (Figs. 4, 6 and 7).

    Args:
        measured: of each quantity, its label with unit, values [C, S] over conditions and data sets by
            series, values [C] of the paper, NaN for none, and whether to use a logarithmic axis.
    """
    figure, panels = _panels(title, line, [label for label, *_ in measured], 3.4, below=1.3)
    for axes, (_, series, printed, logarithmic) in zip(panels, measured, strict=True):
        count = len(series)
        for k, (name, values) in enumerate(series.items()):
            at = np.arange(len(conditions)) + (k - (count - 1) / 2) * 0.8 / max(count, 1)
            color = _SERIES_COLORS[k % len(_SERIES_COLORS)]
            where = np.repeat(at, values.shape[1])
            axes.plot(where, values.reshape(-1), "o", ms=4, mew=0, alpha=0.6, color=color, label=name)
            some = np.isfinite(values).any(axis=1)
            middle = [np.nanmedian(row) for row in values[some]]
            half = _MEDIAN / max(count, 1)
            axes.hlines(middle, at[some] - half, at[some] + half, color=color, lw=2.2)
        given = np.isfinite(printed)
        if given.any():
            where, paper = np.flatnonzero(given), printed[given]
            axes.hlines(paper, where - 0.42, where + 0.42, color=INK, lw=1.1, ls=_DOTS, label="paper")
        names = [name.replace(", ", ",\n") for name in conditions]
        axes.set_xticks(range(len(conditions)), names, rotation=55, ha="right", rotation_mode="anchor")
        axes.set_xlim(-0.6, len(conditions) - 0.4)
        if logarithmic:
            axes.set_yscale("log")
            axes.tick_params(which="minor", length=0)
        else:
            axes.set_ylim(bottom=0)
        axes.grid(False, axis="x")
    fullest = max(panels, key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    return style.add_legend(figure, fullest)


def draw_directions(title: str, line: str, maps: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> style.Figure:
    """Draws mapped paths, with clockwise and anticlockwise laps in different colours (Fig. 5).

    Args:
        maps: by name, positions [T, 2] (m) and whether each step is in a clockwise lap [T].
    """
    figure, panels = _panels(title, line, maps, 3.2, across=min(2, len(maps)))
    for axes, (position, clockwise) in zip(panels, maps.values(), strict=True):
        laps = ((clockwise, VERMILLION, "clockwise"), (~clockwise, GREEN, "anticlockwise"))
        for rows, color, label in laps:
            part = np.where(rows[:, None], position, np.nan)
            axes.plot(*part.T, "-", lw=1.0, alpha=0.7, color=color, label=label)
        _map_axes(axes)
    return style.add_legend(figure, panels[0])


def draw_curves(
    title: str, line: str, curves: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]
) -> style.Figure:
    """Draws ARR against ARCR for increasing thresholds, one curve per data set.

    Args:
        curves: by panel and condition, ARCR and ARR [S, B] over data sets and thresholds.
    """
    figure, panels = _panels(title, line, curves, 3.6)
    for axes, conditions in zip(panels, curves.values(), strict=True):
        for color, (name, (arcr, arr)) in zip(_SERIES_COLORS[1:], conditions.items(), strict=False):
            for number, (x, y) in enumerate(zip(arcr, arr, strict=True)):
                axes.plot(x, y, "o-", ms=3, lw=0.9, alpha=0.7, color=color, label=None if number else name)
        axes.set(xlim=(-0.04, 1.04), ylim=(0, None))
        style.name_axes(axes, "ARCR, strict", "ARR")
    return style.add_legend(figure, panels[0])


def draw_tuning(views: ViewDifferences, scores: np.ndarray, winner: float | None) -> style.Figure:
    """Draws histograms of view differences at the same and at different places, and results by threshold.

    Args:
        scores: [3, G] thresholds, correct and incorrect re-localisations. winner: chosen threshold, if any.
    """
    threshold, correct, incorrect = scores
    taken = "no threshold meets the target" if winner is None else f"threshold {winner:g}"
    line = f"AUC {views.auc:.3f}  ·  {taken}"
    figure, (left, right) = _panels("Tuning of the classic matcher", line, ("", ""), 3.4)
    pairs = (views.same, BLUE, "same place"), (views.other, VERMILLION, "different places")
    for count, color, label in pairs:
        share = count / max(count.sum(), 1)
        left.stairs(share, views.edge, color=color, fill=True, alpha=0.45, label=label)
    style.name_axes(left, "difference of two views", "share of pairs")
    right.plot(threshold, correct, "o-", ms=3, lw=1.0, color=GREEN, label="correct")
    right.plot(threshold, incorrect, "x-", ms=4, lw=1.0, color=PURPLE, label="incorrect")
    style.name_axes(right, "threshold", "re-localisations")
    if winner is not None:
        for axes in (left, right):
            axes.axvline(winner, color=INK, lw=1.1, ls=_DOTS, label="chosen")
    right.legend(frameon=False, fontsize=9, labelcolor=INK)
    return style.add_legend(figure, left)


def _panels(
    title: str, line: str, names: Collection[str], height: float, *, across: int = 0, below: float = _BOTTOM
) -> tuple[style.Figure, list[style.Axes]]:
    """A figure with a panel of a height in inches for each name, `across` per row (0: all), with a grid."""
    across = across or len(names)
    rows = -(-len(names) // across)
    whole = style.TOP + rows * height + (rows - 1) * _GAP + below
    figure = style.new_figure(whole, title, line)
    width = (style.WIDTH - style.LEFT - style.RIGHT - (across - 1) * _GAP) / across
    panels = []
    for number, name in enumerate(names):
        row, column = divmod(number, across)
        left = style.LEFT + column * (width + _GAP)
        bottom = whole - style.TOP - (row + 1) * height - row * _GAP
        panels.append(style.add_axes(figure, left, bottom, width, height - 0.2))
        panels[-1].set_title(name, fontsize=9.5, color=INK, loc="left")
        panels[-1].grid(color=LINE_GREY, lw=0.7)
    return figure, panels


def _map_axes(axes: style.Axes) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.locator_params(steps=[1, 2, 5, 10])  # short tick labels
    style.name_axes(axes, "x (m)", "y (m)")
