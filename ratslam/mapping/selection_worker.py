"""Selection of closure sequences beside the session, on a thread of its own.

A selection takes longer than a step. So a thread works on a copy of the map while the session goes on, and
the result is applied a fixed number of keyframes later; if it is not ready by then, the session waits. So
live and replay apply a result at the same keyframe.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from copy import deepcopy
from typing import Generic, TypeVar

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray, with_prefix
from ratslam.mapping.closure_selection import FINE, STEPS, MapHypotheses
from ratslam.mapping.loop_closures import ClosureLog
from ratslam.mapping.map_solution import selected_solution
from ratslam.mapping.map_state import MapState
from ratslam.mapping.odometry_calibration import HeadingNoise
from ratslam.mapping.optimizer import MapFit, solve
from tactile.base.se2 import compose, inverse

Result = TypeVar("Result", bound=Checkpointed)


class DelayedJob(Checkpointed, Generic[Result]):
    """At most one job in progress; a checkpoint waits for it and holds its result.

    Args:
        thread: that does the work. blank: makes a result to restore.
    """

    VALUES = ("_due",)

    def __init__(self, thread: Executor, blank: Callable[[], Result]) -> None:
        self._thread, self._blank = thread, blank
        self._due = -1  # the keyframe at which the result is taken up
        self.result: Future[Result] | None = None

    @property
    def busy(self) -> bool:
        """Whether a job was begun and its result not taken up."""
        return self.result is not None

    def begin(self, due: int, work: Callable[[], Result]) -> None:
        """Begins a job whose result is taken up at keyframe `due`."""
        self._due, self.result = due, self._thread.submit(work)

    def take(self, now: int) -> Result | None:
        """The result if it is due at keyframe `now`, once."""
        if self.result is None or now < self._due:
            return None
        result, self.result, self._due = self.result.result(), None, -1
        return result

    def arrays(self) -> dict[str, np.ndarray]:
        """The state, with the job in progress as its result."""
        arrays = super().arrays()
        if self.result is not None:
            arrays |= {f"result/{name}": value for name, value in self.result.result().arrays().items()}
        return arrays

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self.result = None
        if self._due >= 0:
            result = self._blank()
            result.restore(with_prefix(arrays, "result/"))
            self.result = Future()
            self.result.set_result(result)


DELAY = 10
"""Keyframes after which a selection is taken up, at most as many as lie between two selections."""
THREAD = ThreadPoolExecutor(1, "closure selection")
"""Of all maps of the process."""


class SelectedMap(Checkpointed):
    """The result of a selection among R sequences.

    Attributes:
        found: whether any sequence had enough evidence; without one only the hypotheses count. before: [R]
        verdicts before the selection. log: with the verdicts after it. poses [N, 3], calibration
            (rad/m, rad/rad), cut, noise: see `MapState`.
    """

    VALUES = ("found", "before", "poses", "calibration", "noise")
    PARTS = ("log", "hypotheses")

    def __init__(self, log: ClosureLog, hypotheses: MapHypotheses) -> None:
        self.log, self.hypotheses = log, hypotheses
        self.found, self.before = False, log.verdicts().copy()
        self.poses, self.calibration, self.noise = np.zeros((0, 3)), (0.0, 0.0), HeadingNoise()
        self.cut = GrowableArray((), np.int64)

    def select(self, state: MapState) -> MapState | None:
        """Selects, and learns the noise of the odometry from the result, which is returned."""
        solution = selected_solution(state, self.hypotheses)
        if solution is not None:
            solution.learn_noise()
            self.log, self.cut, self.poses = solution.log, solution.cut, solution.pose.rows
            self.calibration, self.noise = (solution.bias, solution.turn_error), solution.heading_noise
            self.found = True
        return solution

    def take_up(self, state: MapState) -> None:
        """Moves the map to the selected one, continued by the poses since; verdicts given since then stay."""
        self.judge(state.log)
        size, (bias, turn_error) = len(self.poses), self.calibration
        state.cut.rows[:size] = self.cut.rows
        state.heading_noise = self.noise
        moved = compose(self.poses[-1], inverse(state.pose.rows[size - 1]))
        poses = np.concatenate([self.poses, compose(moved, state.pose.rows[size:])])
        start = MapFit(state.placement()(poses), bias, np.zeros(0), turn_error)
        fit = solve(start, state.problem(), STEPS, FINE)
        state.log.weigh(fit.weights)
        state.move_to(fit)

    def judge(self, log: ClosureLog) -> None:
        """Takes over the verdicts on sequences whose verdict has not changed since the selection began."""
        same = np.flatnonzero(log.verdicts()[: len(self.before)] == self.before)
        log.take_verdicts(self.log, same)


class SelectionWorker(Checkpointed):
    """Selects every so many keyframes, see `KeyframeMapConfig.select_every`."""

    PARTS = ("hypotheses", "job")

    def __init__(self) -> None:
        self.job = DelayedJob(THREAD, lambda: SelectedMap(ClosureLog(), MapHypotheses()))
        self.hypotheses = MapHypotheses()

    def begin(self, state: MapState) -> None:
        """Begins a selection if it is due."""
        every = state.config.select_every
        if every and state.total % every == 0:
            present = state.copy()
            selected = SelectedMap(present.log, deepcopy(self.hypotheses))

            def select() -> SelectedMap:
                selected.select(present)
                return selected

            self.job.begin(state.total + min(DELAY, every), select)

    def finish(self, state: MapState) -> bool:
        """Takes up a selection if it is due; whether it changed the map."""
        selected = self.job.take(state.total)
        if selected is None:
            return False
        self.hypotheses = selected.hypotheses
        if selected.found:
            selected.take_up(state)
            state.log.count_selection()
        return selected.found
