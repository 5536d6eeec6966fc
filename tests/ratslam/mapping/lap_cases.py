"""Maps of laps around a square, with true and false closures."""

from __future__ import annotations

import numpy as np

from ratslam.mapping.appearance import Appearance, LabelAppearance, ViewAppearance
from ratslam.mapping.config import FULL, KeyframeMapConfig
from ratslam.mapping.keyframe_graph import NO_ROBUST_SCALE, KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.map_solution import MapSolution
from ratslam.mapping.optimizer import solve
from tactile.base.se2 import between, compose
from tactile.base.types import Odometry, observation
from tests.helpers.laps import square

CELL, GUARD, LAP, SIZE = 0.05, 20, 48, 12
LAPS = 5
TRUTH = square("A" * LAPS)
DRIFT = 0.004  # heading error of the odometry, rad a step
APPEARANCES = {"ids": LabelAppearance, "views": lambda: ViewAppearance(SIZE, None)}


def drive(appearance: Appearance, places: int = LAP) -> KeyframeGraph:
    """Keyframes on laps around a square of so many places that look different, by odometry that turns."""
    graph = KeyframeGraph(KeyframeMapConfig(), CELL, appearance, GUARD, FULL)
    looks = np.random.default_rng(0).random((LAP, SIZE))
    pose = TRUTH[0]
    for k in range(len(TRUTH)):
        motion = np.zeros(3) if k == 0 else between(TRUTH[k - 1], TRUTH[k]) + [0, 0, DRIFT]
        pose = compose(pose, motion)
        length = float(np.hypot(*motion[:2]))
        graph.append(pose, motion, length, abs(motion[2]))
        reading = observation(Odometry(*motion, 0.1), looks[k % places, None, :, None], label=k % places)
        appearance.append(reading, motion[2], length)
    return graph


def closed(sequences: list[tuple[int, int, int]]) -> ClosureLog:
    """A log of accepted sequences: first keyframe, first match, number of closures."""
    log = ClosureLog()
    for frame, match, count in sequences:
        for k in range(count):
            number = log.add(Candidate(frame + k, match + k, 0, 0.9, 3.0), k > 0)
        log.judge(number, Verdict.ACCEPTED)
    return log


def solution(graph: KeyframeGraph, log: ClosureLog) -> MapSolution:
    """The map with these closures, none of which loses weight."""
    problem = graph.problem(log, graph.cut)
    scale = np.full_like(problem.closures.scale, NO_ROBUST_SCALE)
    problem = problem._replace(closures=problem.closures._replace(scale=scale))
    return MapSolution(solve(graph.fit(), problem, 60), log, graph.cut)


CLEAN = [(LAP * lap + 5, LAP * (lap - 1) + 5, 20) for lap in range(1, LAPS)]
FALSE = [(LAP * 2, 12, 30), (LAP * 3 + 5, 30, 30)]
