"""Trials of whisker sessions: one session through one matcher, and what the paper's metrics say of it.

A process makes many sessions of the same kind with one compiled kernel: an engine is put back to its start
for each.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.experience_metric import ExmConfig, ExperienceMetric, experience_metric
from ratslam.backends.config import select_settings
from ratslam.backends.registry import BACKENDS, Sensors, build
from ratslam.config.run_config import RunConfig, SessionConfig
from ratslam.core.session import Session, capacity_at
from ratslam.experiments.trials.controls import Control, controlled
from ratslam.pipeline.run import open_source
from robot.sources.in_memory import Log, collected
from robot.touch_source import observation_of, sensing
from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

FALSE = 0.1
"""A closure between steps farther apart in truth is false, m (the paper's threshold, III-G)."""
HOME = 0.09
"""Half a micromouse cell, m: a robot so near its start is back at it."""


class Task(NamedTuple):
    """One session to run.

    Attributes:
        config: with whole paths. control: what is done to the views. seed: of the control. laps: how many of
            the session's; 0: all.
    """

    config: RunConfig
    control: Control = "as felt"
    seed: int = 0
    laps: int = 0


class Played(NamedTuple):
    """What a session led to; T steps.

    Attributes:
        truth, odometry, trajectory: [T, 3] true, reckoned and finally mapped poses. place: [T] current
            experience. node: [M, 3] poses of the experiences in the final map. closures: [K, 2] the later and
            the earlier step of each.
    """

    truth: np.ndarray
    odometry: np.ndarray
    trajectory: np.ndarray
    place: np.ndarray
    node: np.ndarray
    closures: np.ndarray


class TouchTrial(NamedTuple):
    """A session in figures; NaN where there is none.

    Attributes:
        em: Energy Metric over all pairs of steps of the final map. em_places: the same read through the
            experiences: a step lies where its experience does. em_odometry: of raw odometry. m^2 + rad^2.
        arr, arcr: strict Experience Metric. near: share of the re-localisations that are within its
            thresholds, whatever was wrong before them (ARCR without the chain of validity).
        relocalisations: number of them. closures: number of them. false: of these, farther apart than `FALSE`
            in truth. experiences: in the map. steps: of the session.
    """

    em: float
    em_places: float
    em_odometry: float
    arr: float
    arcr: float
    near: float
    relocalisations: int
    closures: int
    false: int
    experiences: int
    steps: int


def session_log(config: RunConfig) -> tuple[RunConfig, Log]:
    """The source of a configuration as a whole in memory, and the configuration completed by it.

    Raises:
        InputError: it cannot be read or simulated, or it has no truth.
    """
    with open_source(config) as source:
        config = config.completed(source)
        log = collected(sensing(source, config.touch))
    if log.truth is None or not np.isfinite(log.truth).all():
        raise InputError(log.name, "steps without a true pose", "the truth of every step, to judge by")
    return config, log


def played(task: Task) -> Played:
    """Runs one session.

    Raises:
        InputError: its source cannot be used.
    """
    config, log = session_log(task.config)
    log = controlled(log, task.control, task.seed)
    if task.laps:
        log = first(log, int(lap_ends(np.asarray(log.truth))[task.laps - 1]) + 1)
    return play(config, log)


def play(config: RunConfig, log: Log) -> Played:
    """Runs a session that is in memory, with a configuration completed by its source."""
    method = select_settings(config, BACKENDS[config.backend].config_class)
    reserve = max(room_for(log.length), config.session.reserve)
    session, start = _compiled(config.backend, method, config.session, log.view_shape, reserve)
    session.map = session.backend.new_map()
    session.restore(start)
    steps = list(session.replay(observation_of(sample) for sample in log))
    place = np.array([int(step.estimate.place) for step in steps])
    return told(log, place, session.map)


def told(log: Log, place: np.ndarray, map: Any) -> Played:
    """What a map holds after the last step of a log, whose experiences were `place` [T]."""
    nodes = map.graph().nodes
    rows = (nodes[k] for k in range(len(nodes)))
    node = np.array([[row["x"], row["y"], row["heading"]] for row in rows]).reshape(-1, 3)
    return Played(
        truth=np.asarray(log.truth),
        odometry=integrate(log.motion[:, :3]),
        trajectory=map.trajectory(),
        place=np.where(place < len(node), place, -1),
        node=node,
        closures=map.closures(),
    )


def figures(result: Played, exm: ExmConfig | None = None) -> TouchTrial:
    """Everything measured on one session."""
    truth, place = result.truth, result.place
    known = place >= 0
    metric = judged(result, exm)
    apart = np.hypot(*(truth[result.closures[:, 0]] - truth[result.closures[:, 1]])[:, :2].T)
    return TouchTrial(
        em=energy_all_pairs(result.trajectory, truth).total,
        em_places=energy_all_pairs(result.node[place[known]], truth[known]).total,
        em_odometry=energy_all_pairs(result.odometry, truth).total,
        arr=metric.arr if metric else np.nan,
        arcr=metric.arcr if metric else np.nan,
        near=chain_free(metric) if metric else np.nan,
        relocalisations=metric.relocalisations if metric else 0,
        closures=len(result.closures),
        false=int((apart > FALSE).sum()),
        experiences=len(result.node),
        steps=len(truth),
    )


def judged(result: Played, exm: ExmConfig | None = None) -> ExperienceMetric | None:
    """The Experience Metric of a session; None where the robot never came back, or knew no place at all."""
    try:
        return experience_metric(result.place, result.truth, exm or ExmConfig())
    except InputError:
        return None


def chain_free(metric: ExperienceMetric) -> float:
    """ARCR without the chain of validity: the share of re-localisations that are near."""
    return float(metric.near[metric.counted].mean()) if metric.counted.any() else np.nan


def lap_ends(truth: np.ndarray) -> np.ndarray:
    """The rows [L] at which the robot was back where it started from, as near as on that visit.

    Args:
        truth: [T, 3] true poses.
    """
    away = np.hypot(*(truth[:, :2] - truth[0, :2]).T)
    change = np.flatnonzero(np.diff((away < HOME).astype(int))) + 1
    visits = np.split(np.arange(len(truth)), change)[2::2]  # at home it begins; then away, home, away ...
    return np.array([visit[np.argmin(away[visit])] for visit in visits], int)


def first(log: Log, steps: int) -> Log:
    """The log's first steps."""
    columns = ("time", "motion", "moved", "views", "seen", "label", "truth")
    cut = {name: getattr(log, name)[:steps] for name in columns if getattr(log, name) is not None}
    return Log(name=log.name, digest=f"{log.digest}[:{steps}]", info=log.info, alive=log.alive, **cut)


def room_for(steps: int) -> int:
    """Rows of memory for a session: a power of two, so that sessions of about one length share a kernel."""
    return capacity_at(max(steps, 1) - 1)


def whole(config: RunConfig, folder: Path) -> RunConfig:
    """The configuration with paths that hold wherever a worker stands."""
    return config.with_absolute_paths(folder.resolve())


@lru_cache(maxsize=2)
def _compiled(
    name: str, method: Settings, settings: SessionConfig, shape: tuple[int, int, int], reserve: int
) -> tuple[Session, dict[str, np.ndarray]]:
    """A session for these settings and its state at the start; compiled functions are kept."""
    session = Session(
        build(name, method, Sensors(shape), settings.precision),
        seed=settings.seed,
        reserve=reserve,
        precision=settings.precision,
    )
    # Copies: what `arrays` gives may be the very memory that the first step hands on.
    return session, {name: np.array(value) for name, value in session.arrays().items()}
