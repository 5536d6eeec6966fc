"""The figures of drift and of anchoring: the packet's error by path integration alone, and with views.

Drift: rats walk at random in a box of 1 m without views; networks differ in the noise on their odometry.
The control is that odometry integrated without a network: the packet should add little to its error.

Anchoring: each session has a first part in light, in which places are learnt, a test, and light again.
Sessions differ in the test alone: light; darkness; or the views of the test in random order, the control.
The path is a slice of a real rat's or a random walk.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.cells.recording import CellRecording
from evaluation.papers.cells import panels
from evaluation.papers.cells.rat_sessions import RatSessions, rat_config
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from evaluation.plots import style
from evaluation.studies.network_batch import CellSets, walk
from evaluation.studies.study_course import StudyCourse, expected_poses, read_course
from ratslam.classic.config import rings, units
from ratslam.core.compilation import prepare_precision
from robot.sources.in_memory import load_into_memory
from tactile.base.random_streams import stream
from tactile.base.se2 import integrate

RATE = 10.0
"""Steps per second, and views where there are any."""
TIMES = (60, 300, 600)
"""Times at which errors are read, s."""
SPEED = (0.05, 0.1, 0.2, 0.4)
"""Levels of white noise of the speed, as a share of it over one second, sqrt(s); the heading is exact."""
HEADING = (0.01, 0.02, 0.05)
"""Levels of white noise of the heading, rad / sqrt(s); the speed is exact."""
USUAL = 5
"""Seeds: each is a path and a draw of the noise, common to all levels."""
LEAST = 0.1
"""Least upper end of the axes of errors, m and rad: smaller errors are those of the lattice of cells."""
COLOURS = (style.SKY, style.BLUE, style.VERMILLION)
"""Of the times."""
COLUMNS = (
    "noise", "after s", "packet m", "odometry m (control)", "packet - odometry m", "packet rad",
    "expected rad", "odometry rad (control)", "packet - odometry rad",
)  # fmt: skip


LEVELS = {
    "none": (0.0, 0.0),
    **{f"speed {each:g} sqrt(s)": (each, 0.0) for each in SPEED},
    **{f"heading {each:g} rad / sqrt(s)": (0.0, each) for each in HEADING},
}
"""Noise of the speed and of the heading by name: one block of networks."""
_Drift = tuple[tuple[int, ...], Sequence[np.ndarray]]
"""M times, s, and sizes [n, L, M, 2] (m and rad) of the errors of n seeds at L levels: of the packet and of
odometry against the true pose, and of the packet against integrated odometry."""


def measure_drift(task: Task, times: tuple[int, ...] = TIMES) -> _Drift:
    """The errors of all seeds after the given times, s."""
    prepare_precision("float64")
    found = [_errors_of(seed, times) for seed in task.seeds(USUAL)]
    return times, [np.array(each) for each in zip(*found, strict=True)]


def _rms(errors: np.ndarray) -> np.ndarray:
    """[L, M, 2] root mean square over the seeds of errors [n, L, M, 2]."""
    return np.sqrt((errors**2).mean(axis=0))


def _table_drift(result: _Drift) -> list[str]:
    times, errors = result
    packet, odometry, added = map(_rms, errors)
    above = [
        f"Root mean square over {len(errors[0])} seeds; a cell is 0.05 m and {np.radians(10):.2f} rad.",
        "Goal: the packet adds little to the error of odometry; heading: noise times the root of the time.",
    ]
    rows = []
    for k, (level, (_, heading)) in enumerate(LEVELS.items()):
        for j, time in enumerate(times):
            (m, rad), (m_o, rad_o), (m_a, rad_a) = packet[k, j], odometry[k, j], added[k, j]
            cells = [m, m_o, m_a, rad, heading * np.sqrt(time), rad_o, rad_a]
            rows.append([level, time, *(f"{each:.3f}" for each in cells)])
    below = (
        "Not shown: noise inside the network, which has none; the packet drifts because odometry does, and"
        " with a few seeds a root mean square is uncertain by a third."
    )
    return table_lines(above, COLUMNS, rows, [below])


def _draw_drift(result: _Drift, png: Path) -> None:
    """Errors of position and heading against the noise of speed and of heading."""
    times, (packets, odometries, added) = result
    line = (
        f"Dots: {len(packets)} seeds, lines: root mean square. "
        f"The packet adds at most {added[..., 0].max():.3f} m, {added[..., 1].max():.3f} rad to odometry."
    )
    figure, axes = panels.panel_grid("Path integration drift against noise of odometry", line, 2, 2)
    noise, exact_heading = np.array(list(LEVELS.values())), 1 + len(SPEED)
    columns = (
        ("heading exact", [*range(exact_heading)], "noise of the speed (sqrt(s))"),
        ("speed exact", [0, *range(exact_heading, len(LEVELS))], "noise of the heading (rad / sqrt(s))"),
    )
    for column, (title, rows, across) in enumerate(columns):
        levels = noise[rows, column].tolist()
        for quantity, up in enumerate(("error of position (m)", "error of heading (rad)")):
            panel = axes[quantity][column]
            packet, odometry = (_rms(each)[rows, :, quantity] for each in (packets, odometries))
            for j, time in enumerate(times):
                colour = COLOURS[j % len(COLOURS)]
                panel.plot(levels, packet[:, j], "-", color=colour, lw=1.6, label=f"packet after {time} s")
                panel.plot(levels, odometry[:, j], "--", color=style.INK, lw=0.9, zorder=3)
                panels.spread_dots(panel, levels, packets[:, rows, j, quantity].T.tolist(), colour)
            panel.plot([], [], "--", color=style.INK, lw=0.9, label="odometry (control)")
            panel.set_ylim(0, max(panel.get_ylim()[1], LEAST))
            panels.name_panel(panel, "" if quantity else title, across, up)
    style.add_legend(figure, axes[0][0], columns=6).savefig(png)


def _errors_of(seed: int, times: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[L, M, 2] errors of packets, of odometry, and of packets against odometry."""
    exact, seconds = "odometry={speed_white: 0.0, heading_white: 0.0}", times[-1] + 1
    rat = f"seconds={seconds}", f"rate_hz={RATE}", f"seed={seed}", "walk={}", exact, "views.every=1000"
    config = rat_config(*(f"rat_simulation.{setting}" for setting in rat))
    study = read_course(config, round(seconds * RATE), False, 2, (0,), seed)
    at = np.round(np.array(times) * RATE).astype(int)
    packets, odometry = _packets(study)[:, at], _odometry(study)[:, at]
    true = study.expected[at]
    unit = units(study.config, np.dtype(float))
    pairs = (packets, true), (odometry, true), (packets, odometry)
    packet, alone, added = (panels.error_size((a - b) * unit) for a, b in pairs)
    return packet, alone, added


