"""Requirements of any backend, tested on every backend."""

from __future__ import annotations

from functools import cache

import jax
import numpy as np
import pytest

from ratslam.backends.config import ClassicBackendConfig, RecallBackendConfig
from ratslam.backends.grid import GridBackend, GridOutcome
from ratslam.backends.registry import Sensors, build
from ratslam.core.session import CHUNK, Session, capacity_at
from ratslam.core.types import Action
from ratslam.grid.config import GridConfig
from tactile.base.types import Odometry, observation
from tactile.whiskers.planar_whiskers import PlanarWhiskers
from tests.ratslam.backends.dead_reckoning import DeadReckoning

VIEW = (3, 6, 1)
WHISKERS = VIEW[0] * VIEW[1]
BEARING = np.arange(WHISKERS) * 2 * np.pi / WHISKERS
AROUND = np.stack([np.cos(BEARING), np.sin(BEARING)], axis=1)
REACH = 0.2


def _ratslam(name, source, dtype=np.float64, **more):
    # Both engines of the pose cells, each with one source of views.
    engine = "window" if source == "views" and not more else "dense"
    cells = {"cells_xy": 11, "engine": engine}
    parts = {"pose_cells": cells, "templates": {"source": source}}
    kind = {"recall": RecallBackendConfig, "classic": ClassicBackendConfig}[name]
    return lambda: build(name, kind.model_validate(parts | more), Sensors(VIEW), dtype)


def _grid(dtype=np.float64):
    # With large odometry noise, so that it resamples throughout the session.
    doubtful = {
        "drift": {"step": 0.3, "heading": 0.05},
        "likelihood": {"free": 0.5, "contact": 4.0},
        "resampling": {"min_effective_share": 0.9},
    }
    config = GridConfig.model_validate({"particles": 20} | doubtful)
    feelers = PlanarWhiskers(np.zeros((WHISKERS, 2)), AROUND, np.full(WHISKERS, REACH))
    return lambda: GridBackend(config, feelers, 3.0, dtype)


# Selects sequences every few frames, so that it does so throughout the session.
TOUCH = {
    "recall": {"sector_fov": "whiskers"},
    "keyframes": {"select_every": 15, "may_be_carried": True, "sequence_agreement": 0.2},
}


BACKENDS = {
    "recall": _ratslam("recall", "views"),
    "recall-labels": _ratslam("recall", "labels"),
    "touch": _ratslam("recall", "views", **TOUCH),
    "classic": _ratslam("classic", "views"),
    "classic-labels": _ratslam("classic", "labels"),
    "grid": _grid(),
    "dead-reckoning": DeadReckoning,
}


SINGLE = {
    "recall": _ratslam("recall", "views", np.float32),
    "recall-labels": _ratslam("recall", "labels", np.float32),
    "touch": _ratslam("recall", "views", np.float32, **TOUCH),
    "classic": _ratslam("classic", "views", np.float32),
    "classic-labels": _ratslam("classic", "labels", np.float32),
    "grid": _grid(np.float32),
}


OFTEN = {"recall-labels"}
"""Backends that differ from another one only by the source of views: for `make soak`."""


def some(names):
    """The names as parameters, those of `OFTEN` for the soak."""
    return [pytest.param(name, marks=pytest.mark.soak) if name in OFTEN else name for name in names]


@pytest.fixture(params=some(BACKENDS))
def make(request):
    return BACKENDS[request.param]


def walk(count: int, seed: int = 0):
    """Laps of a small circuit with repeated views; some steps have no view, and in some the whiskers are in
    contact."""
    stream, touch = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    places = stream.random((17, *VIEW))
    for k in range(count):
        turn = 2 * np.pi / 17 + stream.normal(0, 0.01)
        odometry = Odometry(0.05 + stream.normal(0, 0.002), stream.normal(0, 0.002), turn, 0.1)
        seen = stream.random() > 0.1
        o = observation(
            odometry, places[k % 17] if seen else None, view_shape=VIEW, label=k % 17 if seen else -1,
            whiskers=WHISKERS,
        )  # fmt: skip
        contact = touch.random(WHISKERS) < (0.2 if k % 5 == 0 else 0.0)
        yield o._replace(contact=contact, point=np.where(contact[:, None], REACH * AROUND, 0.0))


