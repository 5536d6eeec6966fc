"""The grid filter as a backend: dead reckoning, batches, seeds, refused sizes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.core.session import Session
from ratslam.methods.config import GridBackendConfig
from ratslam.methods.grid import GridOutcome
from ratslam.methods.method_registry import Sensors, build
from tactile.base.errors import InputError
from tactile.base.se2 import wrap
from tests.helpers.grid_world import STEADY, create, drive, filter_of, initial, report, settings
from tests.ratslam.methods.grid_filters import FILTER, PRINTED, circuit


def test_without_whiskers_and_body_it_is_dead_reckoning_compiled_once():
    backend = filter_of(settings(body=0.0, drift=STEADY), whiskers=0)
    session = Session(backend)
    reports = [report(0.05, 0.0, whiskers=0), report(0.0, 0.4, whiskers=0)] * 150  # past the first capacity
    steps = list(session.replay(reports[:290])) + [session.step(o) for o in reports[290:]]
    assert session.compilations() == 1
    assert not np.any(session.state.maps)
    assert not any(step.evidence.outcome for step in steps)
    turned = 0.4 * np.arange(150)
    path = 0.05 * np.cumsum(np.exp(1j * turned))
    expected = np.stack([path.real, path.imag, turned], axis=1)
    found = np.array([step.pose for step in steps])
    assert found[::2, :2] == pytest.approx(expected[:, :2], abs=1e-9)
    assert np.asarray(wrap(found[::2, 2] - turned)) == pytest.approx(0, abs=1e-9)
    path = session.map.trajectory()
    assert path[:, :2] == pytest.approx(found[:, :2], abs=1e-9)
    assert wrap(path[:, 2] - found[:, 2]) == pytest.approx(0, abs=1e-9)


@pytest.mark.soak
def test_a_batch_of_seeds_equals_each():
    backend = PRINTED
    reports = [*circuit(6), report(0.05, touching=[0, 2], wall=(0.25, 0.1)), report(-0.05), *circuit(6)]
    together = jax.vmap(backend.init, in_axes=(0, None))(jax.vmap(jax.random.key)(jnp.arange(3)), 256)
    many = jax.jit(
        jax.vmap(backend.kernel, in_axes=(0, None)), compiler_options={"xla_backend_optimization_level": 0}
    )
    outputs = []
    for o in reports:
        together, *output = many(together, o)
        outputs.append(output)
    for seed in range(3):
        alone, estimate, evidence = drive(backend, initial(backend, seed), reports)
        for k, (estimates, proofs) in enumerate(outputs):
            assert np.asarray(estimates.pose[seed]) == pytest.approx(estimate.pose[k], abs=1e-9)
            assert np.array_equal(proofs.ancestor[seed], evidence.ancestor[k])
            assert proofs.outcome[seed] == evidence.outcome[k]
        assert np.asarray(together.maps[seed]) == pytest.approx(np.asarray(alone.maps), abs=1e-9)
        assert GridOutcome.RESAMPLED in evidence.outcome


def test_seeds_differ_and_repeat():
    runs = [drive(FILTER, initial(FILTER, seed), circuit(10))[1].pose for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_more_cells_than_can_be_counted_are_refused():
    config = GridBackendConfig.model_validate({"grid": {"particles": 300_000, "side": 2.5}})
    with pytest.raises(InputError, match="fewer particles"):
        build("grid", config, Sensors((1, 4, 1), create()))
    with pytest.raises(InputError, match="without whiskers"):
        build("grid", config, Sensors((1, 4, 1)))
