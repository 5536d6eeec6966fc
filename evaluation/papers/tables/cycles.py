"""The cycle table: what a whole cycle - views, pose cells and map - costs, by session; and where it goes.

Replayed: processor time of a step, us, which includes the threads beside the session, in the mean of a
session. Live: one call a step; time of the session's own thread of the median step and of one in a
hundred, us, and of the slowest, ms; and the slowest by the clock, ms, which includes waiting. The
sessions take turns on one core, so that they share its state; only ratios carry over to other machines.
Compiling and the final map are not included.
"""

from __future__ import annotations

import cProfile
import pstats
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from itertools import product
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from evaluation.papers.tables.markdown import markdown_header, markdown_row, select_rows
from evaluation.papers.trial_sessions import collect_session
from ratslam.core.compilation import Precision, prepare_precision
from ratslam.core.session import Session
from ratslam.mapping import keyframe_merger, selection_worker
from ratslam.runs.build_session import build_session
from ratslam.runs.settings.run_config import RunConfig, load_config
from robot.touch_source import observation_of
from tactile.base.types import Observation

SESSIONS = {
    "square": "configs/square.yaml",
    "intel": "configs/intel_laser.yaml",
    "circuits": "configs/whisker_maze.yaml",
    "exploration": "configs/whisker_exploration.yaml",
}
"""Configurations by name, of 21, 61, 21 and 21 cells a side."""
BACKENDS = "recall", "classic"
COLUMNS = (
    "session", "backend", "dtype", "steps", "replayed: mean us", "live: median us", "99 %",
    "slowest, ms", "slowest by the clock, ms",
)  # fmt: skip
PARTS = {
    "views and belief (compiled kernel)": (
        "core/session.py:_compute", "core/packing.py:records", "core/packing.py:<listcomp>",
    ),
    "packing": ("core/packing.py", "core/session.py"),
    "feedback to the belief": ("methods/", "recall/", "network/", "classic/", "core/backend.py"),
    "views of the map": ("mapping/appearance.py",),
    "closures": (
        "mapping/verification.py", "mapping/acceptance.py", "mapping/odometry_scan.py",
        "mapping/loop_closures.py", "mapping/pieces.py", "mapping/live_filter.py",
    ),
    "judge": ("mapping/closure_judge.py",),
    "selection": (
        "mapping/selection_worker.py", "mapping/closure_selection.py", "mapping/map_solution.py",
        "mapping/odometry_calibration.py",
    ),
    "merging": ("mapping/keyframe_merger.py", "mapping/merg"),
    "solver": ("mapping/optimizer.py", "mapping/normal_equations.py"),
    "log and experiences": ("mapping/step_record.py", "mapping/experiences.py"),
    "rest of the map": ("",),
}  # fmt: skip
"""Parts of a cycle, and how the places of their functions, `FILE.py:FUNCTION`, begin; the first that fits
counts."""


class _Cycle(NamedTuple):
    """A compiled session and its observations."""

    name: str
    backend: str
    precision: Precision
    session: Session
    observations: list[Observation]

    def time(self) -> float:
        """Processor time of a step in the mean of one replay from the start, us."""
        self.session.restart()
        began = time.process_time()
        for _ in self.session.replay(self.observations):
            pass
        return 1e6 * (time.process_time() - began) / len(self.observations)

    def time_live(self) -> tuple[float, float, float, float]:
        """Times of the steps of a live session from the start: median and 99th percentile of its own thread,
        us; the largest of it, and by the clock, ms."""
        self.session.restart()
        clocks = time.thread_time, time.perf_counter
        times = np.empty((len(self.observations), len(clocks)))
        for k, observation in enumerate(self.observations):
            began = [clock() for clock in clocks]
            self.session.step(observation)
            times[k] = [clock() - first for clock, first in zip(clocks, began, strict=True)]
        own, clock = times.T
        percentile = 1e6 * float(np.percentile(own, 99))
        return 1e6 * float(np.median(own)), percentile, 1e3 * float(own.max()), 1e3 * float(clock.max())


