"""The first loop: odometry drifts until the robot recognises a place, and the map turns the drift back.

`python -m ratslam.examples.first_loop` drives along a square to the first loop closures and prints

    step 119: odometry 0.2 m off, map 0.1 m off
"""

import numpy as np

import ratslam
from evaluation.plots.style import BLUE, GREY, INK, VERMILLION, add_axes, add_legend, metre_grid, new_figure
from tactile.base.se2 import between, integrate


def main() -> None:
    config = ratslam.load_config("square")
    motion, truth, before = [], [], np.zeros((0, 3))
    with ratslam.open_source(config) as source:
        slam = ratslam.Slam(config, source)
        for sample in source:
            slam.step(sample)
            motion.append(sample.reading.odometry[:3])
            truth.append(sample.truth)
            if len(slam.map.closures()):
                break
            before = slam.trajectory()
    true = np.array([between(truth[0], pose) for pose in truth])
    paths = {"odometry": integrate(np.array(motion)), "before": before, "after": slam.trajectory()}
    off = {name: np.hypot(*(path[-1] - true[len(path) - 1])[:2]) for name, path in paths.items()}
    print(f"step {slam.steps}: odometry {off['odometry']:.1g} m off, map {off['after']:.1g} m off")

    figure = new_figure(5.0, "The first loop", "loop closures join the robot's place with its first visit")
    for column, name in enumerate(("before", "after")):
        axes = add_axes(figure, 0.62 + 3.7 * column, 1.0, 3.2, 3.1)
        axes.plot(*true[:, :2].T, color=INK, lw=0.8, label="truth")
        axes.plot(*paths["odometry"][:, :2].T, color=GREY, ls="--", lw=1, label="odometry")
        axes.plot(*paths[name][:, :2].T, color=BLUE, lw=1.4, label="map")
        axes.set_aspect("equal")
        metre_grid(axes)
    ends = paths["after"][slam.map.closures(), :2]
    lines = np.insert(ends, 2, np.nan, axis=1).reshape(-1, 2)  # separate lines
    axes.plot(*lines.T, color=VERMILLION, lw=1, marker="o", ms=3, label="loop closure")
    add_legend(figure, axes)
    figure.savefig("first_loop.png")


if __name__ == "__main__":
    main()
