"""Whisker images: three rings of six whiskers feel the walls around the head, as images of 3 x 6 pixels.

`python -m ratslam.examples.whisker_images` carries the head through a simulated maze and prints

    120 whisks of 18 whiskers, 33% of them in contact
"""

from itertools import islice

import numpy as np

import ratslam
from evaluation.plots.style import INK, add_axes, name_axes, new_figure
from ratslam.runs.build_session import open_observations, read_observations

WHISKS, SHOWN = 120, (0, 4, 8, 12, 16, 20)


def main() -> None:
    images = {}
    for transform in ("max_angle", "contact_angle"):
        config = ratslam.load_config("whisker_maze", [f"touch.image.transform={transform}"])
        with open_observations(config) as (_, source):
            seen = [observation for _, observation in islice(read_observations(source), WHISKS)]
        images[transform] = np.array([one.view[..., 0] for one in seen])  # [whisk, ring, column]
    touched = (images["contact_angle"] > 0).mean()
    print(f"{WHISKS} whisks of {images['contact_angle'][0].size} whiskers, {touched:.0%} of them in contact")

    line = "a pixel a whisker: the height of the wall that it touches, dark for tall; white: no contact"
    figure = new_figure(3.2, "Whisker images", line)
    for row, (transform, views) in enumerate(images.items()):
        for column, whisk in enumerate(SHOWN):
            axes = add_axes(figure, 0.9 + 1.15 * column, 1.35 - 0.8 * row, 1.05, 0.7)
            axes.imshow(views[whisk], cmap="Greys", vmin=0, vmax=1)
            axes.set(xticks=(), yticks=(), title=f"whisk {whisk + 1}" if row == 0 else "")
            axes.spines[:].set_visible(True)
            name_axes(axes, "", transform.replace("_", "\n") if column == 0 else "")
    note = "rows: rings from the shortest whiskers; columns: from ahead, anticlockwise"
    figure.text(0.08, 0.06, note, color=INK, fontsize=9)
    figure.savefig("whisker_images.png")


if __name__ == "__main__":
    main()
