"""What `fit` finds in real records: errors of real wheels, half against half, and whiskers of an arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaluation.metrics.trajectory import ate
from evaluation.papers.figure import Figure
from evaluation.papers.tables.markdown import markdown_row, table_lines
from evaluation.papers.tables.recordings import REACH, require_recordings
from evaluation.plots import style
from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import load_config
from ratslam.service.record_fit import read_signals_of_reach
from ratslam.service.rig_fit import WheelFit, fit_wheels
from robot.sources.in_memory import load_into_memory, select_rows
from robot.sources.odometry import UNCORRECTED, correct_motions
from tactile.base.plugins import PluginConfig
from tactile.base.se2 import compose, fit_rigid_motion, integrate
from tactile.rig_signals import SignalFit, SignalRecord, fit_signals

RECORDS = {
    "real Create": ("create_lab", "data/create_lab_odometry.csv"),
    "Intel lab": ("intel_laser", "data/intel_odom_gt.csv"),
    "lecture hall": ("tuc_lecture_hall", "data/tuc_lecture_hall_odom.csv"),
    "Acapulco": ("building", "buildings/acapulco_odom_gt.csv"),
    "ACES": ("building", "buildings/aces_odom_gt.csv"),
    "Belgioioso": ("building", "buildings/belgioioso_odom_gt.csv"),
    "Freiburg 101": ("building", "buildings/freiburg_101_odom_gt.csv"),
}
"""Configuration and odometry of each record with truth."""
CREATE = "real Create"
"""The record that is drawn."""
VALUES = {
    "length_scale": (1.0, "distance, true / measured"),
    "turn_scale": (1.0, "turn, true / measured"),
    "heading_bias": (0.0, "heading bias, rad/m"),
}
"""The quantities of the table: what is assumed, and the label of the axis."""


_Record = tuple[list[WheelFit], list[tuple[np.ndarray, ...]]]
"""The wheels of a record: fitted on all of it and on each half; of each half, its true path and the paths by
odometry, as recorded and corrected by the fit of the other, [N, 3]."""
_Rigs = tuple[dict[str, _Record], SignalRecord, SignalFit]
"""All records, and the whiskers of the arm."""


def _measure(folder: Path) -> _Rigs:
    """Fits all records below the folder of the real recordings."""
    require_recordings(folder, REACH, *(file for _, file in RECORDS.values()))
    records = {name: _measure_wheels(name, folder) for name in RECORDS}
    signals = read_signals_of_reach(
        PluginConfig(plugin="whisker_reach", settings={"file": str(folder / REACH)})
    )
    return records, signals, fit_signals(signals)


def _measure_wheels(name: str, folder: Path) -> _Record:
    packaged, file = RECORDS[name]
    config = load_config(packaged, [f"recording.file={folder / file}"])
    with open_source(config) as source:
        log = load_into_memory(source)
    half = log.length // 2
    halves = [select_rows(log, rows) for rows in (np.arange(half), np.arange(half, log.length))]
    fits = []
    for part in (log, *halves):
        assert part.truth is not None
        fits.append(fit_wheels(part.time, part.motion[:, :3], part.truth))
    paths = list[tuple[np.ndarray, ...]]()
    for part, fit in zip(halves, fits[:0:-1], strict=True):
        truth = np.asarray(part.truth)
        known = np.isfinite(truth).all(axis=1)
        ways = (correct_motions(each, part.motion[:, :3]) for each in (UNCORRECTED, fit.correction))
        paths.append((truth[known], *(integrate(motion)[known] for motion in ways)))
    return fits, paths


def _errors(records: dict[str, _Record]) -> np.ndarray:
    """[N, 2, 2] ATE of dead reckoning of N records, their halves, as recorded and corrected, m."""
    every = [paths for _, paths in records.values()]
    return np.array([[[ate(path, true) for path in found] for true, *found in paths] for paths in every])


def _table(result: _Rigs) -> list[str]:
    """The wheels by record and half, dead reckoning before and after, and the whiskers of the arm."""
    records, signals, whiskers = result
    wheels = []
    for name, (fits, _) in records.items():
        found = [[getattr(fit, key) for fit in fits] for key in VALUES]
        texts = [
            ["unknown" if pair is None else "{:.3f} ± {:.3f}".format(*pair) for pair in pairs]
            for pairs in found
        ]
        wheels.append([name, *map("; ".join, texts)])
    reckoned = (
        [name, *(f"{error:.2f}" for error in errors.flat)]
        for name, errors in zip(records, _errors(records), strict=True)
    )
    halves = table_lines(
        ["Dead reckoning (ATE, m) of each half: as recorded, and with what the other half tells."],
        ("record", "first half", "corrected by the second", "second half", "corrected by the first"),
        reckoned,
        _whisker_lines(signals, whiskers),
    )
    above = "Wheels: each quantity of the whole record, and of its first and second half."
    columns = "record", "true over measured distance", "true over measured turn", "heading bias, rad/m"
    return table_lines([above], columns, wheels, halves)


def _whisker_lines(signals: SignalRecord, fit: SignalFit) -> list[str]:
    unit = signals.unit
    lines = [
        "An arm in clutter: medians over the three channels of each whisker.",
        "",
        f"| whisker | noise, {unit} | white part, {unit} | correlation | drift, {unit}/sqrt(s) "
        "| in contact | |",
        "|---|---|---|---|---|---|---|",
    ]
    for k, name in enumerate(signals.names):
        noise, white, colour, drift = (
            float(np.median(column[k])) for column in (fit.noise, fit.white, fit.correlation, fit.drift)
        )
        cells = [name, *(f"{value:.2f}" for value in (noise, white, colour))]
        cells += ["unknown" if np.isnan(drift) else f"{drift:.2g}", f"{signals.contact[k]:.0%}"]
        lines.append(markdown_row([*cells, fit.dirty.get(k, "")]))
    lines += [
        "",
        "The standard deviations are of one record by blocks of time; they do not contain what differs from "
        "one session to the next. A correction takes over what differs from 1 or 0 by more than two of them: "
        "half of the Create's record does not tell enough. This rule was chosen on these records, after one "
        "without it made Belgioioso worse; no record is left to confirm it.",
        "",
        "The drift of a whisker that touches is unknown: its contacts change its signal more. No recording "
        "of real whiskers has arm poses and walls: rest angle and radii are shown on simulated heads only "
        "(tactile/README.md).",
    ]
    return lines


def _draw(result: _Rigs, png: Path) -> None:
    """The quantities with their intervals, dead reckoning before and after, two paths, and the whiskers."""
    records, signals, whiskers = result
    title = "What a record tells of its rig"
    line = "Wheels against truth, half against half; noise of the whiskers of an arm in clutter"
    figure = style.new_figure(9.6, title, line)
    for k, key in enumerate(VALUES):
        _draw_intervals(style.add_axes(figure, 1.25 + 2.25 * k, 6.25, 1.95, 2.15), records, key, k == 0)
    fits, paths = records[CREATE]
    for k, half in enumerate(("first half", "second half")):
        other = fits[2 - k].correction
        how = ", corrected by the other" if other != UNCORRECTED else ": the other is not sure"
        _draw_paths(style.add_axes(figure, 0.62 + 2.45 * k, 3.35, 2.2, 2.2), paths[k], half + how)
    _draw_ate(style.add_axes(figure, 5.75, 3.45, 1.95, 2.05), records)
    _draw_whiskers(style.add_axes(figure, 0.75, 0.7, 6.9, 1.6), signals, whiskers)
    figure.savefig(png)


def _draw_intervals(axes: style.Axes, records: dict[str, _Record], key: str, named: bool) -> None:
    assumed, label = VALUES[key]
    axes.axvline(assumed, color=style.GREY, lw=1)
    colours = (style.INK, style.BLUE, style.VERMILLION)
    for row, (fits, *_) in enumerate(records.values()):
        for part, (fit, colour) in enumerate(zip(fits, colours, strict=True)):
            value, sd = getattr(fit, key) or (np.nan, 0.0)
            at = -row - 0.22 * (part - 1)
            axes.errorbar(value, at, xerr=2 * sd, fmt="o", ms=3, lw=1.2, color=colour)
    ticks = [-row for row in range(len(records))]
    axes.set_yticks(ticks, list(records) if named else [""] * len(ticks))
    axes.set_xlabel(label, color=style.LABEL_GREY, fontsize=9)
    axes.grid(axis="x", color=style.LINE_GREY, lw=0.7)
    if named:
        words, offset = ("whole", "first half", "second half"), ("axes fraction", "offset points")
        for colour, word, at in zip(colours, words, (0, 0.8, 1.8), strict=True):
            axes.annotate(word, (0, 1), (72 * (at - 0.3), 6), *offset, color=colour, fontsize=8.5)


def _draw_paths(axes: style.Axes, paths: tuple[np.ndarray, ...], label: str) -> None:
    words = ("truth", style.GREY, 3.0), ("as recorded", style.VERMILLION, 1.0), ("corrected", style.BLUE, 1.0)
    truth, *found = paths
    aligned = truth, *(compose(fit_rigid_motion(path, truth), path) for path in found)
    for path, (word, colour, width) in zip(aligned, words, strict=True):
        axes.plot(path[:, 0], path[:, 1], color=colour, lw=width, label=word)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(label, fontsize=9, color=style.INK, loc="left")
    style.name_axes(axes, "Create: x, m", "y, m")
    axes.legend(
        frameon=False, fontsize=8, labelcolor="linecolor", loc="upper left", handlelength=0, ncols=3,
        bbox_to_anchor=(-0.12, -0.17), columnspacing=0.6,
    )  # fmt: skip


def _draw_ate(axes: style.Axes, records: dict[str, _Record]) -> None:
    """Dead reckoning of both halves, before against after."""
    before, after = np.moveaxis(_errors(records), -1, 0)
    style.log_axes(axes, np.concatenate([before, after]), np.concatenate([before, after]))
    low, high = axes.get_xlim()
    axes.plot([low, high], [low, high], color=style.GREY, lw=1)
    for k, name in enumerate(records):
        colour = style.VERMILLION if name == CREATE else style.BLUE
        axes.plot(before[k], after[k], "o", ms=4.5, color=colour, alpha=0.85)
    axes.set_title("dead reckoning, Create in red", fontsize=9, color=style.INK, loc="left")
    style.name_axes(axes, "ATE as recorded, m", "ATE corrected, m")


def _draw_whiskers(axes: style.Axes, signals: SignalRecord, fit: SignalFit) -> None:
    at = np.arange(len(signals.names))
    for channel, shift in enumerate((-0.25, 0.0, 0.25)):
        labels = ("noise", "white part") if channel == 0 else (None, None)
        axes.bar(at + shift, fit.noise[:, channel], 0.22, color=style.BLUE, alpha=0.45, label=labels[0])
        axes.bar(at + shift, fit.white[:, channel], 0.22, color=style.BLUE, label=labels[1])
    for k in fit.dirty:
        axes.annotate(
            "dirty free record", (k + 0.4, 1.12 * fit.noise.max()), ha="right", fontsize=8.5,
            color=style.VERMILLION,
        )  # fmt: skip
    axes.set_xticks(at, signals.names, rotation=30)
    axes.set_ylim(0, 1.25 * fit.noise.max())
    axes.set_title(
        "whiskers on an arm: standard deviation of x, y, z, free", fontsize=9, color=style.INK, loc="left"
    )
    axes.set_ylabel(signals.unit, color=style.LABEL_GREY, fontsize=9)
    axes.legend(frameon=False, fontsize=8.5, loc="upper left", ncols=2)


FIGURE = Figure("The rig from a record", _measure, _table, _draw)
