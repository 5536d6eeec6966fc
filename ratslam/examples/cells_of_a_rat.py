"""Cells of a rat: the path of a real rat drives the network; its pose cells are recorded and scored.

`python -m ratslam.examples.cells_of_a_rat` lets the rat run for 300 s in a box of 1 m, and prints

    6 pose cells: 2.70 bits/spike on place, mean vector length 0.96 over heading
"""

import numpy as np

from evaluation.cells.head_direction import mean_vector_length
from evaluation.cells.information import information
from evaluation.cells.rate_map import arena_edges, bin_activity, rate_maps, tuning_curves
from evaluation.plots.cell_plot import draw_cells
from ratslam.classic.config import NetworkConfig
from ratslam.core.compilation import prepare_precision
from ratslam.service.rat_agents import DrivenNetwork
from robot.simulation.rat.rat_path import RatOdometryConfig
from robot.simulation.rat.simulated_session import RatSimulation, RatSimulationConfig

CELLS = 529 + np.arange(6) * 2690  # of 36 x 21 x 21 over heading, y, x


def main() -> None:
    prepare_precision("float64")
    errors = RatOdometryConfig(speed_white=0.1, heading_white=0.05)  # sqrt(s), rad/sqrt(s)
    rat = RatSimulation(RatSimulationConfig(seconds=300, rate_hz=10, odometry=errors))
    network = DrivenNetwork(NetworkConfig(cell_size=0.05), rat.truth[0])  # a torus of 21 x 0.05 = 1.05 m
    activity = []
    for step, (motion, pose) in enumerate(zip(rat.odometry, rat.truth, strict=True)):
        energy = 0.5 if step % 10 == 0 else 0.0  # as if the rat knew the place, once a second
        network.advance(motion, pose, energy)
        activity.append(network.activity[CELLS])
    sums = bin_activity(rat.time, rat.truth, np.array(activity), *arena_edges(rat.truth))

    bits = information(rate_maps(sums), sums.seconds)
    tuning = mean_vector_length(tuning_curves(sums), sums.heading_seconds)
    print(
        f"{len(CELLS)} pose cells: {bits.mean():.2f} bits/spike on place, "
        f"mean vector length {tuning.mean():.2f} over heading"
    )
    draw_cells("Cells of a rat", sums, CELLS).savefig("cells_of_a_rat.png")


if __name__ == "__main__":
    main()
