"""The classic method at many matching thresholds over one session, in one compiled batch.

The kernel decides which experience is current, so the Experience Metric needs no map; a map is built only for
a threshold of interest.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.backends.classic import ClassicBackend, ClassicEvidence
from ratslam.backends.config import ClassicBackendConfig, select_settings
from ratslam.classic.experience_map import ExperienceMap
from ratslam.config.run_config import RunConfig
from ratslam.core.precision import prepare_precision
from ratslam.core.types import Estimate
from ratslam.experiments.trials.touch_trial import SessionResult, capacity_for, session_result
from robot.sources.in_memory import InMemorySource
from robot.touch_source import observation_of
from tactile.base.types import Array, Observation, stack


class ThresholdBatch(NamedTuple):
    """A session of T steps at B thresholds.

    Attributes:
        threshold: [B]. place: [B, T] current experience. estimate, evidence: of all steps, leading axes
            [B, T].
    """

    threshold: np.ndarray
    place: np.ndarray
    estimate: Estimate
    evidence: ClassicEvidence


def sweep_thresholds(config: RunConfig, log: InMemorySource, thresholds: np.ndarray) -> ThresholdBatch:
    """Runs the classic method at thresholds [B] over the same views.

    Raises:
        ValueError: the configuration has another method.
    """
    if config.backend != "classic":
        raise ValueError(f"backend: {config.backend}; a sweep of thresholds needs backend: classic")
    dtype = np.dtype(config.session.precision)
    prepare_precision(config.session.precision)
    rows = capacity_for(log.length)
    readings = [observation_of(sample) for sample in log]
    chunk = stack(readings + readings[-1:] * (rows - len(readings)))  # padding, cut off below
    method = select_settings(config, ClassicBackendConfig)
    found = _batch(method, log.view_shape, dtype.name, jnp.asarray(thresholds, dtype), chunk)
    estimate, evidence = jax.tree.map(lambda column: np.asarray(column)[:, : log.length], found)
    return ThresholdBatch(np.asarray(thresholds), estimate.place, estimate, evidence)


def result_at_threshold(
    config: RunConfig, log: InMemorySource, batch: ThresholdBatch, number: int
) -> SessionResult:
    """The result of the session at one of the thresholds, with its map."""
    map = ExperienceMap(config.experience)
    for row, sample in enumerate(log):
        one: Any = jax.tree.map(lambda column, row=row: column[number, row], batch[2:])
        map.update(observation_of(sample), *one)
    return session_result(log, batch.place[number], map)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _batch(
    config: ClassicBackendConfig,
    shape: tuple[int, int, int],
    dtype: str,
    thresholds: Array,
    chunk: Observation,
) -> tuple[Estimate, ClassicEvidence]:
    rows = chunk.label.shape[0]

    def one(threshold: Array) -> tuple[Estimate, ClassicEvidence]:
        matching = config.templates.model_copy(update={"threshold": threshold})
        backend = ClassicBackend(config.model_copy(update={"templates": matching}), shape, np.dtype(dtype))

        def step(state: Any, observation: Observation) -> tuple[Any, tuple[Estimate, ClassicEvidence]]:
            state, estimate, evidence = backend.kernel(state, observation)
            return state, (estimate, evidence)

        return lax.scan(step, backend.init(None, rows), chunk)[1]

    return lax.map(one, thresholds)  # sequential; vmap would compute all branches of the network
