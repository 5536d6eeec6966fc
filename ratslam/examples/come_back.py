"""Come back: save a map, find oneself in it on another day, and plan the way to where it began.

`python -m ratslam.examples.come_back` maps a maze, is set down in it somewhere else, and prints

    found after 45 whisks, 0.04 m off; 0.6 m to the start
"""

from pathlib import Path

import numpy as np

import ratslam
from evaluation.plots.style import BLUE, GREY, VERMILLION, add_axes, add_legend, metre_grid, new_figure
from ratslam.places.route import Travel, find_way, nearest_experience, travel_graph
from tactile.base.se2 import compose, fit_rigid_motion

MAZE = ["simulation.maze.seed=31001", "simulation.path.circuits=CCA"]
LATER = ["simulation.maze.seed=31001", "simulation.seed=2", "simulation.path={circuits: AA, start: 11}"]
MAP = Path("maze.npz")


def main() -> None:
    config, truth = ratslam.load_config("whisker_maze", MAZE), []
    with ratslam.open_source(config) as source:
        slam = ratslam.Slam(config, source)
        for sample in source:
            slam.step(sample)
            truth.append(sample.truth)
    slam.save(MAP)
    path = slam.trajectory()

    slam = ratslam.Slam.load(MAP, mode="localise")
    with ratslam.open_source(ratslam.load_config("whisker_maze", LATER)) as source:
        for sample in source:
            estimate = slam.step(sample)
            if not estimate.lost:  # found
                break
    true = compose(fit_rigid_motion(np.array(truth), path), sample.truth)

    graph = travel_graph(slam.map.graph(), Travel(speed=0.02))
    here, start = (nearest_experience(graph, place, 0.1) for place in (estimate.pose, path[0]))
    assert here is not None
    assert start is not None
    way = find_way(graph, here, [start])
    off = np.hypot(*(estimate.pose - true)[:2])
    print(f"found after {slam.steps} whisks, {off:.2f} m off; {way.length:.1f} m to the start")

    line = "a robot set down in a saved map finds itself, and the way to its start"
    figure = new_figure(5.0, "Come back", line)
    axes = add_axes(figure, 0.62, 1.0, 6.9, 3.1)
    axes.plot(*path[:, :2].T, color=GREY, lw=1, label="saved map")
    axes.plot(*slam.trajectory()[-1:, :2].T, color=VERMILLION, marker="o", ms=7, ls="", label="found here")
    axes.plot(*way.poses[:, :2].T, color=BLUE, lw=2, label="way to the start")
    axes.set_aspect("equal")
    metre_grid(axes)
    add_legend(figure, axes)
    figure.savefig("come_back.png")


if __name__ == "__main__":
    main()
