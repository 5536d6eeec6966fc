"""Sessions on laps whose places look alike: loops are closed by what the pose cells do, and the network grows
with the same bits live, in replay and restored, with and without a probe."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.core.session import CHUNK, Probe, Session
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from ratslam.network import pose_cells
from ratslam.network.pose_cells import Belief
from tactile.base.se2 import between
from tests.helpers import scenes

PLACES, LOOKS = 40, 8
STEP = 1.8 * scenes.CELL
"""Way between two views, m: more than the excitation of a packet reaches."""


def laps(count):
    stream = np.random.default_rng(1)
    path = scenes.followed([(STEP, 2 * np.pi / PLACES)] * (PLACES * count - 1))
    motion = np.zeros((len(path), 4))
    motion[1:, :3] = between(path[:-1], path[1:])
    motion[1:] += stream.normal(0, [0.02 * STEP, 0.0, 0.003, 0.0], (len(path) - 1, 4))
    motion[:, 3] = 0.5
    look = stream.permutation(np.arange(PLACES) % LOOKS)[np.arange(len(path)) % PLACES]
    views = stream.random((LOOKS, 18))[look] + stream.normal(0, 0.012, (len(path), 18))
    log = scenes.recorded(path, motion, np.clip(views, 0, 1))
    return [sample.reading for sample in log]


def session_of(cells=21, **settings):
    """A session of recall with so many pose cells along x and along y at first; 21 cover the circle."""
    sections = {"pose_cells": {"cells_xy": cells, "cell_size": scenes.CELL}}
    config = RecallBackendConfig.model_validate(sections)
    return Session(RecallBackend(config, (3, 6, 1), np.dtype(float)), **settings)


CELLS, LAPS = 11, 7
PROBED = 160
"""Steps of the session with a probe."""
STOPS = 24, PROBED, 245
"""In the middle of a chunk between two doublings, and before and after the capacity has grown."""


readings = cache(lambda: laps(LAPS))
compiled = cache(lambda: session_of(CELLS))
"""A session without a probe; every test begins it anew, and nothing is compiled twice."""


def begun():
    compiled().restart()
    return compiled()


class Run:
    """The results of a session over all readings, and its arrays in the end and where it stopped."""

    def __init__(self, session, sizes):
        self.steps, self.stops, self.kinds, at = [], {}, [], 0
        for size in sizes:
            chunk = readings()[at : at + size]
            self.steps += session.replay(chunk) if size > 1 else [session.step(chunk[0])]
            at += size
            activity, mass = session.state.belief
            self.kinds.append((mass.shape[1], *activity.shape[:0:-1]))
            if at in STOPS:
                self.stops[at] = session.arrays()
        self.arrays, self.closures = session.arrays(), session.map.closures()


@cache
def live():
    """One reading at a time."""
    return Run(begun(), [1] * len(readings()))


def assert_same_steps(one, other):
    for both in zip(one, other, strict=True):
        first, second = (step._replace(probed=None, seldom=None) for step in both)
        jax.tree.map(np.testing.assert_array_equal, first, second)


def test_the_network_doubles_on_the_way_and_loops_are_closed():
    run = live()
    sides = [kind[1:] for kind in run.kinds]
    assert sorted(set(sides)) == [(CELLS, CELLS), (CELLS, 2 * CELLS), (2 * CELLS, 2 * CELLS)]
    assert sides == sorted(sides)
    assert sides.index((CELLS, 2 * CELLS)) == CHUNK, "only between chunks"
    assert sides[STOPS[0] - 1] == (CELLS, 2 * CELLS)
    assert {kind[0] for kind in run.kinds} == {256, 512}, "the capacity grows too"
    assert run.steps[-1].evidence.certainty > 0.9
    assert len(run.closures) > (LAPS - 3) * PLACES


@pytest.mark.parametrize("sizes", [[280], [7, 16, 33, 64, 1, 159]], ids=["whole", "parts"])
def test_live_and_replay_give_the_same_bits(sizes):
    run = Run(begun(), sizes)
    assert_same_steps(run.steps, live().steps)
    np.testing.assert_equal(run.arrays, live().arrays)
    assert run.arrays["sides"].tolist() == [2 * CELLS, 2 * CELLS]
    assert compiled().compilations() == len(set(live().kinds))


@pytest.mark.parametrize("stop", [0, *STOPS])
def test_a_restored_session_goes_on_with_the_same_bits(stop):
    whole, session, end = live(), begun(), 40 if stop == 0 else None
    session.restore(whole.stops[stop] if stop else session.arrays())
    assert_same_steps(session.replay(readings()[stop:end]), whole.steps[stop:end])
    if stop:
        np.testing.assert_equal(session.arrays(), whole.arrays)


CHOSEN = np.random.default_rng(0).choice(36 * CELLS**2, 2000, replace=False)


@cache
def probed():
    """A session whose chosen cells are recorded at every step, and all of them at every 20th."""
    backend = session_of(CELLS).backend
    cells = backend.probe()
    probe = Probe(lambda state: cells.each(state, CHOSEN), cells.hold, 20)
    session = session_of(CELLS, probe=probe)
    return cells, list(session.replay(readings()[:PROBED])), session.arrays()


def test_a_session_with_a_probe_has_the_same_results_and_chosen_cells_are_read_as_all_cells_are():
    _, steps, arrays = probed()
    assert_same_steps(steps, live().steps[:PROBED])
    np.testing.assert_equal(arrays, live().stops[PROBED])
    both = [step for step in steps if step.seldom is not None]
    assert len(both) == len(steps) // 20
    assert sum(step.probed.any() for step in both) > 2
    for step in both:
        assert step.probed.dtype == np.float32
        assert np.array_equal(step.probed, step.seldom[CHOSEN])


@pytest.mark.parametrize("layers", [1, -4])
def test_the_preferred_poses_of_cells_turn_with_the_robot(layers):
    """Cells are read as odometry has moved them since the last view, without its systematic errors."""
    backend = compiled().backend
    belief = Belief(np.random.default_rng(0).random((36, CELLS, CELLS)).astype(np.float32), np.zeros((1, 9)))
    state = backend.init(None, 256)._replace(belief=belief)
    memory = state.memory._replace(turn_error=jnp.asarray(0.25))
    turn = jnp.asarray([0.0, 0.0, 0.8 * layers * np.pi / 18])
    state = state._replace(memory=memory.accumulate_motion(turn))
    expected = np.roll(belief.activity, layers, axis=0).ravel()
    found = jax.jit(backend.probe().each)(state, CHOSEN)
    assert np.asarray(found) == pytest.approx(expected[CHOSEN], abs=1e-4)


def test_the_probe_names_active_cells_packet_and_certainty():
    cells, steps, *_ = probed()
    assert cells.shape == (36, CELLS, CELLS)
    for step in steps:
        if step.seldom is not None:
            at, activity = cells.active(step.seldom)
            assert (activity > 0).all()
            assert np.array_equal(activity, step.seldom[at])
            assert not np.delete(step.seldom, at).any()
        packet = np.array(cells.packet(step.evidence))
        assert ((packet >= 0) & (packet < [CELLS, CELLS, 36])).all()
        assert cells.energy(step.evidence) == step.evidence.certainty


def decisions():
    """Posteriors [T] and closures [M, 2] of a session of a fixed size that is compiled with the network as it
    is now."""
    session = session_of()
    steps = list(session.replay(readings()[: 6 * PLACES]))
    return np.array([step.evidence.posterior for step in steps]), session.map.closures()


def test_the_intact_network_closes_every_loop():
    posterior, closures = decisions()
    assert len(closures) > 4 * PLACES
    apart = (closures[:, 0] - closures[:, 1]) % PLACES
    assert np.isin(apart, [0, 1, PLACES - 1]).all()
    assert (apart == 0).mean() > 0.98
    assert (posterior > 0.5).sum() > 4 * PLACES


LESIONS = {
    "integrate_path": lambda cells, motion: cells,
    "anchor": lambda network, belief, cells, mass: belief,  # no activity that views drive
}


@pytest.mark.parametrize("part", LESIONS)
def test_no_loop_is_closed_with_a_lesion(monkeypatch, part):
    monkeypatch.setattr(pose_cells, part, LESIONS[part])
    assert len(decisions()[1]) == 0
