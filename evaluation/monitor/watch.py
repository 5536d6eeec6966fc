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
from evaluation.monitor.progress import PICTURE, RUNNING, Progress, Watched, counted
from tactile.base.atomic_write import write_atomically
from tactile.base.errors import InputError

PATIENCE = 300.0
"""A run that wrote nothing for so long was killed, s: to compile, and to draw in the end, takes less."""
QUIET = 10.0
"""It is told of silence from here on, s."""
IDLE = 9.0
"""A monitor rests so many times as long as it works: it takes a tenth of a processor at most."""


def watch(
    directory: Path,
    tell: Callable[[str], None],
    *,
    every: float = 2.0,
    patience: float = PATIENCE,
    once: bool = False,
) -> Progress:
    """Keeps watch.png in a run's directory up to date and tells how the run stands, until it ends.

    Args:
        tell: called with one line after each look. every: s from one look to the next, at least. patience: s
            of silence after which a run counts as killed. once: whether to look but once.

    Returns:
        what was seen last.

    Raises:
        InputError: there is no run, or no picture can be left with it.
    """
    watched, before, last = Watched(directory), None, 0.0
    while True:
        began = time.monotonic()
        seen = watched.look()
        pace = seen.pace
        if before is not None and seen.status == RUNNING:
            pace = (len(seen.path) - len(before.path)) / (began - last)
        if before is None or (len(seen.path), seen.status) != (len(before.path), before.status):
            _draw(directory, seen)
        tell(status_line(seen, pace))
        if once or seen.status != RUNNING or seen.silent > patience:
            return seen
        before, last = seen, began
        time.sleep(max(every, IDLE * (time.monotonic() - began)))


def status_line(seen: Progress, pace: float | None) -> str:
    """A run in one line; `pace`: steps a second."""
    parts = [f"{seen.name}: {seen.status}", counted(seen), f"{distance(seen.odometry):.1f} m"]
    parts += [] if pace is None else [f"{pace:.0f} steps/s"]
    parts += [] if seen.off is None else [f"off by {seen.off:.3g} m"]
    parts += [f"{count} {name}" for name, count in sorted(seen.outcomes.items(), key=lambda item: -item[1])]
    parts += [f"{seen.lost} lost"] if seen.lost else []
    parts += [f"checkpoint at {seen.saved}"] if seen.saved else []
    parts += [f"silent for {seen.silent:.0f} s"] if seen.status == RUNNING and seen.silent > QUIET else []
    return ", ".join(parts)


def distance(odometry: np.ndarray) -> float:
    """How far the robot went by its odometry [N, 3] from where it began, m."""
    return float(np.hypot(*np.diff(odometry[:, :2], axis=0, prepend=np.zeros((1, 2))).T).sum())


def _draw(directory: Path, seen: Progress) -> None:
    figure = draw_watch(seen, read_walls(directory))
    try:
        write_atomically(directory / PICTURE, figure.savefig)
    except OSError as error:
        found = f"cannot be written ({error.strerror or error})"
        raise InputError(str(directory / PICTURE), found, "a run directory that can be written to") from None
