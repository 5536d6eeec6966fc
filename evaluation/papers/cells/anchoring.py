"""The figure of anchoring: the packet's error with views, in darkness, with shuffled views, and after them.

Each session has a first part in light, in which places are learnt, a test and light again. Sessions differ in
the test alone: light; darkness; or the views of the test in random order, the control. The path is a slice of
a real rat's or a random walk.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.cells.packet_drift import packet_pose
from evaluation.papers.cells.figure import CellFigure, CellTask
from evaluation.papers.cells.packet_error import error_size, shortest, torus_error
from evaluation.papers.cells.panel_grid import head_panel, panel_grid
from evaluation.papers.cells.rat_sessions import RatRun, RatSessions, rat_config, rat_source, slice_start
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.plots import style
from robot.sources.in_memory import load_into_memory
from robot.sources.source import Source
from tactile.base.random_streams import stream

RATE = 10.0
"""Steps and views per second."""
PATHS = ("sargolini", "walk")
"""A real rat's path, of which each seed has a slice; a random walk."""
TESTS = ("light", "dark", "shuffled")
"""What the test shows."""
USUAL = 3
"""Seeds: each is a path and a draw of the noise of odometry, common to the tests."""
NEAR = (0.1, np.radians(20))
"""Two cells, m and rad: a packet so near to that of the session in light throughout is anchored again, once
it stays there for `HELD`."""
HELD = 2.0
"""s."""
SMOOTH = 5.0
"""Width of the running median of the curves, s."""
COLOURS = {"light": style.BLUE, "dark": style.INK, "shuffled": style.VERMILLION}
COLUMNS = ("path", "test", "error in the test", "error after it", "anchored again", "after s")


class Schedule(NamedTuple):
    """Times, s: the test begins; the light returns; the session ends."""

    test: float = 120.0
    back: float = 180.0
    end: float = 240.0


class AnchoringResult(NamedTuple):
    """Errors of n seeds over T steps.

    Attributes:
        schedule: of the sessions. error: by path and test [n, T, 2] distance (m) and angle (rad) of the
            packet from the true pose. again: by path and test [n] time from the return of the light until
            the packet is anchored again, s; inf: not by the end.
    """

    schedule: Schedule
    error: Mapping[tuple[str, str], np.ndarray]
    again: Mapping[tuple[str, str], np.ndarray]

    def median(self, path: str, test: str, first: float, last: float) -> np.ndarray:
        """[2] median of the errors (m, rad) of all seeds between two times, s."""
        rows = slice(round(first * RATE), round(last * RATE))
        return np.median(self.error[path, test][:, rows].reshape(-1, 2), axis=0)


def measure_anchoring(task: CellTask, schedule: Schedule | None = None) -> AnchoringResult:
    """The errors of all paths, tests and seeds."""
    schedule = schedule or Schedule()
    sessions = RatSessions(
        rat_config(f"rat_simulation.rate_hz={RATE}", "rat_simulation.views.every=1", "session.reserve=256")
    )
    error: dict[tuple[str, str], np.ndarray] = {}
    again: dict[tuple[str, str], np.ndarray] = {}
    for path in PATHS:
        runs = [
            {test: _run(sessions, schedule, path, test, seed) for test in TESTS} for seed in task.seeds(USUAL)
        ]
        for test in TESTS:
            error[path, test] = np.array([error_size(torus_error(each[test].recording)) for each in runs])
            again[path, test] = np.array(
                [anchored_after(each[test], each["light"], schedule) for each in runs]
            )
    return AnchoringResult(schedule, error, again)


def anchored_after(run: RatRun, light: RatRun, schedule: Schedule) -> float:
    """Time from the return of the light until the packet is and stays near to that of the session of the same
    seed in light throughout, s; inf if it does not."""
    apart = packet_pose(run.recording) - packet_pose(light.recording)
    far = np.any(error_size(shortest(run.recording, apart)) > NEAR, axis=1)[round(schedule.back * RATE) :]
    held = round(HELD * RATE)
    windows = np.lib.stride_tricks.sliding_window_view(far, held)
    near = np.flatnonzero(~windows.any(axis=1))
    return float(near[0]) / RATE if len(near) else np.inf