@cache
def compiled(make) -> Session:
    return Session(make())


def fresh(make) -> Session:
    """The session of this backend, at its start; all tests share its compiled function."""
    session = compiled(make)
    session.restart()
    return session


@cache
def replayed(make):
    """The steps of a replay of `walk(340)`, and the arrays of the session at its end."""
    session = fresh(make)
    return list(session.replay(walk(340))), session.arrays()


def equal(a, b) -> bool:
    return all(
        np.array_equal(x, y, equal_nan=True)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def test_kernel_keeps_shapes_and_dtypes(make):
    backend = make()
    state = backend.init(jax.random.key(0), 256)
    after, estimate, _ = jax.eval_shape(backend.kernel, state, next(walk(1)))
    kinds = [
        jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype, leaf.weak_type), tree) for tree in (state, after)
    ]
    assert kinds[0] == kinds[1]
    assert estimate.pose.shape == estimate.spread.shape == (3,)
    assert estimate.place.dtype == estimate.previous.dtype == estimate.action.dtype == np.int32


def test_replay_and_live_are_the_same_bits(make):
    expected = replayed(make)[0][:150]
    live = fresh(make)
    assert equal(expected, [live.step(o) for o in walk(150)])


def test_any_mixture_of_live_and_replay_is_the_same_bits(make):
    observations = list(walk(150))
    mixed = fresh(make)
    steps = [mixed.step(o) for o in observations[:30]]
    steps += mixed.replay(observations[30:101])
    steps += [mixed.step(o) for o in observations[101:110]]
    steps += mixed.replay(observations[110:])
    assert equal(steps, replayed(make)[0][:150])


@pytest.mark.parametrize("stop", [1, 64, 77, 256, 300])
def test_a_restored_session_continues_as_if_never_stopped(make, stop):
    observations = list(walk(340))
    expected, whole = replayed(make)
    first = fresh(make)
    list(first.replay(observations[:stop]))
    saved = first.arrays()
    second = fresh(make)
    second.restore(saved)
    assert equal(expected[stop:], list(second.replay(observations[stop:])))
    assert second.arrays().keys() == whole.keys()
    assert equal(whole, second.arrays())


def test_every_step_is_in_a_piece(make):
    session = fresh(make)
    assert len(session.map.pieces()) == 0
    list(session.replay(walk(150)))
    piece = session.map.pieces()
    assert piece.shape == (150,)
    assert piece[0] == 0
    assert set(piece.tolist()) == set(range(piece.max() + 1))


def test_a_batch_of_sessions_equals_each_session(make):
    backend = make()
    runs = [list(walk(20, seed)) for seed in range(3)]
    batch = [jax.tree.map(lambda *rows: np.stack(rows), *step) for step in zip(*runs, strict=True)]
    options = {"xla_backend_optimization_level": 0}  # few steps: compiling takes most of the time
    one = jax.jit(backend.kernel, compiler_options=options)
    many = jax.jit(jax.vmap(backend.kernel), compiler_options=options)
    alone = [backend.init(jax.random.key(0), 256) for _ in runs]
    together = jax.tree.map(lambda *rows: np.stack(rows), *alone)
    for k, step in enumerate(batch):
        together, estimate, _ = many(together, step)
        for r, run in enumerate(runs):
            alone[r], expected, _ = one(alone[r], run[k])
            assert np.allclose(estimate.pose[r], expected.pose, atol=1e-9)
            assert estimate.place[r] == expected.place
            assert estimate.action[r] == expected.action


