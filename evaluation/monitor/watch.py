"""A monitor of a run that another process makes: a picture, and a line that tells how it goes.

It reads what the run writes anyhow and asks it for nothing (Fox et al. 2012, II-D: monitors are processes of
their own and do not slow the filter).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from evaluation.artifacts.run_directory import read_walls
from evaluation.monitor.plot import draw_watch
from evaluation.monitor.progress import RUNNING, WATCH_IMAGE, RunMonitor, RunProgress, step_count
from tactile.base.atomic_write import write_atomically
from tactile.base.errors import InputError

SILENCE_LIMIT = 300.0
"""A run that wrote nothing for so long was killed, s: to compile, and to draw in the end, takes less."""
SILENCE_SHOWN = 10.0
"""It is told of silence from here on, s."""
REST_FACTOR = 9.0
"""A monitor rests so many times as long as it works: it takes a tenth of a processor at most."""


def watch_run(
    directory: Path,
    tell: Callable[[str], None],
    *,
    every: float = 2.0,
    patience: float = SILENCE_LIMIT,
    once: bool = False,
) -> RunProgress:
    """Keeps watch.png in a run's directory up to date and tells how the run stands, until it ends.

    Args:
        tell: called with one line after each look. every: s from one look to the next, at least. patience: s
            of silence after which a run counts as killed. once: whether to look but once.

    Returns:
        what was seen last.

    Raises:
        InputError: there is no run, or no picture can be left with it.
    """
    monitor, before, last = RunMonitor(directory), None, 0.0
    while True:
        began = time.monotonic()
        seen = monitor.read()
        pace = seen.rate
        if before is not None and seen.status == RUNNING:
            pace = (len(seen.path) - len(before.path)) / (began - last)
        if before is None or (len(seen.path), seen.status) != (len(before.path), before.status):
            _draw(directory, seen)
        tell(status_line(seen, pace))
        if once or seen.status != RUNNING or seen.silence > patience:
            return seen
        before, last = seen, began
        time.sleep(max(every, REST_FACTOR * (time.monotonic() - began)))


def status_line(seen: RunProgress, pace: float | None) -> str:
    """A run in one line; `pace`: steps a second."""
    parts = [f"{seen.name}: {seen.status}", step_count(seen), f"{path_length(seen.odometry):.1f} m"]
    parts += [] if pace is None else [f"{pace:.0f} steps/s"]
    parts += [] if seen.online_error is None else [f"error {seen.online_error:.3g} m"]
    parts += [f"{count} {name}" for name, count in sorted(seen.outcomes.items(), key=lambda item: -item[1])]
    parts += [f"{seen.lost} lost"] if seen.lost else []
    parts += [f"checkpoint at {seen.checkpoint}"] if seen.checkpoint else []
    parts += (
        [f"silent for {seen.silence:.0f} s"]
        if seen.status == RUNNING and seen.silence > SILENCE_SHOWN
        else []
    )
    return ", ".join(parts)


def path_length(odometry: np.ndarray) -> float:
    """How far the robot went by its odometry [N, 3] from where it began, m."""
    return float(np.hypot(*np.diff(odometry[:, :2], axis=0, prepend=np.zeros((1, 2))).T).sum())


def _draw(directory: Path, seen: RunProgress) -> None:
    figure = draw_watch(seen, read_walls(directory))
    try:
        write_atomically(directory / WATCH_IMAGE, figure.savefig)
    except OSError as error:
        found = f"cannot be written ({error.strerror or error})"
        raise InputError(
            str(directory / WATCH_IMAGE), found, "a run directory that can be written to"
        ) from None
