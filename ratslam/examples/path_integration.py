"""Path integration: odometry moves the packet, and the packet follows it around the torus.

`python -m ratslam.examples.path_integration` drives a loop larger than the network and prints

    12 m driven, the packet 0.023 cells from the odometry in the mean
"""

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.patches import Rectangle

from evaluation.plots.style import BLUE, GREY, INK, add_axes, add_legend, name_axes, new_figure
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig
from ratslam.classic.levels import window_levels
from ratslam.core.compilation import prepare_precision
from tactile.base.se2 import compose, integrate
from tactile.base.types import Odometry

STEPS, FORWARD = 240, 0.05  # m per step


def main() -> None:
    prepare_precision("float64")
    config = NetworkConfig()
    levels = window_levels(config, jnp.float64)
    nowhere, none = jnp.zeros(3), jnp.asarray(0.0)
    step = jax.jit(lambda cells, moved: pose_cells.step(config, levels, cells, moved, nowhere, none))

    turn = 2 * np.pi / STEPS * (1 + 2 * np.sin(6 * np.pi * np.arange(STEPS) / STEPS))  # a bent loop
    motion = np.column_stack([np.full(STEPS, FORWARD), np.zeros(STEPS), turn])
    cells, packet = pose_cells.start(config, jnp.float64), []
    for dx, dy, dtheta in motion:
        cells, _ = step(cells, Odometry(*map(jnp.asarray, (dx, dy, dtheta, 0.5))))
        packet.append(np.asarray(cells.pose))
    middle = (10 * config.cell_size, 10 * config.cell_size, np.pi)  # where the packet starts
    odometry = compose(np.array(middle), integrate(motion))[:, :2] / config.cell_size  # cells
    around = np.array(packet)[:, :2]
    unwrapped = around + config.cells_xy * np.round((odometry - around) / config.cells_xy)
    off = np.hypot(*(unwrapped - odometry).T)
    print(f"{FORWARD * STEPS:.3g} m driven, the packet {off.mean():.2g} cells from the odometry in the mean")

    line = "the square is the torus of 21 x 21 cells: what leaves it on one side returns on the other"
    figure = new_figure(5.0, "Path integration", line)
    plane, torus = add_axes(figure, 0.62, 1.0, 3.2, 3.1), add_axes(figure, 4.5, 1.0, 3.1, 3.1)
    plane.plot(*odometry.T, color=GREY, lw=5, label="odometry")
    plane.plot(*unwrapped.T, color=BLUE, lw=1.2, label="packet, unwrapped")
    plane.add_patch(Rectangle((0, 0), config.cells_xy, config.cells_xy, fill=False, color=INK, lw=0.8))
    plane.set_aspect("equal")
    torus.scatter(around[:, 0], around[:, 1], c=np.arange(len(around)), s=6, cmap="Blues", vmin=-80)
    torus.set(xlim=(0, config.cells_xy), ylim=(0, config.cells_xy), aspect="equal")
    torus.spines[:].set_visible(True)
    for axes in (plane, torus):
        name_axes(axes, "x (cells)", "y (cells)")
    add_legend(figure, plane)
    figure.savefig("path_integration.png")


if __name__ == "__main__":
    main()
