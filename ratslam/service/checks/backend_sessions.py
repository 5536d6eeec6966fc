"""Checks of a method in sessions: same bits live, replayed and restored, finite results, compilations."""

from __future__ import annotations

import io
from itertools import pairwise
from typing import Any

import jax
import numpy as np

from ratslam.core.estimates import Action
from ratslam.core.session import CHUNK, Session, Step, capacity_at
from ratslam.service.checks.backend_trial import CAPACITY, STEPS, VIEW, BackendTrial
from ratslam.service.checks.check_results import Check, Violation, leaves, require, require_equal
from tactile.base.types import Odometry

LIVE, SHORT, BATCHED = 150, 3 * CHUNK, 20
"""Steps compared: live and mixed; of further sessions; of a batch."""
STOPS = (1, 176, 205, 256, 300)
"""Steps at which a session is stopped and restored, inside chunks and at their ends."""
RESERVED = 512
"""Rows reserved by a session that must not compile again in `STEPS` steps."""


def _outcomes(trial: BackendTrial) -> str:
    declared = {int(outcome) for outcome in trial.entry.outcomes}
    found = [int(step.evidence.outcome) for step in trial.steps]
    wrong = [k for k, outcome in enumerate(found) if outcome not in declared]
    if wrong:
        names = ", ".join(f"{outcome.value} {outcome.name}" for outcome in trial.entry.outcomes)
        raise Violation(f"outcome {found[wrong[0]]} at step {wrong[0]}", f"one of {names}")
    return ", ".join(trial.entry.outcomes(outcome).name for outcome in sorted(set(found)))


def _require_finite(steps: list[Step], what: str) -> None:
    for k, step in enumerate(steps):
        record = {"pose of the map": step.pose, "pose": step.estimate.pose, "spread": step.estimate.spread}
        for name, value in record.items():
            require(bool(np.isfinite(value).all()), f"{name} {value} at step {k} of {what}", "finite numbers")


def _finite(trial: BackendTrial) -> str:
    _require_finite(trial.steps, "an ordinary walk")
    return ""


def _invalid_input(trial: BackendTrial) -> str:
    first = trial.walk(1)[0]
    still = first._replace(view=np.full(VIEW, 0.5), view_seen=np.bool_(True), label=np.int32(3))
    odd = still._replace(odometry=Odometry(*map(np.float64, (np.nan, np.inf, 0.0, 0.1))))
    inputs = {
        "odometry of NaN": odd,
        "odometry of infinity": still._replace(odometry=Odometry(*map(np.float64, (0.0, 0.0, -np.inf, 0.1)))),
        "a view of NaN": still._replace(view=np.full(VIEW, np.nan)),
        "no view": still._replace(view=np.zeros(VIEW), view_seen=np.bool_(False), label=np.int32(-1)),
        "an ordinary step after these": still,
    }
    session = trial.fresh()
    _require_finite([session.step(still)], "an ordinary walk")
    for name, one in inputs.items():
        _require_finite([session.step(one)], f"a walk with {name}")
    return ""


def _deterministic(trial: BackendTrial) -> str:
    session = Session(trial.build())
    found = list(session.replay(trial.walk(SHORT)))
    require_equal(trial.steps[:SHORT], found, "two sessions of equal settings, seed and input")
    return ""


def _live(trial: BackendTrial) -> str:
    live = trial.fresh()
    found = [live.step(o) for o in trial.walk(LIVE)]
    require_equal(trial.steps[:LIVE], found, "replay and live")
    return ""


def _mixed(trial: BackendTrial) -> str:
    observations, mixed = trial.walk(LIVE), trial.fresh()
    found = [mixed.step(o) for o in observations[:30]]
    found += mixed.replay(observations[30:101])
    found += [mixed.step(o) for o in observations[101:110]]
    found += mixed.replay(observations[110:])
    require_equal(trial.steps[:LIVE], found, "replay and a mixture of live and replay")
    return ""


def _separate(trial: BackendTrial) -> str:
    first, second = trial.fresh(), Session(trial.backend)
    ours, others = trial.walk(SHORT), trial.walk(SHORT, seed=1)
    found: list[Step] = []
    beside: list[Step] = []
    for k in range(0, SHORT, CHUNK):
        found += first.replay(ours[k : k + CHUNK])
        beside += second.replay(others[k : k + CHUNK])
    require_equal(trial.steps[:SHORT], found, "a session alone and beside another one")
    second.restart()
    alone = list(second.replay(others))
    require_equal(alone, beside, "a session alone and beside another one")
    return ""


def _checkpoint(trial: BackendTrial) -> str:
    expected, observations = trial.steps, trial.walk(STEPS)
    first, saved = trial.fresh(), []
    for begin, stop in pairwise((0, *STOPS)):
        list(first.replay(observations[begin:stop]))
        saved.append(_through_file(first.arrays()))
    for stop, arrays in zip(STOPS, saved, strict=True):
        second = trial.fresh()
        second.restore(arrays)
        what = f"a session and one restored after step {stop}"
        require_equal(expected[stop:], list(second.replay(observations[stop:])), what)
        require_equal(trial.arrays, second.arrays(), f"the arrays of {what}")
    return ""


