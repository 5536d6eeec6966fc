"""Two packets: a recognised place injects energy far from the packet, and the stronger packet wins.

`python -m ratslam.examples.two_packets` injects at each step, at 10 cells from the packet, and prints

    0.005 a step is forgotten, 0.05 a step takes over after 7 steps
"""

import jax
import jax.numpy as jnp
import numpy as np

from evaluation.plots.style import BLUE, GREY, VERMILLION, add_axes, name_axes, new_figure
from ratslam.classic import pose_cells
from ratslam.classic.config import NetworkConfig
from ratslam.classic.levels import to_full_torus, window_levels
from ratslam.core.compilation import prepare_precision
from tactile.base.types import Odometry

WEAK, STRONG, STEPS = 0.005, 0.05, 25
PACKET, PLACE = (10.0, 10.0, 18.0), (18.0, 4.0, 18.0)  # x, y, heading, cells


def main() -> None:
    prepare_precision("float64")
    config = NetworkConfig()
    levels = window_levels(config, jnp.float64)
    rest, place = Odometry(*jnp.zeros((4, 1))[:, 0]), jnp.asarray(PLACE)
    step = jax.jit(lambda cells, energy: pose_cells.step(config, levels, cells, rest, place, energy))

    x, images = {}, []
    for energy in (WEAK, STRONG):
        cells, decoded = pose_cells.start(config, jnp.float64), []
        for number in range(STEPS):
            cells, _ = step(cells, jnp.asarray(energy))
            decoded.append(float(cells.pose[0]))
            if energy == STRONG and number in (0, 5, 12):
                images.append((number, np.asarray(to_full_torus(levels, cells.activity)).sum(axis=0)))
        x[energy] = np.array(decoded)
    taken = int(np.argmax(x[STRONG] > (PACKET[0] + PLACE[0]) / 2)) + 1
    forgotten = "forgotten" if abs(x[WEAK][-1] - PACKET[0]) < 1 else "not forgotten"
    print(f"{WEAK} a step is {forgotten}, {STRONG} a step takes over after {taken} steps")

    line = "energy is injected at x = 18, y = 4; the network keeps one packet"
    figure = new_figure(4.9, "Two packets", line)
    for column, (number, activity) in enumerate(images):
        axes = add_axes(figure, 0.62 + 2.5 * column, 2.1, 1.9, 1.7)
        axes.imshow(activity, origin="lower", cmap="Blues")
        axes.set_title(f"step {number + 1}", fontsize=10)
        name_axes(axes, "x (cells)", "y (cells)" if column == 0 else "")
    trace = add_axes(figure, 0.62, 0.6, 6.9, 1.0)
    for (energy, packet), color in zip(x.items(), (GREY, VERMILLION), strict=True):
        trace.plot(1 + np.arange(STEPS), packet, color=color, label=f"{energy} a step")
    trace.axhline(PLACE[0], color=BLUE, lw=0.7, ls=":")
    trace.legend(frameon=False, fontsize=8.5)
    name_axes(trace, "step", "decoded x (cells)")
    figure.savefig("two_packets.png")


if __name__ == "__main__":
    main()
