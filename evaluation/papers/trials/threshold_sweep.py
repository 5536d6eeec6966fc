"""The classic method at many matching thresholds over one session, in one compiled batch.

The kernel decides which experience is current, so the Experience Metric needs no map.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from evaluation.papers.trials.touch_trial import capacity_for
from ratslam.core.estimates import Estimate
from ratslam.core.precision import prepare_precision
from ratslam.methods.classic import ClassicBackend, ClassicEvidence
from ratslam.methods.config import ClassicBackendConfig, select_settings
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import InMemorySource
from robot.touch_source import observation_of
from tactile.base.types import Array, Observation, stack


def sweep_thresholds(
    config: RunConfig, log: InMemorySource, thresholds: np.ndarray
) -> tuple[Estimate, ClassicEvidence]:
    """Estimate and evidence of T steps with the classic method at thresholds [B]; leading axes [B, T].

    Raises:
        ValueError: the configuration has another method.
    """
    if config.backend != "classic":
        raise ValueError(f"backend: {config.backend}; a sweep of thresholds needs backend: classic")
    dtype = np.dtype(config.session.precision)
    prepare_precision(config.session.precision)
    readings = [observation_of(sample) for sample in log]
    padding = readings[-1:] * (capacity_for(log.length) - len(readings))  # cut off below
    chunk = stack(readings + padding)
    method = select_settings(config, ClassicBackendConfig)
    found = _batch(method, log.view_shape, dtype.name, jnp.asarray(thresholds, dtype), chunk)
    return jax.tree.map(lambda column: np.asarray(column)[:, : log.length], found)


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
