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
from evaluation.artifacts.run_directory import read_walls
from evaluation.metrics.run_metrics import DOUBTED
from evaluation.monitor.plot import draw_watch
from evaluation.monitor.progress import WATCH_IMAGE, RunMonitor, RunProgress, step_count
from tactile.base.atomic_write import write_atomically
from tactile.base.errors import os_errors_of

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
