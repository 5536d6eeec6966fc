"""A whisker session through one backend, held in memory.

A process runs many sessions of one kind with one compiled kernel: a session object is reset to its start for
each of them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from evaluation.studies.session_metrics import SessionResult
from ratslam.core.backend import Backend
from ratslam.core.precision import Precision, prepare_precision
from ratslam.core.session import Session, capacity_at
from ratslam.methods.method_registry import Sensors, backend_settings, build
from ratslam.runs.open_source import open_observations
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import InMemorySource, load_into_memory
from robot.touch_source import observation_of
from tactile.base.errors import InputError
from tactile.base.se2 import integrate
from tactile.base.settings import Settings


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


def run_session(
    config: RunConfig,
    log: InMemorySource,
    start: Callable[[RunConfig, InMemorySource], Session] | None = None,
) -> SessionResult:
    """Runs a session from memory, with a configuration completed by its source.

    Args:
        start: makes the session; None: `start_session`.
    """
    session = (start or start_session)(config, log)
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
        live=np.array([step.pose for step in steps]),
        piece=session.map.pieces(),
    )


def start_session(config: RunConfig, log: InMemorySource) -> Session:
    """A session at its start, for a configuration completed by its source; the next call takes it back."""
    session = _compiled(*_kind(config, log))
    session.restart(config.session.seed)
    return session


def new_session(
    config: RunConfig, log: InMemorySource, change: Callable[[Backend], None] | None = None
) -> Session:
    """The same, compiled anew and for the caller alone.

    Args:
        change: is done to the backend before.
    """
    session = _build(*_kind(config, log), change)
    session.restart(config.session.seed)
    return session


def capacity_for(steps: int) -> int:
    """Memory rows for a session: a power of two, so that sessions of similar length share a kernel."""
    return capacity_at(max(steps, 1) - 1)


def _kind(
    config: RunConfig, log: InMemorySource
) -> tuple[str, Settings, Precision, tuple[int, int, int], int]:
    method = backend_settings(config.backend, config)
    reserve = max(capacity_for(log.length), config.session.reserve)
    return config.backend, method, config.session.precision, log.view_shape, reserve


def _build(
    name: str,
    method: Settings,
    precision: Precision,
    shape: tuple[int, int, int],
    reserve: int,
    change: Callable[[Backend], None] | None = None,
) -> Session:
    prepare_precision(precision)
    backend = build(name, method, Sensors(shape), precision)
    if change is not None:
        change(backend)
    return Session(backend, reserve=reserve, precision=precision)


_compiled = lru_cache(maxsize=2)(_build)
"""A session of any state; a recently compiled one is used again."""
