"""The grid filter: particles guess the path, and contacts along each path draw the map that weighs it.

`python -m ratslam.examples.grid_filter` drives a whiskered Create through a simulated arena and prints

    after 400 reports: 0.02 m off, odometry 0.1 m
"""

import numpy as np

import ratslam
from evaluation.plots.style import BLUE, GREEN, GREY, add_axes, add_legend, name_axes, new_figure
from ratslam.grid.map import GridMap
from tactile.base.se2 import between, integrate

SHOWN = (25, 100, 400)  # reports


def main() -> None:
    config = ratslam.load_config("create_arena", [f"create_simulation.reports={SHOWN[-1]}"])
    motion, truth, maps = [], [], {}
    with ratslam.open_source(config) as source:
        slam = ratslam.Slam(config, source)
        for sample in source:
            slam.step(sample)
            motion.append(sample.reading.odometry[:3])
            truth.append(sample.truth)
            if slam.steps in SHOWN and isinstance(slam.map, GridMap):
                maps[slam.steps] = slam.map.occupancy()
    paths = {
        "truth": np.array([between(truth[0], pose) for pose in truth]),
        "grid filter": slam.trajectory(),
        "odometry": integrate(np.array(motion)),
    }
    off = {name: np.hypot(*(path - paths["truth"])[:, :2].T).mean() for name, path in paths.items()}
    print(f"after {slam.steps} reports: {off['grid filter']:.1g} m off, odometry {off['odometry']:.1g} m")

    line = f"probability of an obstacle in each cell of {100 * config.grid.cell:g} cm; bright: occupied"
    figure = new_figure(4.4, "The grid filter", line)
    for column, (steps, grid) in enumerate(maps.items()):
        axes = add_axes(figure, 0.75 + 2.4 * column, 1.0, 2.25, 2.25)
        half = len(grid) * config.grid.cell / 2
        axes.imshow(grid, origin="lower", cmap="inferno", vmin=0, vmax=1, extent=(-half, half, -half, half))
        for (name, path), color in zip(paths.items(), (GREEN, BLUE, GREY), strict=True):
            axes.plot(*path[:steps, :2].T, color=color, lw=0.8, label=name)
        axes.set_title(f"{steps} reports", fontsize=10)
        name_axes(axes, "x (m)", "y (m)" if column == 0 else "")
        axes.tick_params(labelleft=column == 0)
    add_legend(figure, axes)
    figure.savefig("grid_filter.png")


if __name__ == "__main__":
    main()
