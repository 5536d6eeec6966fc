"""One activity packet: a single active cell grows into a stable packet, which stands for the robot's pose.

`python -m ratslam.examples.one_packet` lets the pose cells settle without motion and prints

    after 20 steps: 93 of 15876 active, sd 0.99 cells
"""

import jax
import jax.numpy as jnp
import numpy as np

from evaluation.plots.style import BLUE, add_axes, name_axes, new_figure
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig
from ratslam.classic.levels import to_full_torus, window_levels
from ratslam.core.compilation import prepare_precision
from tactile.base.types import Odometry

SHOWN = (0, 1, 3, 20)  # steps


def main() -> None:
    prepare_precision("float64")
    config = NetworkConfig()  # 21 x 21 cells of 0.1 m, 36 headings of 10 degrees
    levels = window_levels(config, jnp.float64)
    rest, nowhere = Odometry(*jnp.zeros((4, 1))[:, 0]), jnp.zeros(3)
    step = jax.jit(lambda cells: pose_cells.step(config, levels, cells, rest, nowhere, jnp.asarray(0.0)))

    cells, history = pose_cells.start(config, jnp.float64), []
    for _ in range(max(SHOWN) + 1):
        history.append(np.asarray(to_full_torus(levels, cells.activity)))  # [heading, y, x]
        cells, (spread, _, _) = step(cells)
    active = int((history[-1] > 0).sum())
    print(f"after {SHOWN[-1]} steps: {active} of {history[-1].size} active, sd {spread[0]:.2f} cells")

    line = "summed over headings (above) and over x, y (below), from one active cell"
    figure = new_figure(4.9, "One activity packet", line)
    for column, number in enumerate(SHOWN):
        left = 0.62 + 1.85 * column
        plane = add_axes(figure, left, 2.1, 1.6, 1.6)
        plane.imshow(history[number].sum(axis=0), origin="lower", cmap="Blues")
        plane.set_title(f"step {number}", fontsize=10)
        ring = add_axes(figure, left, 0.65, 1.6, 0.9)
        ring.bar(10 * np.arange(36), history[number].sum(axis=(1, 2)), width=9, color=BLUE)
        ring.set(ylim=(0, 1), xticks=(0, 180, 350), yticks=())
        name_axes(plane, "x (cells)", "y (cells)" if column == 0 else "")
        name_axes(ring, "heading (deg)", "activity" if column == 0 else "")
    figure.savefig("one_packet.png")


if __name__ == "__main__":
    main()
