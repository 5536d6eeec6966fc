"""A minimal backend, which shows that the interface requires no part of RatSLAM."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import networkx
import numpy as np

from ratslam.core.types import Action, Estimate
from tactile.base.se2 import compose, wrap


class NoEvidence(NamedTuple):
    """Evidence with an outcome only."""

    moved: Any


class DeadReckoning:
    """Adds up odometry."""

    def init(self, key, capacity):
        del key, capacity
        return jnp.zeros(3)

    def rows(self, state):
        del state
        return 0

    def grow(self, state, capacity):
        del capacity
        return state

    def apply_map_feedback(self, state, feedback):
        del feedback
        return state

    def kernel(self, state, observation):
        o = observation.odometry
        moved = jnp.where(jnp.isfinite(o.dx + o.dy + o.dtheta), jnp.stack([o.dx, o.dy, o.dtheta]), 0.0)
        c, s = jnp.cos(state[2]), jnp.sin(state[2])
        pose = jnp.stack(
            [
                state[0] + c * moved[0] - s * moved[1],
                state[1] + s * moved[0] + c * moved[1],
                wrap(state[2] + moved[2]),
            ]
        )
        none = jnp.int32(-1)
        estimate = Estimate(pose, jnp.zeros(3), none, none, jnp.int32(Action.NONE), jnp.bool_(False))
        return pose, estimate, NoEvidence(moved)

    def new_map(self):
        return PathMap()


class PathMap:
    """A map that holds a path only."""

    def __init__(self) -> None:
        self.path: list[np.ndarray] = [np.zeros(3)]

    def update(self, observation, estimate, evidence):
        del observation
        self.path.append(compose(self.path[-1], evidence.moved))
        return estimate

    def merge(self) -> None:
        return None

    def feedback(self) -> None:
        return None

    def pose(self, estimate):
        return np.asarray(estimate.pose)

    def trajectory(self):
        return np.array(self.path[1:])

    def map_trajectory(self):
        return self.trajectory()

    def online_trajectory(self):
        return self.trajectory()

    def doubt(self):
        return np.nan

    def final_doubt(self):
        return np.nan

    def closures(self):
        return np.zeros((0, 2), int)

    def pieces(self):
        return np.zeros(len(self.trajectory()), int)

    def graph(self):
        return networkx.DiGraph()

    def files(self):
        return {}

    def arrays(self):
        return {"path": np.array(self.path)}

    def restore(self, arrays) -> None:
        self.path = list(arrays["path"])
