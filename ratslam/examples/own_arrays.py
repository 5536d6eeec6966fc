"""A source of one's own: NumPy arrays of times, odometry and views, here pressures on 3 x 22 taxels.

`python -m ratslam.examples.own_arrays` maps four laps of a circle with a noisy gyro and prints

    arrays: 400 steps, ATE 0.006 m, odometry 0.2 m
"""

import hashlib

import numpy as np
from pydantic import PositiveInt

import ratslam
from robot.sources.in_memory import InMemorySource
from robot.sources.odometry import from_velocities
from robot.sources.source import SOURCES, Source, SourceEntry, SourceInfo
from tactile.base.se2 import integrate
from tactile.base.settings import Settings

LAP, LAPS, RADIUS = 100, 4, 1.0  # s, laps, m


class Config(Settings):
    rate: PositiveInt = 1
    """Samples per second."""


def open_arrays(config: Config) -> Source:
    count, random = LAPS * LAP * config.rate, np.random.default_rng(0)
    time, turn = np.arange(count) / config.rate, np.full(count, 2 * np.pi / LAP)  # s, rad/s
    gyro = turn + np.repeat(random.normal(0.0, 0.02, LAPS * LAP), config.rate)
    there = np.maximum(random.uniform(-2.0, 1.0, (LAP, 3, 22, 1)), 0.0)  # at each of 100 places, in 0..1
    views = there[time.astype(int) % LAP] * random.normal(1.0, 0.05, (count, 3, 22, 1))
    return InMemorySource(
        name="arrays",
        digest=hashlib.sha256(views.tobytes()).hexdigest(),  # tells recordings apart
        time=time,
        motion=from_velocities(time, RADIUS * turn, 0.0, gyro),
        moved=np.ones(count, bool),
        views=views.clip(0.0, 1.0),
        seen=np.ones(count, bool),
        label=np.full(count, -1, np.int32),
        truth=integrate(from_velocities(time, RADIUS * turn, 0.0, turn)[:, :3]),
        info=SourceInfo(cell_size=0.05),
        alive=np.ones(3 * 22, bool),  # leave it out for a camera or a laser
    )


ENTRY = SourceEntry(Config, lambda config, warn: open_arrays(config))  # what an entry point names

if __name__ == "__main__":
    SOURCES.register("arrays", ENTRY)
    config = ratslam.load_config("whisker_maze", ["simulation=null", "source.plugin=arrays"])
    found = ratslam.run(config).scorecard.quantities
    steps, ate = found["steps"].value, found["ate_final"]
    print(f"arrays: {steps} steps, ATE {ate.value:.1g} m, odometry {ate.odometry:.1g} m")
