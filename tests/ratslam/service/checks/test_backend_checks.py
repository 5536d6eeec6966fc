"""The checks of a backend: a sound one passes, and each that breaks one requirement is told what is wrong."""

from __future__ import annotations

from enum import IntEnum
from itertools import count
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.core.backend import Backend, PathMap
from ratslam.core.estimates import Action, Estimate, Scalar
from ratslam.methods.method_registry import BackendEntry
from ratslam.service.backend_checks import BackendTrial
from tactile.base.errors import InputError
from tactile.base.plugins import NoSettings
from tests.ratslam.service.checks.trials import assert_sound, assert_told


class Evidence(NamedTuple):
    outcome: Any
    steps: Scalar


class NoOutcome(NamedTuple):
    steps: Scalar


class Outcome(IntEnum):
    OK = 0


class State(NamedTuple):
    pose: Any
    steps: Any


class Sound(Backend):
    """Adds up the motions without turning; a place for the first step."""

    outcome: Any = np.int32(0)
    map_class: Any = PathMap

    def __init__(self, settings, sensors, dtype):
        self.dtype = dtype

    def init(self, key, capacity):
        return State(jnp.zeros(3, self.dtype), jnp.int32(0))

    def move(self, state, moved):
        return state.pose + jnp.where(jnp.isfinite(moved).all(), moved, 0)

    def kernel(self, state, observation):
        moved = jnp.stack([jnp.asarray(value, self.dtype) for value in observation.odometry[:3]])
        after = State(self.move(state, moved), state.steps + jnp.int32(1))
        return after, self.estimate(state, after), Evidence(jnp.asarray(self.outcome), after.steps)

    def estimate(self, before, after):
        begun = before.steps > 0
        action = jnp.where(begun, Action.NONE, Action.CREATE).astype(jnp.int32)
        previous = jnp.where(begun, 0, -1).astype(jnp.int32)
        return Estimate(
            after.pose, jnp.zeros_like(after.pose), jnp.int32(0), previous, action, jnp.bool_(False)
        )

    def new_map(self):
        return self.map_class()


def entry_of(kind=Sound, evidence=Evidence, **attributes):
    """The entry of a backend of a kind, or of `Sound` with other attributes and methods."""
    kind = type("Broken", (kind,), attributes) if attributes else kind
    return BackendEntry(NoSettings, evidence, Outcome, kind)


class NeedsCamera(Sound):
    def __init__(self, settings, sensors, dtype):
        raise InputError("backend", "views of 18 pixels", "a camera")


def precise(kind):
    """The entry of a backend that computes in one precision only."""
    return entry_of(__init__=lambda self, *_: setattr(self, "dtype", np.dtype(kind)))


class Unseeded(Sound):
    made = count()

    def __init__(self, settings, sensors, dtype):
        super().__init__(settings, sensors, dtype)
        self.noise = 1e-9 * next(self.made)  # as an unseeded random number

    def move(self, state, moved):
        return super().move(state, moved) + jnp.asarray(self.noise, self.dtype)


class Remembering(Sound):
    chunks = 0

    def apply_map_feedback(self, state, feedback):
        self.chunks += 1
        return state._replace(pose=state.pose.at[0].add(1e-6 * self.chunks))


class LeavesTracer(Sound):
    last = 0

    def move(self, state, moved):
        self.last = super().move(state, moved) + self.last
        return self.last


class Peeking(PathMap):
    """Reads the results of later steps of a chunk, which a replay has and a live session does not."""

    def pose(self, estimate):
        return estimate.pose + 1e-6 * estimate.pose.base.sum()


class Forgetful(PathMap):
    """Counts its updates, and saves no count."""

    count = 0

    def update(self, observation, estimate, evidence):
        self.count += 1
        return super().update(observation, estimate, evidence)

    def pose(self, estimate):
        return np.asarray(estimate.pose, float) + 1e-6 * self.count


class Pickled(PathMap):
    def arrays(self):
        return super().arrays() | {"notes": [{"a": 1}]}


class SingleClosures(PathMap):
    def closures(self):
        return np.zeros(0, int)


class TwoPieces(PathMap):
    def pieces(self):
        return np.ones(len(self.trajectory()), int)


def broken_move(change):
    """The entry of a backend whose moves are changed: of the state, and the pose after a sound move."""
    return entry_of(move=lambda self, state, moved: change(state, Sound.move(self, state, moved)))


def broken_estimate(**fields):
    """The entry of a backend with other fields of the estimate, each from the state after the step."""

    def estimate(self, before, after):
        changed = {name: make(after) for name, make in fields.items()}
        return Sound.estimate(self, before, after)._replace(**changed)

    return entry_of(estimate=estimate)


CASES = {
    "no outcome": (entry_of(evidence=NoOutcome), "`outcome`"),
    "settings": (entry_of()._replace(config_class=dict), "subclass of tactile"),
    "builds": (entry_of(NeedsCamera), "it builds: with whiskers: backend: views of 18 pixels"),
    "methods": (entry_of(map_class=object), "have all methods: object without"),
    "state": (
        broken_move(lambda state, pose: pose.astype(jnp.float32)),
        "state.pose is float64 (3,) before a step and float32 (3,) after it",
    ),
    "precision": (precise("float32"), ".pose float32 in a float64 session"),
    "double": (precise("float64"), ".pose float64 in a float32 session"),
    "shape": (broken_estimate(pose=lambda after: after.pose[:2]), "pose is float64 (2,); expected"),
    "dtype": (entry_of(outcome=np.float64(0)), "evidence has its types: outcome is float64 ()"),
    "outcome": (entry_of(outcome=np.int32(7)), "is declared: outcome 7 at step 0"),
    "tracer": (entry_of(LeavesTracer), "UnexpectedTracerError"),
    "nan": (
        broken_move(lambda state, pose: jnp.where(state.steps < 100, pose, jnp.inf)),
        "at step 100 of an ordinary walk",
    ),
    "input": (entry_of(move=lambda self, state, moved: state.pose + moved), "walk with odometry of NaN"),
    "random": (entry_of(Unseeded), "it is deterministic: two sessions"),
    "memory": (entry_of(Remembering), "it keeps no state of its own: a session alone and beside"),
    "live": (entry_of(map_class=Peeking), "replay and live differ: [0].pose"),
    "checkpoint": (entry_of(map_class=Forgetful), "restored after step 1 "),
    "arrays": (entry_of(map_class=Pickled), "a checkpoint continues with the same bits: ValueError"),
    "compilations": (
        entry_of(apply_map_feedback=lambda self, state, _: state._replace(steps=int(state.steps))),
        "2 compilations in 340 steps",
    ),
    "single": (  # forgets the precision when it grows
        entry_of(grow=lambda self, state, _: state._replace(pose=jnp.asarray(state.pose, jnp.float64))),
        "single precision stays single: float64 in state after `grow`.pose",
    ),
    "places": (broken_estimate(place=lambda after: after.steps), "consistent: previous 0 at step 1"),
    "closures": (entry_of(map_class=SingleClosures), "closures are pairs of steps: "),
    "pieces": (entry_of(map_class=TwoPieces), "every step is in a piece: pieces [1]"),
}


def test_a_sound_backend_passes():
    assert_sound(BackendTrial(entry_of(), NoSettings()))


@pytest.mark.parametrize(("entry", "words"), CASES.values(), ids=CASES)
def test_a_broken_backend_is_told_what_is_wrong(entry, words):
    assert_told(BackendTrial(entry, NoSettings()), words)