def _packets(study: StudyCourse) -> np.ndarray:
    """[L, T, 3] packets in cells, followed round the torus."""
    count, ring = len(LEVELS), rings(study.config, np.dtype(float))
    network = study.config.excite_sigma, study.config.inhibit_sigma, study.config.global_inhibition, 1.0
    speed, heading = np.array(list(LEVELS.values())).T
    # `CellSets` scales the noise of a step; over a step the white noise of a second is larger.
    columns = [*(np.full(count, each) for each in network), speed * np.sqrt(RATE), heading]
    sets = CellSets(*columns)
    tracks = walk(study.config, sets, study.course, study.chosen)
    wrapped = np.concatenate([track.pose for track in tracks], axis=1)
    start = np.broadcast_to(ring // 2, (count, 1, 3))
    gone = np.diff(wrapped, axis=1, prepend=start)
    return start + np.cumsum(gone - ring * np.round(gone / ring), axis=1)


def _odometry(study: StudyCourse) -> np.ndarray:
    """[L, T, 3] poses in cells of the noisy odometry integrated without a network."""
    motion, noise = study.course.motion, study.course.noise
    poses = []
    for speed, heading in LEVELS.values():
        faster = 1 + speed * np.sqrt(RATE) * noise[:, :1]
        turn = motion[:, 2] + heading * noise[:, 1]
        poses.append(expected_poses(study.config, integrate(np.column_stack([motion[:, :2] * faster, turn]))))
    return np.array(poses)


DRIFT = Figure("Path integration drift against noise", measure_drift, _table_drift, _draw_drift)


PATHS = ("sargolini", "walk")
"""A real rat's path, of which each seed has a slice; a random walk."""
TESTS = ("light", "dark", "shuffled")
"""What the test shows."""
ANCHORING_USUAL = 3
"""Seeds: each is a path and a draw of the noise of odometry, common to the tests."""
NEAR = (0.1, np.radians(20))
"""Two cells, m and rad: a packet so near to that of the session in light throughout is anchored again, once
it stays there for `HELD`."""
HELD = 2.0
"""s."""
SMOOTH = 5.0
"""Width of the running median of the curves, s."""
ANCHORING_COLOURS = {"light": style.BLUE, "dark": style.INK, "shuffled": style.VERMILLION}
ANCHORING_COLUMNS = ("path", "test", "error in the test", "error after it", "anchored again", "after s")


SCHEDULE = (120.0, 180.0, 240.0)
"""Times, s: the test begins; the light returns; the session ends."""
_Schedule = tuple[float, float, float]
_Errors = Mapping[tuple[str, str], np.ndarray]
"""By path and test."""
_Anchoring = tuple[_Schedule, _Errors, _Errors]
"""Of n seeds over T steps: [n, T, 2] distance (m) and angle (rad) of the packet from the true pose; [n] time
from the return of the light until the packet is anchored again, s; inf: not by the end."""


def _median_error(errors: np.ndarray, first: float, last: float) -> np.ndarray:
    """[2] median (m, rad) over all seeds of errors [n, T, 2] between two times, s."""
    return np.median(errors[:, round(first * RATE) : round(last * RATE)].reshape(-1, 2), axis=0)


def measure_anchoring(task: Task, schedule: _Schedule = SCHEDULE) -> _Anchoring:
    """The errors of all paths, tests and seeds."""
    sessions = RatSessions(
        rat_config(f"rat_simulation.rate_hz={RATE}", "rat_simulation.views.every=1", "session.reserve=256")
    )
    error: dict[tuple[str, str], np.ndarray] = {}
    again: dict[tuple[str, str], np.ndarray] = {}
    for path in PATHS:
        runs = [
            {test: _run(sessions, schedule, path, test, seed) for test in TESTS}
            for seed in task.seeds(ANCHORING_USUAL)
        ]
        for test in TESTS:
            error[path, test] = np.array([panels.error_size(panels.torus_error(each[test])) for each in runs])
            again[path, test] = np.array(
                [_anchored_after(each[test], each["light"], schedule[1]) for each in runs]
            )
    return schedule, error, again


def _anchored_after(run: CellRecording, light: CellRecording, back: float) -> float:
    """Time from the return of the light until the packet is and stays near to that of the session of the same
    seed in light throughout, s; inf if it does not."""
    apart = run.packet_pose - light.packet_pose
    far = np.any(panels.error_size(panels.shortest(run, apart)) > NEAR, axis=1)[round(back * RATE) :]
    held = round(HELD * RATE)
    windows = np.lib.stride_tricks.sliding_window_view(far, held)
    near = np.flatnonzero(~windows.any(axis=1))
    return float(near[0]) / RATE if len(near) else np.inf


def _table_anchoring(result: _Anchoring) -> list[str]:
    (begins, back, end), errors, times = result
    seeds = len(next(iter(errors.values())))
    above = [
        f"{seeds} seeds a path; medians over seeds and time. Goal: error in light far below that in darkness;"
        " control: shuffled views do not anchor.",
        f"Anchored again: seeds whose packet comes within {NEAR[0]:g} m and {NEAR[1]:.2f} rad of the packet"
        f" in light throughout, and stays for {HELD:g} s; their median time after the light returned.",
    ]
    rows = []
    for (path, test), error in errors.items():
        parts = _median_error(error, begins, back), _median_error(error, (back + end) / 2, end)
        again = times[path, test]
        done = again[np.isfinite(again)]
        last = [f"{len(done)} of {seeds}", f"{np.median(done):.1f}" if len(done) else "-"]
        which = f"{test} (control)" if test == "shuffled" else test
        medians = (f"{m:.3f} m, {rad:.3f} rad" for m, rad in parts)
        rows.append([path, which, *medians, *(["-", "-"] if test == "light" else last)])
    below = (
        "Not shown: the corrected map. RatSLAM as published stores a view with the packet of that time, so"
        " the error in light contains the drift during learning; the experience map corrects it, pose cells"
        " do not."
    )
    return table_lines(above, ANCHORING_COLUMNS, rows, [below])


def _draw_anchoring(result: _Anchoring, png: Path) -> None:
    """Median errors over time, with the range of the middle half of the seeds."""
    (begins, back, end), errors, _ = result
    during = {
        test: np.mean([_median_error(errors[path, test], begins, back) for path in PATHS], axis=0)
        for test in TESTS
    }
    line = "Median error in the test: " + ", ".join(
        f"{test} {m:.2f} m, {rad:.2f} rad" for test, (m, rad) in during.items()
    )
    figure, axes = panels.panel_grid("Anchoring of the packet by views", f"{line}.", 2, 2)
    for column, path in enumerate(PATHS):
        for quantity, up in enumerate(("error of position (m)", "error of heading (rad)")):
            panel = axes[quantity][column]
            for test in TESTS:
                _draw_curve(panel, errors[path, test][..., quantity], test)
            panel.axvspan(begins, back, color=style.LINE_GREY, lw=0, zorder=0.5)
            panel.text(
                (begins + back) / 2, 1.0, "test", transform=panel.get_xaxis_transform(), ha="center",
                va="top", fontsize=8.5, color=style.LABEL_GREY,
            )  # fmt: skip
            panel.set_xlim(0, end)
            panel.set_ylim(bottom=0)
            title = "path of a real rat" if path == "sargolini" else "random walk"
            panels.name_panel(panel, "" if quantity else title, "time (s)", up)
    style.add_legend(figure, axes[0][0]).savefig(png)


def _draw_curve(axes: style.Axes, error: np.ndarray, test: str) -> None:
    """Medians of errors [n, T] over windows of `SMOOTH`."""
    width = round(SMOOTH * RATE)
    count = error.shape[1] // width
    windows = error[:, : count * width].reshape(len(error), count, width)
    time = (np.arange(count) + 0.5) * SMOOTH
    each = np.median(windows, axis=2)
    low, middle, high = np.percentile(each, [25, 50, 75], axis=0)
    axes.fill_between(time, low, high, color=ANCHORING_COLOURS[test], alpha=0.15, lw=0)
    axes.plot(time, middle, color=ANCHORING_COLOURS[test], lw=1.6, label=f"{test} in the test")


def _run(sessions: RatSessions, schedule: _Schedule, path: str, test: str, seed: int) -> CellRecording:
    begins, back, end = schedule
    changed: dict[str, Any] = {"seconds": end}
    if path == "walk":
        changed["walk"] = {}
    else:
        # Each seed has another slice of the recorded path, which lasts 600 s.
        start = float(stream(seed, "cells.slice").uniform(0.0, 600.0 - end - 1.0))
        changed["path"] = {"file": path, "heading_smoothing": 0.25, "skip": start}
    if test == "dark":
        changed["phases"] = [{"start": begins, "end": back, "dark": True}]
    source = sessions.rat(seed, **changed)
    if test != "shuffled":
        return sessions.run(source)
    log = load_into_memory(source)
    rows = np.flatnonzero(log.seen & (log.time >= begins) & (log.time < back))
    views = log.views.copy()
    views[rows] = log.views[stream(seed, "cells.shuffled_views").permutation(rows)]
    return sessions.run(replace(log, views=views))


ANCHORING = Figure("Anchoring by views", measure_anchoring, _table_anchoring, _draw_anchoring)
