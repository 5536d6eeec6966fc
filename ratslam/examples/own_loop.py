"""A loop of one's own: readings go in one at a time, poses come out.

`python -m ratslam.examples.own_loop` drives four circuits of a simulated maze and prints

    circuit 4: 0.08 m off, odometry 0.3 m
"""

import numpy as np

import ratslam
from tactile.base.se2 import between, integrate

SETTINGS = ["simulation.maze.columns=3", "simulation.maze.rows=3", "simulation.maze.loop=8"]


def main() -> None:
    config = ratslam.load_config("whisker_maze", [*SETTINGS, "simulation.path.circuits=CCCC"])
    path, motions, truth = [], [], []
    with ratslam.open_source(config) as source:
        slam = ratslam.Slam(config, source)
        for sample in source:  # or your robot's readings
            path.append(slam.step(sample).pose)
            motions.append(sample.reading.odometry[:3])
            truth.append(sample.truth)
    true = np.array([between(truth[0], pose) for pose in truth])
    odometry = integrate(np.array(motions))
    last = slice(3 * len(true) // 4, None)
    off, raw = (np.hypot(*(found - true)[last, :2].T).mean() for found in (np.array(path), odometry))
    print(f"circuit 4: {off:.1g} m off, odometry {raw:.1g} m")


if __name__ == "__main__":
    main()
