"""Simulated walks by whisker, and sessions that map them."""

from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from ratslam.core.session import Session
from ratslam.mapping.loop_closures import Verdict
from ratslam.runs.build_session import build_session, read_observations
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.head.simulated_session import HeadSimulation
from robot.touch_source import open_touch_source
from tactile.base.se2 import integrate
from tactile.base.types import Observation

SMALL = {"columns": 3, "rows": 3, "loop": 8}
WIDE = {"columns": 5, "rows": 5, "loop": 12}
LAPS = {"maze": SMALL, "path": {"circuits": "CCCC"}}
REACH = 0.1
"""Distance within which a closure is true, m: two pose cells."""


class Walk(NamedTuple):
    readings: list[Observation]
    truth: np.ndarray


class MappedWalk(NamedTuple):
    """A mapped walk: its trajectory, its closures, and the steps before which the odometry is cut."""

    path: np.ndarray
    closures: np.ndarray
    cuts: list[int]


def config_of(**parts: Any) -> RunConfig:
    """A small session: few pose cells, and room for all of it from the start, so that it compiles once."""
    session = {"reserve": 512} | parts.pop("session", {})
    return RunConfig.model_validate({"pose_cells": {"cells_xy": 11}, "session": session, **parts})


@cache
def _compiled(reserve: int, **keyframes: Any) -> tuple[Session, dict[str, np.ndarray]]:
    config = config_of(simulation=LAPS, session={"reserve": reserve}, keyframes=keyframes)
    assert config.simulation is not None
    source = HeadSimulation(config.simulation)
    config = complete(config, source)
    session = build_session(config, open_touch_source(source, config.touch))
    return session, session.arrays()


def empty_session(reserve: int = 512, **keyframes: Any) -> Session:
    """The shared compiled session, empty: all mazes, heads and controls have the same kernel."""
    session, empty = _compiled(reserve, **keyframes)
    session.restore(empty)
    return session


empty_carried_session = partial(empty_session, may_be_carried=True)


def empty_merging_session(merge_stood: int, **keyframes: Any) -> Session:
    """One that merges keyframes soon; 0: none."""
    return empty_session(select_every=30, merge_stood=merge_stood, merge_newest=60, **keyframes)


def simulate_walk(seed: int, dead: Sequence[int] = (), **simulation: Any) -> Walk:
    config = config_of(simulation={"seed": seed} | LAPS | simulation, touch={"head": {"dead": tuple(dead)}})
    assert config.simulation is not None
    source = HeadSimulation(config.simulation, config.touch.head)
    readings = [
        reading for _, reading in read_observations(open_touch_source(source, complete(config, source).touch))
    ]
    return Walk(readings, source.truth)


def follow(session: Session, readings: Sequence[Observation]) -> MappedWalk:
    for _ in session.replay(readings):
        pass
    settled, first = session.map.solution(), session.map.keyframe_steps()
    cuts = first[settled.cut.rows >= 0].tolist()
    return MappedWalk(session.map.trajectory(), session.map.closures(), cuts)


def map_walk(readings: Sequence[Observation], reserve: int = 512) -> MappedWalk:
    return follow(empty_session(reserve), readings)


def dead_reckoning(readings: Sequence[Observation]) -> np.ndarray:
    return integrate(np.array([[o.odometry.dx, o.odometry.dy, o.odometry.dtheta] for o in readings]))


def metric(path: np.ndarray, truth: np.ndarray) -> float:
    return energy_all_pairs(path, truth).total


def odometry_metric(walk: Walk) -> float:
    return metric(dead_reckoning(walk.readings), walk.truth)


def true_share(found: MappedWalk, truth: np.ndarray) -> float:
    apart = truth[found.closures[:, 0]] - truth[found.closures[:, 1]]
    return float((np.hypot(*apart[:, :2].T) < REACH).mean())


def kidnap(walk: Walk, row: int, ahead: int) -> Walk:
    """The same walk without some whisks: the robot is carried ahead, without odometry."""
    rows = np.r_[:row, row + ahead : len(walk.readings)]
    return Walk([walk.readings[k] for k in rows], walk.truth[rows])


def accepted_sequences(session: Session) -> list[int]:
    """The closure sequences of the map; each decides anew which of the others fit."""
    table = session.map.candidates()
    return np.unique(table[table[:, 7] == Verdict.ACCEPTED, 5]).astype(int).tolist()


def shuffled(readings: list[Observation]) -> list[Observation]:
    order = np.random.default_rng(0).permutation(len(readings))
    return [one._replace(view=readings[k].view) for one, k in zip(readings, order.tolist(), strict=True)]


def unseen(readings: list[Observation]) -> list[Observation]:
    return [one._replace(view_seen=np.bool_(False)) for one in readings]


def same_arrays(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> bool:
    assert one.keys() == other.keys()
    return all(np.array_equal(one[name], other[name], equal_nan=one[name].dtype.kind == "f") for name in one)
