"""A backend of one's own: dead reckoning that corrects the scale of the odometer's distances.

`python -m ratslam.examples.dead_reckoning` maps the square recording with it and prints

    dead reckoning: ATE 0.05 m
"""

from enum import IntEnum
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.backends.registry import BACKENDS, BackendEntry, Sensors
from ratslam.core.backend import Backend, Map
from ratslam.core.path_map import PathMap
from ratslam.core.types import Action, Estimate, Scalar
from tactile.base.config import Settings
from tactile.base.se2 import compose
from tactile.base.types import Observation


class Config(Settings):
    scale: float = 1.0
    """Factor on the distances of the odometry."""


class Outcome(IntEnum):
    OK = 0
    NOT_FINITE = 1


class Evidence(NamedTuple):
    outcome: Any
    distance: Scalar  # a column of steps.csv


class DeadReckoning(Backend):
    def __init__(self, config: Config, sensors: Sensors, dtype: np.dtype) -> None:
        self.scale, self.dtype = config.scale, dtype

    def init(self, key: Any, capacity: int) -> Any:
        return jnp.zeros(3, self.dtype)

    def kernel(self, state: Any, observation: Observation) -> tuple[Any, Estimate, Evidence]:
        dx, dy, turn = (jnp.asarray(value, self.dtype) for value in observation.odometry[:3])
        moved = jnp.stack([self.scale * dx, self.scale * dy, turn])
        clean = jnp.isfinite(moved).all()
        pose = compose(state, jnp.where(clean, moved, 0))
        none, unknown = jnp.int32(-1), jnp.zeros(3, self.dtype)
        estimate = Estimate(pose, unknown, none, none, jnp.int32(Action.NONE), jnp.bool_(False))
        outcome = jnp.where(clean, Outcome.OK, Outcome.NOT_FINITE).astype(jnp.int32)
        return pose, estimate, Evidence(outcome, jnp.hypot(moved[0], moved[1]))

    def new_map(self) -> Map:
        return PathMap()


ENTRY = BackendEntry(Config, Evidence, Outcome, DeadReckoning)
"""What a package names in its entry-point group `ratslam.backends`."""

if __name__ == "__main__":
    import ratslam

    BACKENDS.register("dead_reckoning", ENTRY)
    settings = ["backend=dead_reckoning", "backend_settings.scale=0.98"]
    result = ratslam.run(ratslam.load_config("square", settings))
    print(f"dead reckoning: ATE {result.scorecard.quantities['ate_final'].value:.2g} m")
