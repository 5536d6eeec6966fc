"""The grid filter: microseconds per report, in replay and live, on one core, after compilation."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from jax import lax

from ratslam.core.session import Session
from ratslam.grid.config import GridConfig
from ratslam.methods.grid import GridBackend
from robot.simulation.create.simulated_session import CreateSimulation, CreateSimulationConfig
from robot.touch_source import open_touch_source, planar_whiskers_of
from tactile.base.types import stack
from tactile.frontend import TouchConfig


@pytest.fixture(scope="module")
def session():
    """512 reports of a simulated Create, and its whiskers."""
    source = CreateSimulation(CreateSimulationConfig(reports=512, seed=5))
    touch = TouchConfig()
    return [sample.reading for sample in open_touch_source(source, touch)], planar_whiskers_of(source, touch)


def backend(feelers, particles, dtype):
    return GridBackend(GridConfig(particles=particles), feelers, 2.5, dtype)


@pytest.mark.parametrize(("particles", "dtype"), [
    (100, np.float32), (100, np.float64), (1000, np.float32), (10_000, np.float32),
])  # fmt: skip
def test_replay(benchmark, session, particles, dtype):
    observations, feelers = session
    rows = observations[: 512 if particles < 5000 else 64] if benchmark.enabled else observations[:8]
    method = backend(feelers, min(particles, 10_000 if benchmark.enabled else 100), dtype)

    def scanned(state, chunk):
        def step(state, observation):
            state, estimate, _ = method.kernel(state, observation)
            return state, estimate.pose

        return lax.scan(step, state, chunk)

    fast, chunk = jax.jit(scanned), jax.tree.map(jax.numpy.asarray, stack(rows))
    state = method.init(jax.random.key(0), 256)
    jax.block_until_ready(fast(state, chunk))
    benchmark.pedantic(lambda: jax.block_until_ready(fast(state, chunk)), rounds=5)
    if benchmark.stats is not None:
        benchmark.extra_info["us_a_report"] = round(benchmark.stats.stats.median / len(rows) * 1e6)


def test_live(benchmark, session):
    observations, feelers = session
    rows = iter(observations * 20)
    live = Session(backend(feelers, 100, np.float32), precision="float32")
    live.step(next(rows))
    benchmark.pedantic(lambda: live.step(next(rows)), rounds=500 if benchmark.enabled else 3)
