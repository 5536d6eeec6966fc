"""A small sound backend, and backends that each break one requirement."""

from __future__ import annotations

from enum import IntEnum
from itertools import count
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.core.backend import Backend, PathMap
from ratslam.core.estimates import Action, Estimate, Scalar
from ratslam.methods.method_registry import BackendEntry
from tactile.base.errors import InputError
from tactile.base.plugins import NoSettings


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

    def __init__(self, settings, sensors, dtype):
        self.dtype = dtype

    def init(self, key, capacity):
        return State(jnp.zeros(3, self.dtype), jnp.int32(0))

    def move(self, state, moved):
        return state.pose + jnp.where(jnp.isfinite(moved).all(), moved, 0)

    def kernel(self, state, observation):
        moved = jnp.stack([jnp.asarray(value, self.dtype) for value in observation.odometry[:3]])
        after = State(self.move(state, moved), state.steps + jnp.int32(1))
        evidence = self.evidence(after)
        return after, self.estimate(state, after), evidence

    def evidence(self, state):
        return Evidence(jnp.asarray(self.outcome), state.steps)

    def estimate(self, before, after):
        begun = before.steps > 0
        action = jnp.where(begun, Action.NONE, Action.CREATE).astype(jnp.int32)
        previous = jnp.where(begun, 0, -1).astype(jnp.int32)
        return Estimate(
            after.pose, jnp.zeros_like(after.pose), jnp.int32(0), previous, action, jnp.bool_(False)
        )

    def new_map(self):
        return PathMap()


class NoMap(Sound):
    def new_map(self):
        return object()


class NeedsCamera(Sound):
    def __init__(self, settings, sensors, dtype):
        raise InputError("backend", "views of 18 pixels", "a camera")


class NarrowState(Sound):
    def move(self, state, moved):
        return super().move(state, moved).astype(jnp.float32)


class FlatPose(Sound):
    def estimate(self, before, after):
        return super().estimate(before, after)._replace(pose=after.pose[:2])


class HalfPrecision(Sound):
    def __init__(self, settings, sensors, dtype):
        self.dtype = np.dtype(np.float32)


class FloatOutcome(Sound):
    outcome = np.float64(0)


class UndeclaredOutcome(Sound):
    outcome = np.int32(7)


class Diverging(Sound):
    def move(self, state, moved):
        return jnp.where(state.steps < 100, super().move(state, moved), jnp.inf)


class Trusting(Sound):
    def move(self, state, moved):
        return state.pose + moved


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
        pose = super().move(state, moved) + self.last
        self.last = pose
        return pose


class Peeking(PathMap):
    """Reads the results of later steps of a chunk, which a replay has and a live session does not."""

    def pose(self, estimate):
        return estimate.pose + 1e-6 * estimate.pose.base.sum()


class ReadsAhead(Sound):
    def new_map(self):
        return Peeking()


class Forgetful(PathMap):
    def __init__(self):
        super().__init__()
        self.count = 0

    def update(self, observation, estimate, evidence):
        self.count += 1
        return super().update(observation, estimate, evidence)

    def pose(self, estimate):
        return np.asarray(estimate.pose, float) + 1e-6 * self.count


class LosesCount(Sound):
    def new_map(self):
        return Forgetful()


class WeakFeedback(Sound):
    def apply_map_feedback(self, state, feedback):
        return state._replace(steps=int(state.steps))


class Jumping(Sound):
    def estimate(self, before, after):
        return super().estimate(before, after)._replace(place=after.steps)


class DoublePrecision(Sound):
    def __init__(self, settings, sensors, dtype):
        self.dtype = np.dtype(np.float64)


class Growing(Sound):
    """Forgets the precision when it grows."""

    def grow(self, state, capacity):
        return state._replace(pose=jnp.asarray(state.pose, jnp.float64))


class Pickled(PathMap):
    def arrays(self):
        return super().arrays() | {"notes": [{"a": 1}]}


class Singles(PathMap):
    def closures(self):
        return np.zeros(0, int)

    def pieces(self):
        return np.ones(len(self.trajectory()), int)


class PickledMap(Sound):
    def new_map(self):
        return Pickled()


class SingleClosures(Sound):
    def new_map(self):
        return Singles()


class TwoPieces(Sound):
    def new_map(self):
        made = Singles()
        made.closures = lambda: np.zeros((0, 2), int)
        return made


def entry_of(kind, evidence=Evidence):
    return BackendEntry(NoSettings, evidence, Outcome, kind)
