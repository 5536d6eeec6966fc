"""The cycle table: processor time of a whole cycle in replay - views, pose cells and map - in us, by session.

The sessions take turns on one core, so that they share its state; only ratios carry over to other machines.
The times of a step include the threads beside the session. Compiling and the final map are not included.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from time import process_time
from typing import NamedTuple

import numpy as np

from ratslam.config.run_config import RunConfig, load_config
from ratslam.core.precision import Precision, prepare_precision
from ratslam.core.session import Session
from ratslam.experiments.tables.markdown import markdown_header, markdown_row, select_rows
from ratslam.pipeline.build_session import build_session
from ratslam.pipeline.source import open_observations
from robot.sources.in_memory import load_into_memory
from robot.touch_source import observation_of
from tactile.base.types import Observation

SESSIONS = {
    "square": "configs/square.yaml",
    "intel": "configs/intel_laser.yaml",
    "circuits": "configs/whisker_maze.yaml",
}
"""Configurations by name, of 21, 61 and 21 cells a side."""
BACKENDS = "recall", "classic"
COLUMNS = "session", "backend", "dtype", "steps", "mean us"


class Cycle(NamedTuple):
    """A compiled session and its observations."""

    name: str
    backend: str
    precision: Precision
    session: Session
    observations: list[Observation]

    def time(self) -> float:
        """Processor time of a step in the mean of one replay from the start, us."""
        self.session.restart()
        began = process_time()
        for _ in self.session.replay(self.observations):
            pass
        return 1e6 * (process_time() - began) / len(self.observations)


def cycle_table(
    sessions: Sequence[str] | None = None, rounds: int = 5, folder: Path = Path()
) -> Iterator[str]:
    """The lines of the table, after all rounds.

    Args:
        sessions: of `SESSIONS`; None: all. rounds: repeats, of which the median is taken. folder: of the
            repository, which holds `configs`.

    Raises:
        InputError: a recording cannot be read.
    """
    prepare_precision("float64")
    chosen = select_rows(sessions, SESSIONS, tuple(SESSIONS))
    cycles = [
        open_cycle(name, backend, precision, folder)
        for name in chosen
        for backend in BACKENDS
        for precision in ("float64", "float32")
    ]
    for cycle in cycles:
        cycle.time()  # compiles
    times = np.array([[cycle.time() for cycle in cycles] for _ in range(rounds)])
    yield markdown_header(COLUMNS)
    for cycle, us in zip(cycles, np.median(times, axis=0).tolist(), strict=True):
        row = cycle.name, cycle.backend, cycle.precision, len(cycle.observations), f"{us:.0f}"
        yield markdown_row(row)


def open_cycle(name: str, backend: str, precision: Precision, folder: Path) -> Cycle:
    """The session of a configuration with a backend, not compiled yet."""
    settings = [f"backend={backend}", f"session.precision={precision}"]
    config: RunConfig = load_config(folder / SESSIONS[name], settings)
    with open_observations(config) as (config, source):
        log = load_into_memory(source)
    observations = [observation_of(sample) for sample in log]
    return Cycle(name, backend, precision, build_session(config, log), observations)