def cycle_table(rows: Sequence[str] | None = None, rounds: int = 5, profile: bool = False) -> Iterator[str]:
    """The lines of the table, after all rounds.

    Args:
        rows: of `SESSIONS`; None: all. rounds: repeats, of which the median is taken. profile: whether the
            table is that of `profile_table` instead.

    Raises:
        InputError: a recording cannot be read.
    """
    if profile:
        yield from profile_table(rows)
        return
    cycles = _open_cycles(rows, ("float64", "float32"))
    times = np.array([[(cycle.time(), *cycle.time_live()) for cycle in cycles] for _ in range(rounds)])
    yield markdown_header(COLUMNS)
    for cycle, found in zip(cycles, np.median(times, axis=0).tolist(), strict=True):
        us, median, percentile, slowest, clock = found
        cells = f"{us:.0f}", f"{median:.0f}", f"{percentile:.0f}", f"{slowest:.1f}", f"{clock:.1f}"
        yield markdown_row([cycle.name, cycle.backend, cycle.precision, len(cycle.observations), *cells])


def profile_table(sessions: Sequence[str] | None = None) -> Iterator[str]:
    """The lines of a table of where the processor time of a replayed step goes, us, by part (`PARTS`). The
    selection runs on the thread of the session here. Profiling slows down Python, not compiled code, so its
    times are scaled to the sum of a session that is not profiled."""
    cycles = _open_cycles(sessions, ("float64",))
    columns = []
    for cycle in cycles:
        with (
            patch.object(selection_worker, "THREAD", _Inline()),
            patch.object(keyframe_merger, "THREAD", _Inline()),
        ):
            total = min(cycle.time() for _ in range(3))
            parts = _profile(cycle)
        columns.append({part: us * total / sum(parts.values()) for part, us in parts.items()})
    yield markdown_header(["us a step", *(f"{cycle.name}, {cycle.backend}" for cycle in cycles)])
    for part in PARTS:
        yield markdown_row([part, *(f"{column[part]:.0f}" for column in columns)])
    yield markdown_row(["all", *(f"{sum(column.values()):.0f}" for column in columns)])


def _open_cycles(sessions: Sequence[str] | None, precisions: Sequence[Precision]) -> list[_Cycle]:
    """The compiled sessions of a table."""
    prepare_precision("float64")
    cycles = []
    names = select_rows(sessions, SESSIONS)
    for name, backend, precision in product(names, BACKENDS, precisions):
        settings = [f"backend={backend}", f"session.precision={precision}"]
        config: RunConfig = load_config(SESSIONS[name], settings)
        config, log = collect_session(config, every=False)
        observations = [observation_of(sample) for sample in log]
        cycles.append(_Cycle(name, backend, precision, build_session(config, log), observations))
    for cycle in cycles:
        cycle.time()  # compiles
    return cycles


def _profile(cycle: _Cycle) -> dict[str, float]:
    """Time of a step by part in a profiled replay, us."""
    profiler = cProfile.Profile()
    cycle.session.restart()
    steps = cycle.session.replay(cycle.observations)
    profiler.enable()
    for _ in steps:
        pass
    profiler.disable()
    parts = dict.fromkeys(PARTS, 0.0)
    for function, seconds in own_times(vars(pstats.Stats(profiler))["stats"]).items():
        place = f"{function[0].rpartition('/ratslam/')[2]}:{function[2]}"
        part = next(name for name, begins in PARTS.items() if place.startswith(begins))
        parts[part] += 1e6 * seconds / len(cycle.observations)
    return parts


def own_times(stats: dict[Any, Any]) -> dict[Any, float]:
    """Seconds of each function of this package, with those of the library functions that it calls."""
    times = {function: row[2] for function, row in stats.items()}
    for _ in range(20):  # library functions call each other
        for function in [each for each in times if "/ratslam/" not in each[0] and times[each] > 0]:
            callers = {caller: row[3] for caller, row in stats[function][4].items() if caller != function}
            total = sum(callers.values())
            if total > 0:
                own, times[function] = times[function], 0.0
                for caller, share in callers.items():
                    times[caller] += own * share / total
    return times


class _Inline(Executor):
    """Work runs where it begins."""

    def submit(self, work: Callable[..., Any], /, *values: Any, **named: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(work(*values, **named))
        return done
