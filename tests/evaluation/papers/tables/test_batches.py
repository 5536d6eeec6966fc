"""Networks and sessions of a batch equal those computed one by one; tables of times add up."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from evaluation.papers.tables import batches, cycles
from evaluation.papers.tables.batches import Recording, RecordingSession, SessionBatch
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig, units
from ratslam.classic.excitation_inhibition import ring_difference
from ratslam.classic.levels import window_levels
from tactile.base.types import Odometry
from tests.evaluation.papers.shown import rows_of
from tests.ratslam.runs.touch_walks import empty_merging_session, simulate_walk

STEPS = 420
"""Not a whole number of chunks; keyframes are merged before."""


@cache
def recorded(seed: int) -> tuple[RecordingSession, Recording]:
    made = empty_merging_session(1)
    session = RecordingSession(made.backend, reserve=made.reserve)
    return session, session.record(simulate_walk(seed, path={"circuits": "CCCCCC"}).readings[:STEPS])


def gap(found, expected) -> float:
    """The largest difference of two states."""
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return max(float(np.abs(np.asarray(a, float) - np.asarray(b, float)).max(initial=0.0)) for a, b in pairs)


@pytest.mark.parametrize("at_once", [False, pytest.param(True, marks=pytest.mark.soak)])
def test_each_session_of_a_batch_ends_as_by_itself(at_once: bool) -> None:
    """Sessions of other lengths are refused."""
    recordings = [recorded(seed)[1] for seed in (0, 1, 0)]
    chunks = recordings[0].chunks
    assert sum(chunk[-1] for chunk in chunks) == STEPS
    assert sum(chunk[0] is not None for chunk in chunks) > 1
    assert gap(recordings[0].state, recordings[1].state) > 0.01
    batch = SessionBatch(recorded(0)[0].backend, at_once)
    states = batch.replay(recordings)
    for k, recording in enumerate(recordings):
        assert gap(jax.tree.map(lambda rows, k=k: rows[k], states), recording.state) < 1e-9
    short = recordings[0]._replace(chunks=[(*chunks[0][:-1], chunks[0][-1] - 3), *chunks[1:]])
    with pytest.raises(ValueError, match="same numbers of steps"):
        batch.replay([recordings[0], short])


CONFIG = NetworkConfig(cells_xy=21)
SHORT = 60


@pytest.mark.soak
def test_parameter_sets_are_networks_of_those_parameters():
    """The dense engine gives the same steps (test_adaptive_window) and compiles sooner."""
    network, stream = NetworkConfig(cells_xy=21), np.random.default_rng(1)
    motion = stream.normal(0, 0.3, (60, 3)) * units(network, np.dtype(float))
    recall, energy = stream.random((60, 3)) * [21, 21, 36], np.where(np.arange(60) == 30, 0.15, 0.0)
    sets = [(0.9, 2.3, 1e-5, 1.0), (1.2, 1.8, 3e-5, 2.0), (1.0, 2.0, 2e-5, 1.0)]
    columns = tuple(jnp.asarray(column) for column in zip(*sets, strict=True))
    pose, _, level = batches.networks(network, columns, (motion, recall, energy), 3)
    for k, (excite, inhibit, threshold, factor) in enumerate(sets):
        changed = {"excite_sigma": excite, "inhibit_sigma": inhibit, "global_inhibition": threshold}
        config = network.model_copy(update=changed | {"engine": "dense"})
        cells, levels, expected = pose_cells.start(config, float), window_levels(config, np.dtype(float)), []
        step = jax.jit(lambda *row, config=config, levels=levels: pose_cells.step(config, levels, *row)[0])
        for moved, place, injected in zip(motion, recall, energy * factor, strict=True):
            cells = step(cells, Odometry(*map(jnp.asarray, moved), jnp.ones(())), place, injected)
            expected.append(np.asarray(cells.pose))
        apart = ring_difference(np.asarray(pose[k]) - np.array(expected), np.array([[21, 21, 36]]))
        assert np.abs(apart).max() <= 1e-9
    assert np.asarray(level[:, 30]).min() > 0
    assert not np.any(level[:, :30])


@pytest.mark.soak
def test_the_batch_table_times_networks_sets_and_sessions(monkeypatch):
    for name, value in {"BATCH_SIZES": (11,), "SINGLE": 4, "FEW": 4, "RECORDED": 2}.items():
        monkeypatch.setattr(batches, name, value)
    _, *rows = rows_of(list(batches.batch_table(sets=10, sessions=3, steps=40, rounds=1)))
    assert [what.split(",")[0] for what, _, _ in rows] == [
        *["one network of 11 cells a side"] * 2, *["2 sets of 21 cells"] * 3, *["2 sessions of 40 steps"] * 2
    ]  # fmt: skip
    assert all(device == "one core" and float(us) > 0 for _, device, us in rows)
    assert float(rows[5][0].rsplit(" ", 1)[1]) < 1e-9


@pytest.mark.soak
def test_the_cycle_table_times_replayed_and_live_steps(monkeypatch):
    monkeypatch.setattr(cycles, "BACKENDS", ("classic",))
    _, *rows = rows_of(list(cycles.cycle_table(["square"], rounds=1)))
    for row, dtype in zip(rows, ("float64", "float32"), strict=True):
        assert row[:4] == ["square", "classic", dtype, "349"]
        mean, median, percentile, slowest, clock = map(float, row[4:])
        assert 0 < median <= percentile <= 1e3 * slowest + 50
        assert slowest <= clock + 0.1
        assert mean > 0


def test_the_parts_of_a_cycle_add_up_to_its_time():
    _, *rows = rows_of(list(cycles.profile_table(["square"])))
    assert [name for name, *_ in rows] == [*cycles.PARTS, "all"]
    parts = {name: float(recall) for name, recall, _ in rows}
    whole = parts.pop("all")
    assert sum(parts.values()) == pytest.approx(whole, abs=len(parts))
    assert all(parts[name] > 0 for name in ("views and belief (compiled kernel)", "closures", "solver"))
    assert parts["judge"] == 0  # of whiskers only


def test_the_time_of_library_functions_counts_for_those_that_call_them():
    own, wrapper, builtin = ("/a/ratslam/x.py", 1, "f"), ("/lib/w.py", 1, "w"), ("~", 0, "b")
    root = ("/lib/main.py", 1, "main")
    stats = {
        own: (1, 1, 2.0, 7.0, {root: (1, 1, 2.0, 7.0)}),
        wrapper: (1, 1, 1.0, 4.0, {own: (1, 1, 1.0, 4.0)}),
        builtin: (2, 2, 4.0, 4.0, {wrapper: (1, 1, 3.0, 3.0), own: (1, 1, 1.0, 1.0)}),
    }
    assert cycles.own_times(stats)[own] == pytest.approx(7.0)
