"""A whisker session through one backend, held in memory, and the metrics of the paper on the result.

A process runs many sessions of one kind with one compiled kernel: a session object is reset to its start for
each of them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.experience_metric import ExmConfig, ExperienceMetric, experience_metric
from ratslam.backends.config import select_settings
from ratslam.backends.registry import BACKENDS, Sensors, build
from ratslam.config.run_config import RunConfig, SessionConfig
from ratslam.core.precision import prepare_precision
from ratslam.core.session import Session, capacity_at
from ratslam.pipeline.source import open_observations
from robot.sources.in_memory import InMemorySource, load_into_memory
from robot.touch_source import observation_of
from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

FALSE_CLOSURE_DISTANCE = 0.1
"""A closure is false if its steps are farther apart in truth, m (Salman & Pearson 2016, III-G)."""
HOME_RADIUS = 0.09
"""A robot this near to its start has returned to it, m: half a micromouse cell."""


class SessionResult(NamedTuple):
    """The outcome of a session of T steps.

    Attributes:
        truth, odometry, trajectory: [T, 3] true, dead-reckoned and final mapped poses. place: [T] current
            experience, -1 for none. node: [M, 3] poses of the experiences in the final map.
        closures: [K, 2] later and earlier step of each loop closure.
    """

    truth: np.ndarray
    odometry: np.ndarray
    trajectory: np.ndarray
    place: np.ndarray
    node: np.ndarray
    closures: np.ndarray


class TouchMetrics(NamedTuple):
    """Metrics of one session; NaN where a metric is not defined.

    Attributes:
        em: Energy Metric over all pairs of steps of the final map, m^2 + rad^2. em_experiences: the same with
            each step at the pose of its experience. em_odometry: the same of dead reckoning.
        arr, arcr: strict Experience Metric. arcr_chain_free: share of the re-localisations within its
            thresholds, whether or not earlier ones were correct.
        relocalisations, closures: counts. false_closures: closures beyond `FALSE_CLOSURE_DISTANCE`.
        experiences: in the map. steps: of the session.
    """

    em: float
    em_experiences: float
    em_odometry: float
    arr: float
    arcr: float
    arcr_chain_free: float
    relocalisations: int
    closures: int
    false_closures: int
    experiences: int
    steps: int


def collect_session(config: RunConfig) -> tuple[RunConfig, InMemorySource]:
    """The configuration completed by its source, and the whole source in memory.

    Raises:
        InputError: the source cannot be read or simulated, or lacks the true pose of a step.
    """
    with open_observations(config) as (config, source):
        log = load_into_memory(source)
    if log.truth is None or not np.isfinite(log.truth).all():
        raise InputError(log.name, "steps without a true pose", "the true pose of every step")
    return config, log


def run_session(config: RunConfig, log: InMemorySource) -> SessionResult:
    """Runs a session from memory, with a configuration completed by its source."""
    session = _session_at_start(config, log.view_shape, capacity_for(log.length))
    steps = list(session.replay(observation_of(sample) for sample in log))
    place = np.array([int(step.estimate.place) for step in steps])
    nodes = session.map.graph().nodes
    rows = (nodes[k] for k in range(len(nodes)))
    node = np.array([[row["x"], row["y"], row["heading"]] for row in rows]).reshape(-1, 3)
    return SessionResult(
        truth=np.asarray(log.truth),
        odometry=integrate(log.motion[:, :3]),
        trajectory=session.map.trajectory(),
        place=np.where(place < len(node), place, -1),
        node=node,
        closures=session.map.closures(),
    )


def touch_metrics(result: SessionResult, exm: ExmConfig | None = None) -> TouchMetrics:
    """All metrics of one session."""
    truth, place = result.truth, result.place
    known = place >= 0
    metric = experience_metric_if_defined(result, exm)
    return TouchMetrics(
        em=energy_all_pairs(result.trajectory, truth).total,
        em_experiences=energy_all_pairs(result.node[place[known]], truth[known]).total,
        em_odometry=energy_all_pairs(result.odometry, truth).total,
        arr=metric.arr if metric else np.nan,
        arcr=metric.arcr if metric else np.nan,
        arcr_chain_free=arcr_without_chain(metric) if metric else np.nan,
        relocalisations=metric.relocalisations if metric else 0,
        closures=len(result.closures),
        false_closures=int((closure_errors(result) > FALSE_CLOSURE_DISTANCE).sum()),
        experiences=len(result.node),
        steps=len(truth),
    )


def closure_errors(result: SessionResult) -> np.ndarray:
    """[K] true distance between the two steps of each closure, m."""
    later, earlier = result.truth[result.closures[:, 0]], result.truth[result.closures[:, 1]]
    return np.hypot(*(later - earlier)[:, :2].T)


def experience_metric_if_defined(
    result: SessionResult, exm: ExmConfig | None = None
) -> ExperienceMetric | None:
    """The Experience Metric; None where the robot never returned to its start or has no experience."""
    try:
        return experience_metric(result.place, result.truth, exm or ExmConfig())
    except InputError:
        return None


def arcr_without_chain(metric: ExperienceMetric) -> float:
    """Share of the re-localisations that are near the truth, whether or not earlier ones were correct."""
    return float(metric.near[metric.counted].mean()) if metric.counted.any() else np.nan


def lap_ends(truth: np.ndarray) -> np.ndarray:
    """[L] steps at which the robot returned to its start: the nearest step of each visit.

    Args:
        truth: [T, 3] true poses.
    """
    away = np.hypot(*(truth[:, :2] - truth[0, :2]).T)
    change = np.flatnonzero(np.diff((away < HOME_RADIUS).astype(int))) + 1
    visits = np.split(np.arange(len(truth)), change)[2::2]  # the path alternates: home, away, home, ...
    return np.array([visit[np.argmin(away[visit])] for visit in visits], int)


def truncate_log(log: InMemorySource, steps: int) -> InMemorySource:
    """The first steps of a log."""
    columns = ("time", "motion", "moved", "views", "seen", "label", "truth")
    cut = {name: getattr(log, name)[:steps] for name in columns if getattr(log, name) is not None}
    return InMemorySource(
        name=log.name, digest=f"{log.digest}[:{steps}]", info=log.info, alive=log.alive, **cut
    )


def capacity_for(steps: int) -> int:
    """Memory rows for a session: a power of two, so that sessions of similar length share a kernel."""
    return capacity_at(max(steps, 1) - 1)


def _session_at_start(config: RunConfig, shape: tuple[int, int, int], reserve: int) -> Session:
    """A session at its start; a recently compiled one is used again."""
    method = select_settings(config, BACKENDS[config.backend].config_class)
    reserve = max(reserve, config.session.reserve)
    session = _compiled(config.backend, method, config.session, shape, reserve)
    session.restart(config.session.seed)
    return session


@lru_cache(maxsize=2)
def _compiled(
    name: str, method: Settings, settings: SessionConfig, shape: tuple[int, int, int], reserve: int
) -> Session:
    prepare_precision(settings.precision)
    return Session(
        build(name, method, Sensors(shape), settings.precision),
        seed=settings.seed,
        reserve=reserve,
        precision=settings.precision,
    )
