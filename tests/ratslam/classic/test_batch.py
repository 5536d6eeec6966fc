"""Sessions in one compiled call equal sessions computed one by one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.classic import pose_cells
from ratslam.classic.batch import Course, Network, networks, trials
from ratslam.classic.config import NetworkConfig, units
from ratslam.classic.excitation_inhibition import ring_difference
from ratslam.classic.levels import window_levels
from ratslam.methods.grid import GridOutcome
from tactile.base.types import Odometry, stack
from tests.helpers.grid_world import drive, initial, report
from tests.ratslam.methods.grid_filters import PRINTED

CONFIG = NetworkConfig(cells_xy=21)
STEPS = 60


def course(seed: int) -> Course:
    stream = np.random.default_rng(seed)
    motion = stream.normal(0, 0.3, (STEPS, 3)) * units(CONFIG, np.dtype(float))
    recall, energy = stream.random((STEPS, 3)) * [21, 21, 36], np.where(np.arange(STEPS) == 30, 0.15, 0.0)
    return Course(motion, recall, energy)


def alone(config: NetworkConfig, given: Course, factor: float) -> np.ndarray:
    levels = window_levels(config, np.dtype(float))

    def step(cells, row):
        motion, recall, energy = row
        odometry = Odometry(motion[0], motion[1], motion[2], jnp.ones(()))
        cells, _ = pose_cells.step(config, levels, cells, odometry, recall, energy * factor)
        return cells, cells.pose

    return np.asarray(
        jax.jit(lambda rows: jax.lax.scan(step, pose_cells.start(config, float), rows)[1])(given)
    )


@pytest.mark.soak
@pytest.mark.parametrize("block", [1, 3])
def test_parameter_sets_are_networks_of_those_parameters(block):
    given, sets = course(1), [(0.9, 2.3, 1e-5, 1.0), (1.2, 1.8, 3e-5, 2.0), (1.0, 2.0, 2e-5, 1.0)]
    columns = Network(*(jnp.asarray(column) for column in zip(*sets, strict=True)))
    pose, _, level = networks(CONFIG, columns, given, block)
    for k, (excite, inhibit, threshold, factor) in enumerate(sets):
        # The dense engine gives the same steps (test_adaptive_window) and compiles sooner.
        config = CONFIG.model_copy(
            update={
                "excite_sigma": excite, "inhibit_sigma": inhibit, "global_inhibition": threshold,
                "engine": "dense",
            }
        )  # fmt: skip
        gap = ring_difference(np.asarray(pose[k]) - alone(config, given, factor), np.array([[21, 21, 36]]))
        assert np.abs(gap).max() <= 1e-9
    assert np.asarray(level[:, 30]).min() > 0
    assert not np.any(level[:, :30])


@pytest.mark.soak
def test_trials_of_other_seeds_and_noise_equal_single_sessions():
    backend = PRINTED  # resamples at every report with evidence
    stream = np.random.default_rng(0)
    courses = [
        [report(float(dx), touching=[k] if k < 2 else ()) for k, dx in enumerate(stream.uniform(0, 0.03, 12))]
        for _ in range(3)
    ]
    states = [backend.init(jax.random.key(seed), 256) for seed in range(3)]
    together = trials(
        backend.kernel,
        jax.tree.map(lambda *rows: jnp.stack(rows), *states),
        jax.tree.map(lambda *rows: np.stack(rows), *(stack(rows) for rows in courses)),
        block=3,
    )
    for seed, rows in enumerate(courses):
        _, estimate, evidence = drive(backend, initial(backend, seed), rows)
        assert GridOutcome.RESAMPLED in evidence.outcome
        assert np.abs(np.asarray(together.pose[seed]) - estimate.pose).max() <= 1e-12