def table_anchoring(result: AnchoringResult) -> list[str]:
    """The lines of the table, and what it does not show."""
    _, back, end = result.schedule
    seeds = len(next(iter(result.error.values())))
    lines = [
        f"{seeds} seeds a path; medians over seeds and time. Goal: error in light far below that in darkness;"
        " control: shuffled views do not anchor.",
        f"Anchored again: seeds whose packet comes within {NEAR[0]:g} m and {NEAR[1]:.2f} rad of the packet"
        f" in light throughout, and stays for {HELD:g} s; their median time after the light returned.",
        "",
        *markdown_header(COLUMNS).splitlines(),
    ]
    for (path, test), again in result.again.items():
        during = result.median(path, test, result.schedule.test, back)
        after = result.median(path, test, (back + end) / 2, end)
        done = again[np.isfinite(again)]
        which = f"{test} (control)" if test == "shuffled" else test
        cells = [path, which, *(f"{m:.3f} m, {rad:.3f} rad" for m, rad in (during, after))]
        if test == "light":
            cells += ["-", "-"]
        else:
            cells += [f"{len(done)} of {seeds}", f"{np.median(done):.1f}" if len(done) else "-"]
        lines.append(markdown_row(cells))
    return [*lines, "", NOT_SHOWN]


NOT_SHOWN = (
    "Not shown: the corrected map. RatSLAM as published stores a view with the packet of that time, so the"
    " error in light contains the drift during learning; the experience map corrects it, pose cells do not."
)


def draw_anchoring(result: AnchoringResult, png: Path) -> None:
    """Median errors over time, with the range of the middle half of the seeds."""
    during = {
        test: np.mean([result.median(path, test, *result.schedule[:2]) for path in PATHS], axis=0)
        for test in TESTS
    }
    line = "Median error in the test: " + ", ".join(
        f"{test} {m:.2f} m, {rad:.2f} rad" for test, (m, rad) in during.items()
    )
    figure, axes = panel_grid("Anchoring of the packet by views", f"{line}.", 2, 2)
    for column, path in enumerate(PATHS):
        for quantity, up in enumerate(("error of position (m)", "error of heading (rad)")):
            panel = axes[quantity][column]
            for test in TESTS:
                _draw_curve(panel, result.error[path, test][..., quantity], test)
            _mark_test(panel, result.schedule)
            panel.set_ylim(bottom=0)
            style.name_axes(panel, "time (s)", up)
        head_panel(axes[0][column], "path of a real rat" if path == "sargolini" else "random walk")
    style.add_legend(figure, axes[0][0])
    figure.savefig(png)


def _draw_curve(axes: style.Axes, error: np.ndarray, test: str) -> None:
    """Medians of errors [n, T] over windows of `SMOOTH`."""
    width = round(SMOOTH * RATE)
    count = error.shape[1] // width
    windows = error[:, : count * width].reshape(len(error), count, width)
    time = (np.arange(count) + 0.5) * SMOOTH
    each = np.median(windows, axis=2)
    low, middle, high = np.percentile(each, [25, 50, 75], axis=0)
    axes.fill_between(time, low, high, color=COLOURS[test], alpha=0.15, lw=0)
    axes.plot(time, middle, color=COLOURS[test], lw=1.6, label=f"{test} in the test")


def _mark_test(axes: style.Axes, schedule: Schedule) -> None:
    axes.axvspan(schedule.test, schedule.back, color=style.LINE_GREY, lw=0, zorder=0.5)
    axes.text(
        (schedule.test + schedule.back) / 2, 1.0, "test", transform=axes.get_xaxis_transform(), ha="center",
        va="top", fontsize=8.5, color=style.LABEL_GREY,
    )  # fmt: skip
    axes.set_xlim(0, schedule.end)


def _run(sessions: RatSessions, schedule: Schedule, path: str, test: str, seed: int) -> RatRun:
    changed: dict[str, Any] = {"seconds": schedule.end}
    if path == "walk":
        changed["walk"] = {}
    else:
        start = slice_start(seed, schedule.end)
        changed["path"] = {"file": path, "heading_smoothing": 0.25, "skip": start}
    if test == "dark":
        changed["phases"] = [{"start": schedule.test, "end": schedule.back, "dark": True}]
    source = rat_source(sessions.config, seed, **changed)
    return sessions.run(_shuffled(source, schedule, seed) if test == "shuffled" else source)


def _shuffled(source: Source, schedule: Schedule, seed: int) -> Source:
    """The source with the views of the test in random order."""
    log = load_into_memory(source)
    rows = np.flatnonzero(log.seen & (log.time >= schedule.test) & (log.time < schedule.back))
    views = log.views.copy()
    views[rows] = log.views[stream(seed, "cells.shuffled_views").permutation(rows)]
    return replace(log, views=views)


FIGURE = CellFigure("Anchoring by views", measure_anchoring, table_anchoring, draw_anchoring)
