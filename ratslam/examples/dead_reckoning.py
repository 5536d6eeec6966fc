"""A backend of one's own: dead reckoning that corrects the scale of the odometer's distances.

`python -m ratslam.examples.dead_reckoning` maps the square recording and prints

    dead reckoning: ATE 0.25 m
"""

from enum import IntEnum
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import ratslam
from ratslam.core.backend import Backend, PathMap
from ratslam.core.estimates import Action, Estimate, Scalar
from ratslam.core.session import finite_values
from ratslam.methods.method_registry import BACKENDS, BackendEntry, Sensors
from tactile.base.se2 import compose
from tactile.base.settings import Settings
from tactile.base.types import Observation


class Config(Settings):
    scale: float = 1.0  # factor on the distances of the odometry


Outcome = IntEnum("Outcome", ["OK", "NOT_FINITE"], start=0)


class Evidence(NamedTuple):
    outcome: Scalar
    distance: Scalar  # a column of steps.csv


class DeadReckoning(Backend):
    def __init__(self, config: Config, sensors: Sensors, dtype: np.dtype) -> None:
        self.scale, self.dtype = config.scale, dtype

    def init(self, key: Any, capacity: int) -> Any:
        return jnp.zeros(3, self.dtype)

    def kernel(self, state: Any, observation: Observation) -> tuple[Any, Estimate, Evidence]:
        (dx, dy, turn, _), *_, clean = finite_values(self.dtype, observation)
        pose = compose(state, jnp.stack([self.scale * dx, self.scale * dy, turn]))
        none, outcome = jnp.int32(-1), jnp.where(clean, *map(jnp.int32, Outcome))
        estimate = Estimate(pose, jnp.zeros_like(pose), none, none, jnp.int32(Action.NONE), ~clean)
        return pose, estimate, Evidence(outcome, self.scale * jnp.hypot(dx, dy))

    new_map = PathMap


ENTRY = BackendEntry(Config, Evidence, Outcome, DeadReckoning)  # what an entry point names

if __name__ == "__main__":
    BACKENDS.register("dead_reckoning", ENTRY)
    config = ratslam.load_config("square", ["backend=dead_reckoning", "backend_settings.scale=0.98"])
    print(f"dead reckoning: ATE {ratslam.run(config).scorecard.quantities['ate_final'].value:.2g} m")
