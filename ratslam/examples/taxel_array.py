"""A touch front end of one's own: 3 x 22 taxels around the robot, read at 50 Hz.

`python -m ratslam.examples.taxel_array` maps the arrays of `own_arrays` at that rate with it and prints

    taxels: 400 views, ATE 0.006 m, odometry 0.2 m
"""

import numpy as np
from pydantic import PositiveFloat, PositiveInt

import ratslam
from ratslam.core.arrays import Checkpointed
from ratslam.examples import own_arrays
from robot.sources.source import SOURCES
from robot.touch_source import TOUCH, TouchEntry
from tactile.base.se2 import compose
from tactile.base.settings import Settings
from tactile.base.types import Observation, Odometry, observation


class Config(Settings):
    frames: PositiveInt = 50  # their largest pressures make one view: a second at 50 Hz
    contact: PositiveFloat = 0.05  # pressure of a contact, as a share of full scale


class TaxelArray(Checkpointed):
    view_shape, whiskers = (3, 22, 1), 3 * 22
    VALUES = ("count", "pose", "dt", "peak")  # remembered between readings

    def __init__(self, config: Config) -> None:
        self.config = config
        self.clear()

    def clear(self) -> None:
        self.count, self.pose, self.dt, self.peak = 0, np.zeros(3), 0.0, np.zeros(self.view_shape)

    def observe(self, reading: Observation) -> Observation | None:
        """The view of a window after its last frame; until then None, while motion and peaks add up."""
        self.pose = compose(self.pose, np.array(reading.odometry[:3]))
        self.dt, self.count = self.dt + reading.odometry.dt, self.count + 1
        self.peak = np.maximum(self.peak, reading.view)
        if self.count < self.config.frames:
            return None
        view = np.where(self.peak >= self.config.contact, self.peak, 0.0)
        made = observation(Odometry._make([*self.pose, self.dt]), view, whiskers=self.whiskers)
        self.clear()
        return made._replace(contact=view.reshape(-1) > 0)


ENTRY = TouchEntry(Config, lambda config, info: TaxelArray(config))  # what an entry point names

if __name__ == "__main__":
    SOURCES.register("arrays", own_arrays.ENTRY)
    TOUCH.register("taxels", ENTRY)
    settings = ["simulation=null", "source.plugin=arrays", "source.settings.rate=50"]
    config = ratslam.load_config("whisker_maze", [*settings, "touch.frontend.plugin=taxels"])
    found = ratslam.run(config).scorecard.quantities
    views, ate = found["steps"].value, found["ate_final"]
    print(f"taxels: {views} views, ATE {ate.value:.1g} m, odometry {ate.odometry:.1g} m")
