"""Measures a session of a growth study, one step at a time, at each of its lengths."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice, pairwise
from time import perf_counter, process_time, thread_time
from typing import NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.trajectory import ate
from evaluation.studies.growth import Ground, GrowthTask
from evaluation.studies.machine import Machine, compilations, machine
from evaluation.studies.perturbation import repeat_course
from evaluation.studies.resources import peak_memory, reset_peak_memory, watch_load
from evaluation.studies.session_metrics import FALSE_CLOSURE_DISTANCE
from ratslam.core.session import Session
from ratslam.runs.build_session import build_session
from ratslam.runs.open_source import open_observations, read_observations
from robot.sources.in_memory import load_into_memory
from tactile.base.se2 import integrate
from tactile.base.settings import Settings
from tactile.base.types import Observation

SEED = 0
"""Seed of the noise of a course that is repeated."""
TIMES = ("mean", "process_mean", "median", "p99", "largest", "longest")
"""Fields of a row that need a step that compiled nothing."""


class GrowthRow(Settings):
    """A session at one length. Times are of the steps since the length before, or of the window of
    `GrowthPlan`, without those that compiled code; None if all did. Errors are of all steps so far."""

    ground: Ground
    steps: int  # length of the session
    keyframes: int  # number of rows of the backend's memory in use
    mean: float | None  # processor time of a step on the session's own thread, mean, us
    process_mean: float | None  # the same, with the process's other threads, us
    median: float | None  # processor time of a step on the session's own thread, us
    p99: float | None  # the same, 99 % quantile, us
    largest: float | None  # the same, largest, us
    longest: float | None  # wall time of the longest step, with waits for other threads, us
    compiling: float  # wall time of the steps that compiled code, s
    memory: float  # peak resident memory, MiB
    energy: float  # Energy Metric of the online map, all pairs, m^2 + rad^2
    ate: float  # ATE of the online map, m
    energy_odometry: float  # Energy Metric of odometry, all pairs, m^2 + rad^2
    closures: int  # number of loop closures of the final map
    false_closures: int  # number of these between steps farther apart than `FALSE_CLOSURE_DISTANCE`
    end: float  # processor time of the final optimisation if the session ended here, s
    energy_final: float  # Energy Metric of the final map, all pairs, m^2 + rad^2
    ate_final: float  # ATE of the final map, m
    machine: Machine


class _Clocks(NamedTuple):
    """Processor time of this thread and of the process, and wall time, s."""

    own: float
    process: float
    wall: float

    @classmethod
    def now(cls) -> _Clocks:
        return cls(thread_time(), process_time(), perf_counter())


class _StepClock:
    """Times steps, apart from those that compile code."""

    def __init__(self) -> None:
        self._compiled = compilations()
        self.restart()

    def take(self, step: Callable[[], object]) -> None:
        """Takes and times a step."""
        compiled, before = len(self._compiled), _Clocks.now()
        step()
        own, process, wall = np.subtract(_Clocks.now(), before)
        if len(self._compiled) == compiled:
            self._steps.append((own, wall))
        else:
            self._compiling += wall
            self._others += own - process  # threads that compile are no cost of a step

    def read(self) -> dict[str, float | None]:
        """The times of `GrowthRow` since the last call or restart."""
        now = _Clocks.now()
        others = self._others + (now.process - self._began.process) - (now.own - self._began.own)
        steps, compiling = self._steps, self._compiling
        self.restart()
        if not steps:
            return {"compiling": compiling} | dict.fromkeys(TIMES)
        own, wall = 1e6 * np.array(steps).T
        # Threads beside the session also work between its steps.
        mean, beside = own.mean(), 1e6 * max(others, 0.0) / len(own)
        found = mean, mean + beside, np.median(own), np.quantile(own, 0.99), own.max(), wall.max()
        times: dict[str, float | None] = {"compiling": compiling}
        return times | dict(zip(TIMES, map(float, found), strict=True))

    def restart(self) -> None:
        """Forgets the steps so far."""
        self._steps: list[tuple[float, float]] = []
        self._compiling, self._others, self._began = 0.0, 0.0, _Clocks.now()


def measure_growth(task: GrowthTask, done: Callable[[], object] = lambda: None) -> Iterator[GrowthRow]:
    """Plays the session once, to its greatest length; yields a row at each length.

    Args:
        done: called after each step.
    """
    with open_observations(task.config) as (config, source):
        # Rows reserved for the greatest length would cost from the first step on.
        reserve = config.session.reserve or 1
        kept = config.session.model_copy(update={"reserve": reserve})
        if config.simulation is None:
            source = repeat_course(load_into_memory(source), task.lengths[-1], SEED)
        session = build_session(config.model_copy(update={"session": kept}), source)
        rows, clock = read_observations(source), _StepClock()
        truth, motion = list[np.ndarray](), list[np.ndarray]()
        for before, length in pairwise([0, *task.lengths]):
            load = watch_load()
            reset_peak_memory()
            window = min(task.window or length, length - before)
            for step, (sample, observation) in enumerate(islice(rows, length - before)):
                if step == length - before - window:
                    clock.restart()
                clock.take(_step(session, observation))
                assert sample.truth is not None
                truth.append(sample.truth)
                motion.append(np.asarray(observation.odometry[:3], float))
                done()
            times = clock.read() | {"memory": peak_memory()}
            here = machine().model_copy(update={"other_load": load()})
            errors = _errors(session, np.array(truth), integrate(np.array(motion)))
            keyframes = session.backend.rows(session.state)
            found = {"keyframes": keyframes, "machine": here, **times, **errors}
            yield GrowthRow.model_validate({"ground": task.ground, "steps": length, **found})


def _step(session: Session, observation: Observation) -> Callable[[], object]:
    return lambda: session.step(observation)


def _errors(session: Session, truth: np.ndarray, odometry: np.ndarray) -> dict[str, float]:
    """The errors of `GrowthRow`, and the time of the final optimisation; the session stays as it is."""
    online = session.map.online_trajectory()
    began = thread_time()
    final, end = session.map.trajectory(), thread_time() - began
    closures = session.map.closures()
    apart = np.hypot(*(truth[closures[:, 0]] - truth[closures[:, 1]])[:, :2].T)
    return {
        "end": end,
        "energy_odometry": energy_all_pairs(odometry, truth).total,
        "closures": len(closures),
        "false_closures": int((apart > FALSE_CLOSURE_DISTANCE).sum()),
        "energy": energy_all_pairs(online, truth).total,
        "ate": ate(online, truth),
        "energy_final": energy_all_pairs(final, truth).total,
        "ate_final": ate(final, truth),
    }
