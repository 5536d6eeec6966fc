"""Places that look alike: a view that fits is no proof that the robot is there.

`python -m ratslam.examples.places_that_look_alike` drives two laps past two equal walls and prints

    classic: 5 m off the true path, recall 0.004 m, odometry 0.5 m
"""

import numpy as np
from scipy.ndimage import uniform_filter1d

import ratslam
from evaluation.metrics.trajectory import align
from evaluation.plots import style
from tactile.base.se2 import compose, integrate

STEP, LAP, LAPS, PIXELS = 0.15, 200, 2, 12  # m per step, steps per lap, laps, pixels of a view
SETTINGS = ["recording=null", "session.reserve=512", "pose_cells.cell_size=0.2", "templates.threshold=0.06"]


def main() -> None:
    random = np.random.default_rng(3)
    wall = 3 * (uniform_filter1d(random.random((LAP, PIXELS)), 6, axis=0, mode="wrap") - 0.5) + 0.5
    wall[120:160] = wall[30:70]  # looks like another stretch
    place = np.arange(LAP * LAPS) % LAP
    views = np.clip(wall[place] + random.normal(0, 0.02, (LAP * LAPS, PIXELS)), 0, 1)
    turn = 2 * np.pi / LAP * (1 + 1.2 * np.cos(6 * np.pi * place / LAP))
    motion = np.column_stack([np.full(len(place), STEP), np.zeros(len(place)), turn])
    paths = {"truth": integrate(motion), "odometry": integrate(motion + [0, 0, 0.0009])}
    for method in ("classic", "recall"):
        config = ratslam.load_config("square", [f"backend={method}", *SETTINGS], source_required=False)
        slam = ratslam.Slam(config, info=ratslam.SourceDescription(view_shape=(1, PIXELS, 1), rate_hz=2.0))
        for (dx, dy, dtheta), view in zip(motion + [0, 0, 0.0009], views, strict=True):
            odometry = ratslam.Odometry(dx=dx, dy=dy, dtheta=dtheta, dt=0.5)
            slam.step(ratslam.observation(odometry, view.reshape(1, PIXELS, 1)))
        paths[method] = slam.trajectory()
    aligned = {name: compose(align(path, paths["truth"]), path) for name, path in paths.items()}
    off = {
        name: np.sqrt(np.mean(np.sum((path - paths["truth"])[:, :2] ** 2, axis=1)))
        for name, path in aligned.items()
    }
    line = "classic: {classic:.1g} m off the true path, recall {recall:.1g} m, odometry {odometry:.1g} m"
    print(line.format(**off))

    line = "two laps; the yellow stretches have the same views"
    figure = style.new_figure(5.2, "Places that look alike", line)
    for column, (method, color) in enumerate((("classic", style.VERMILLION), ("recall", style.BLUE))):
        axes = style.add_axes(figure, 0.62 + 3.7 * column, 1.0, 3.2, 3.3)
        for stretch in (slice(30, 70), slice(120, 160)):
            axes.plot(*aligned["truth"][stretch, :2].T, color=style.YELLOW, lw=7)
        axes.plot(*aligned["truth"][:, :2].T, color=style.INK, lw=0.8, label="truth")
        axes.plot(*aligned["odometry"][:, :2].T, color=style.GREY, lw=1, ls="--", label="odometry")
        axes.plot(*aligned[method][:, :2].T, color=color, lw=1.2, label=method)
        axes.set_aspect("equal")
        style.metre_grid(axes)
    style.add_legend(figure, axes)
    figure.savefig("places_that_look_alike.png")


if __name__ == "__main__":
    main()
