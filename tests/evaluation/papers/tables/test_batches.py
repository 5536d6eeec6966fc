"""Networks and sessions of a batch equal those computed one by one."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.papers.tables.batches import Course, Recording, RecordingSession, SessionBatch, networks
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig, units
from ratslam.classic.excitation_inhibition import ring_difference
from ratslam.classic.levels import window_levels
from tactile.base.types import Odometry
from tests.ratslam.runs.touch_walks import empty_merging_session, simulate_walk

STEPS = 420
"""Not a whole number of chunks; keyframes are merged before."""


@cache
def recorded(seed: int, steps: int = STEPS) -> tuple[RecordingSession, Recording]:
    made = empty_merging_session(1)
    session = RecordingSession(made.backend, reserve=made.reserve)
    readings = simulate_walk(seed, path={"circuits": "CCCCCC"}).readings
    return session, session.record(readings[:steps])


def gap(found, expected) -> float:
    """The largest difference of two states."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return max(float(np.abs(np.asarray(a, float) - np.asarray(b, float)).max(initial=0.0)) for a, b in pairs)


def test_recording_does_not_change_a_session() -> None:
    session, recording = recorded(0)
    other = empty_merging_session(1)
    list(other.replay(simulate_walk(0, path={"circuits": "CCCCCC"}).readings[:STEPS]))
    assert gap(session.state, other.state) == 0
    assert sum(chunk[-1] for chunk in recording.chunks) == STEPS
    assert sum(chunk[0] is not None for chunk in recording.chunks) > 1


@pytest.mark.parametrize("at_once", [False, True])
def test_each_session_of_a_batch_ends_as_by_itself(at_once: bool) -> None:
    recordings = [recorded(seed)[1] for seed in (0, 1, 0)]
    assert gap(recordings[0].state, recordings[1].state) > 0.01
    states = SessionBatch(recorded(0)[0].backend, at_once).replay(recordings)
    for k, recording in enumerate(recordings):
        assert gap(jax.tree.map(lambda rows, k=k: rows[k], states), recording.state) < 1e-9


def test_sessions_of_other_lengths_are_refused() -> None:
    long, short = recorded(0)[1], recorded(0, STEPS - 3)[1]
    with pytest.raises(ValueError, match="same numbers of steps"):
        SessionBatch(recorded(0)[0].backend, False).replay([long, short])


CONFIG = NetworkConfig(cells_xy=21)
SHORT = 60


def course(seed: int) -> Course:
    stream = np.random.default_rng(seed)
    motion = stream.normal(0, 0.3, (SHORT, 3)) * units(CONFIG, np.dtype(float))
    recall, energy = stream.random((SHORT, 3)) * [21, 21, 36], np.where(np.arange(SHORT) == 30, 0.15, 0.0)
    return motion, recall, energy


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
    columns = tuple(jnp.asarray(column) for column in zip(*sets, strict=True))
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
