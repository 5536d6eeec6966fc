"""The session: precision, and starting again."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.core.backend import PathMap
from ratslam.core.session import CHUNK, Session, capacity_at
from ratslam.examples import dead_reckoning
from ratslam.methods.method_registry import Sensors
from tactile.base.errors import InputError
from tactile.base.types import Odometry, observation

BACKEND = dead_reckoning.ENTRY.build(dead_reckoning.Config(), Sensors((3, 6, 1)), np.dtype(np.float64))


def test_float64_without_64_bit_types_is_refused():
    with jax.enable_x64(False), pytest.raises(ValueError, match="prepare_precision"):
        Session(BACKEND)


def test_a_restarted_session_repeats_itself_without_compiling_again():
    session = Session(BACKEND)
    walk = [observation(Odometry(0.1, 0.0, 0.1 * k, 0.1)) for k in range(20)]
    first = [step.pose for step in session.replay(walk)]
    session.restart()
    assert session.steps == 0
    assert len(session.map.trajectory()) == 0
    assert np.array_equal(first, [step.pose for step in session.replay(walk)])
    assert session.compilations() == 1


def test_a_map_of_one_piece_refuses_another_and_goes_on():
    session = Session(BACKEND)
    session.step(observation(Odometry(0.1, 0.0, 0.1, 0.1)))
    with pytest.raises(InputError, match="one piece"):
        session.begin_piece()
    assert session.step(observation(Odometry(0.1, 0.0, 0.1, 0.1))).pose[2] == pytest.approx(0.2)


class Table(dead_reckoning.DeadReckoning):
    """A memory of rows, one more at each step, to which its map restores merged ones."""

    def __init__(self, restored):
        super().__init__(dead_reckoning.Config(), Sensors((3, 6, 1)), np.dtype(np.float64))
        self.restored, self.used, self.merged = restored, 0, []

    def init(self, key, capacity):
        return jnp.zeros(capacity)

    def rows(self, state):
        return self.used

    def grow(self, state, capacity):
        return jnp.zeros(capacity)

    def merge_rows(self, state, merged):
        self.merged.append((merged.rows, len(state)))
        self.used = merged.rows
        return state

    def kernel(self, state, observation):
        _, *results = super().kernel(jnp.zeros(3), observation)
        return state, *results

    def new_map(self):
        return RestoringMap(self.restored)


class RestoringMap(PathMap):
    """Merges once, before the second chunk."""

    def __init__(self, rows):
        super().__init__()
        self.rows = rows

    def merge(self):
        return SimpleNamespace(rows=self.rows) if len(self.trajectory()) == CHUNK else None


@pytest.mark.parametrize("rows", [3, 241, 242, 1000])
def test_the_memory_grows_before_merged_rows_are_restored(rows):
    backend = Table(rows)
    session = Session(backend)
    list(session.replay([observation(Odometry(0.1, 0.0, 0.0, 0.1))] * (3 * CHUNK)))
    capacity = capacity_at(rows + CHUNK - 1)
    assert backend.merged == [(rows, capacity)]
    assert session.state.shape == (capacity,)
    assert int(session.arrays()["capacity"]) == capacity
