"""Selection of closure sequences beside the session.

A selection takes longer than a step. So a thread works on a copy of the map while the session goes on, and
the result is taken up a fixed number of keyframes later, finished or not: the session then waits for it. Live
and replay so take up the same result at the same keyframe."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from copy import deepcopy

import numpy as np

from ratslam.core.checkpoint import Checkpointed, with_prefix
from ratslam.core.growable_array import GrowableArray
from ratslam.keyframes.closure_selection import FINE, STEPS
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.loop_closures import ClosureLog
from ratslam.keyframes.map_hypotheses import MapHypotheses
from ratslam.keyframes.map_solution import selected_solution
from ratslam.keyframes.odometry_noise import HeadingNoise
from ratslam.keyframes.optimizer import MapFit, solve
from tactile.base.se2 import compose, inverse

DELAY = 10
"""Keyframes after which a selection is taken up, at most as many as lie between two selections."""
THREAD = ThreadPoolExecutor(1, "closure selection")
"""Of all maps of the process."""


class SelectedMap(Checkpointed):
    """The result of a selection among R sequences.

    Attributes:
        found: whether any sequence had enough evidence; without one only the hypotheses count.
        before: [R] verdicts before the selection. log: with the verdicts after it. poses [N, 3], calibration
            (rad/m, rad/rad), cut, noise: see `KeyframeGraph`.
    """

    VALUES = ("found", "before", "poses", "calibration", "noise")
    PARTS = ("log", "hypotheses")

    def __init__(self, log: ClosureLog, hypotheses: MapHypotheses) -> None:
        self.log, self.hypotheses = log, hypotheses
        self.found, self.before = False, log.verdicts().copy()
        self.poses, self.calibration, self.noise = np.zeros((0, 3)), (0.0, 0.0), HeadingNoise()
        self.cut = GrowableArray((), np.int64)

    def select(self, graph: KeyframeGraph) -> SelectedMap:
        """Selects, and learns the noise of the odometry from the result; changes `graph`."""
        solution = selected_solution(graph, self.log, self.hypotheses)
        if solution is not None:
            fit, self.log, self.cut = solution
            graph.cut = self.cut
            graph.learn_noise(fit, self.log)
            self.poses, self.calibration = fit.poses, (fit.bias, fit.turn_error)
            self.noise, self.found = graph.heading_noise, True
        return self

    def take_up(self, graph: KeyframeGraph, log: ClosureLog) -> None:
        """Moves the map to the selected one, continued by the poses since; verdicts given since then stay."""
        known = len(self.before)
        for sequence in np.flatnonzero(log.verdicts()[:known] == self.before).tolist():
            log.judge(sequence, self.log.verdict(sequence))
        size, (bias, turn_error) = len(self.poses), self.calibration
        graph.cut.rows[:size] = self.cut.rows
        graph.heading_noise = self.noise
        moved = compose(self.poses[-1], inverse(graph.pose.rows[size - 1]))
        poses = np.concatenate([self.poses, compose(moved, graph.pose.rows[size:])])
        start = MapFit(poses, bias, np.zeros(0), turn_error)
        fit = solve(start, graph.problem(log, graph.cut), STEPS, FINE)
        log.weigh(fit.weights)
        graph.move_to(fit)


class SelectionWorker(Checkpointed):
    """Selects every so many keyframes.

    Args:
        every: number of keyframes between two selections, 0: never.
    """

    VALUES = ("_due",)
    PARTS = ("hypotheses",)

    def __init__(self, every: int) -> None:
        self._every = every
        self._due = -1  # the number of keyframes at which the selection in progress is taken up
        self._selected: Future[SelectedMap] | None = None
        self.hypotheses = MapHypotheses()

    def begin(self, graph: KeyframeGraph, log: ClosureLog) -> None:
        """Begins a selection if it is due."""
        if not self._every or graph.count % self._every:
            return
        self._due = graph.count + min(DELAY, self._every)
        job = SelectedMap(log.copy(), deepcopy(self.hypotheses))
        self._selected = THREAD.submit(job.select, graph.copy())

    def finish(self, graph: KeyframeGraph, log: ClosureLog) -> bool:
        """Takes up a selection if it is due; whether it changed the map."""
        if self._selected is None or graph.count < self._due:
            return False
        selected, self._selected, self._due = self._selected.result(), None, -1
        self.hypotheses = selected.hypotheses
        if selected.found:
            selected.take_up(graph, log)
        return selected.found

    def arrays(self) -> dict[str, np.ndarray]:
        """The state, with the selection in progress as its result."""
        arrays = super().arrays()
        if self._selected is not None:
            found = self._selected.result().arrays()
            arrays |= {f"selected/{name}": value for name, value in found.items()}
        return arrays

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the whole state by that of `arrays`."""
        super().restore(arrays)
        self._selected = None
        if self._due >= 0:
            selected = SelectedMap(ClosureLog(), MapHypotheses())
            selected.restore(with_prefix(arrays, "selected/"))
            self._selected = Future()
            self._selected.set_result(selected)