def test_places_are_consistent(make):
    previous, known = -1, set()
    for step in fresh(make).replay(walk(200)):
        place, action = int(step.estimate.place), Action(int(step.estimate.action))
        assert int(step.estimate.previous) == previous
        if action == Action.CREATE:
            assert place not in known
        elif action in (Action.LINK, Action.SET):
            assert place in known
            assert place != previous
        else:
            assert place == previous
        known.add(place)
        previous = place


def test_invalid_input_gives_finite_results(make):
    session = fresh(make)
    still = observation(Odometry(0, 0, 0, 0.1), np.full(VIEW, 0.5), label=3, whiskers=WHISKERS)
    odd = still._replace(odometry=Odometry(*(np.float64(v) for v in (np.nan, np.inf, 0, 0.1))))
    blind = still._replace(view=np.full(VIEW, np.nan))
    for o in (still, odd, blind, still):
        step = session.step(o)
        assert np.isfinite(step.pose).all()
        assert np.isfinite(step.estimate.pose).all()
        assert np.isfinite(step.estimate.spread).all()


@pytest.mark.parametrize("kind", some(SINGLE))
def test_single_precision_stays_single_and_finite(kind):
    session = Session(SINGLE[kind](), precision="float32")
    for step in session.replay(walk(200)):
        assert np.isfinite(step.pose).all()
        blank = {"background": 0.0} if hasattr(step.evidence, "background") else {}
        evidence = step.evidence._replace(**blank)
        floats = [leaf for leaf in [*step.estimate[:2], *evidence] if np.asarray(leaf).dtype.kind == "f"]
        assert all(np.isfinite(leaf).all() for leaf in floats if leaf is not getattr(evidence, "error", None))
    grown = session.backend.grow(session.state, 512)
    kinds = {leaf.dtype for leaf in jax.tree.leaves((session.state, grown))}
    assert np.dtype(np.float64) not in kinds
    assert np.dtype(np.float32) in kinds
    assert np.isfinite(session.map.trajectory()).all()


def test_touch_closes_loops_and_selects_sequences_in_these_walks():
    # Otherwise the tests of replay, checkpoints and capacities would not cover it.
    _, arrays = replayed(BACKENDS["touch"])
    assert arrays["map/appearance/likeness/0"].any()
    weight = arrays["map/log/weight"]
    assert ((weight > 0) & (weight < 1)).any()


def test_the_grid_filter_resamples_in_these_walks():
    # Otherwise the tests of replay and checkpoints would not cover it.
    outcomes = np.array([step.evidence.outcome for step in replayed(BACKENDS["grid"])[0]])
    assert 10 < (outcomes == GridOutcome.RESAMPLED).sum() < 330


def test_compiles_once_per_capacity(make):
    session = fresh(make)  # which other tests have used too
    observations = list(walk(300))
    list(session.replay(observations))
    for o in observations[:5]:
        session.step(o)
    capacities = {capacity_at(step) for step in range(305)}
    assert session.compilations() <= len(capacities)
    reserved = Session(make(), reserve=512)
    list(reserved.replay(observations))
    assert reserved.compilations() == 1


def test_warming_up_changes_only_the_time_of_compilation(make):
    warm = Session(make())
    warm.warm(next(walk(1)))
    assert (warm.compilations(), warm.steps) == (1, 0)
    assert equal([warm.step(o) for o in walk(20)], replayed(make)[0][:20])
    assert warm.compilations() == 1


@pytest.mark.parametrize("name", ["classic", "classic-labels", "grid", "dead-reckoning"])
def test_memory_does_not_grow_on_known_ground(name):
    """Otherwise time and memory of long sessions on known ground would grow."""
    session = Session(BACKENDS[name]())
    list(session.replay(walk(600)))
    assert session.compilations() == 1


def test_capacity_depends_on_the_chunk_alone():
    assert {capacity_at(step) for step in range(256)} == {256}
    assert capacity_at(256) == 512
    assert len({capacity_at(step) for step in range(CHUNK * 4, CHUNK * 5)}) == 1
    assert capacity_at(0, 1000) == 1024