def _through_file(arrays: dict[str, Any]) -> dict[str, np.ndarray]:
    """The arrays as a checkpoint file gives them back."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    file.seek(0)
    with np.load(file, allow_pickle=False) as found:
        return {name: found[name] for name in found.files}


def _warm(trial: BackendTrial) -> str:
    session = Session(trial.backend)
    first, *_ = trial.walk(1)
    session.warm(first)
    require(session.steps == 0, f"{session.steps} steps after warming up", "none")
    found = [session.step(o) for o in trial.walk(SHORT)]
    require_equal(trial.steps[:SHORT], found, "a session and one warmed up before it")
    count = session.compilations()
    require(count == 1, f"{count} compilations in a session warmed up before its first step", "1")
    return ""


def _compilations(trial: BackendTrial) -> str:
    observations = trial.walk(STEPS)
    reserved = Session(trial.backend, reserve=RESERVED)
    for o in observations[:5]:
        reserved.step(o)
    list(reserved.replay(observations[5:]))
    count = reserved.compilations()
    require(count == 1, f"{count} compilations in {STEPS} steps with {RESERVED} rows reserved", "1")
    replayed = len(trial.steps)  # by the same compiled functions
    session = trial.fresh()
    for o in observations[:5]:
        session.step(o)
    capacities = len({capacity_at(step) for step in range(replayed)})
    count = session.compilations()
    found = f"{count} compilations of sessions with {capacities} capacities"
    require(count <= capacities, found, "one per capacity")
    return f"{count} in {STEPS} steps from {CAPACITY} rows"


def _batch(trial: BackendTrial) -> str:
    backend = trial.backend
    runs = [trial.walk(BATCHED, seed) for seed in range(3)]
    batch = [jax.tree.map(lambda *rows: np.stack(rows), *step) for step in zip(*runs, strict=True)]
    options = {"xla_backend_optimization_level": 0}  # few steps: compiling takes most of the time
    one = jax.jit(backend.kernel, compiler_options=options)
    many = jax.jit(jax.vmap(backend.kernel), compiler_options=options)
    alone = [backend.init(jax.random.key(0), CAPACITY) for _ in runs]
    together = jax.tree.map(lambda *rows: np.stack(rows), *alone)
    for k, step in enumerate(batch):
        together, estimate, _ = many(together, step)
        for r, run in enumerate(runs):
            alone[r], expected, _ = one(alone[r], run[k])
            same = np.allclose(estimate.pose[r], expected.pose, atol=1e-9)
            same &= bool(estimate.place[r] == expected.place) & bool(estimate.action[r] == expected.action)
            found = f"pose {estimate.pose[r]} in a batch and {expected.pose} alone at step {k}"
            require(same, found, "the same estimate within 1e-9")
    return ""


def _places(trial: BackendTrial) -> str:
    previous, known = -1, set[int]()
    for k, step in enumerate(trial.steps):
        place, action = int(step.estimate.place), Action(int(step.estimate.action))
        what = f"action {action.name} from place {previous} to {place} at step {k}"
        found = f"previous {int(step.estimate.previous)} at step {k}"
        require(int(step.estimate.previous) == previous, found, f"{previous}, the place of the step before")
        if action == Action.CREATE:
            require(place not in known, what, "a place that is new")
        elif action in (Action.LINK, Action.SET):
            require(place in known and place != previous, what, "another place that is known")
        else:
            require(place == previous, what, "the same place")
        known.add(place)
        previous = place
    return f"{len(known - {-1})} places"


def _single(trial: BackendTrial) -> str:
    session, steps = trial.single
    _require_finite(steps, "a walk in float32")
    grown = session.backend.grow(session.state, 2 * CAPACITY)
    kinds = {"state": session.state, "state after `grow`": grown}
    wrong = [
        f"{name}{jax.tree_util.keystr(path)}"
        for name, tree in kinds.items()
        for path, leaf in jax.tree.leaves_with_path(tree)
        if leaf.dtype == np.float64
    ]
    for name, record in (("estimate", steps[-1].estimate), ("evidence", steps[-1].evidence)):
        # The map may complete the estimate with Python numbers.
        wrong += [path for path, leaf in leaves(record, name) if getattr(leaf, "dtype", None) == np.float64]
    require(not wrong, f"float64 in {', '.join(wrong)} of a float32 session", "float32")
    return ""


SESSION_CHECKS = (
    Check("every outcome is declared", "the outcome of a step is written by its name", _outcomes),
    Check("results are finite", "one NaN spoils all later poses", _finite),
    Check("invalid input gives finite results", "sensors fail; the session must go on", _invalid_input),
    Check("it is deterministic", "a result could not be reproduced", _deterministic),
    Check("it keeps no state of its own", "sessions of one backend would disturb each other", _separate),
    Check("live and replay give the same bits", "a recording would not show what the robot did", _live),
    Check("any mixture of live and replay gives the same bits", "a session may change between them", _mixed),
    Check("a checkpoint continues with the same bits", "`run --continue` would change the map", _checkpoint),
    Check("it compiles once per capacity", "a live robot would wait for the compiler", _compilations),
    Check("warming up changes no result", "a live session compiles before it starts", _warm),
    Check("a batch equals its members", "studies and batches vmap the kernel", _batch),
    Check("places are consistent", "places and links of the map are read from them", _places),
    Check("single precision stays single", "float32 sessions would be slow, or not run", _single),
)
