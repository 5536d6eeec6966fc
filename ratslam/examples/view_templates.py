"""View templates: a view that resembles none of the stored ones is stored, and recognised when it comes back.

`python -m ratslam.examples.view_templates` walks a corridor twice and prints

    first walk: 33 templates stored; second walk: 0 stored, 100% of the views recognised at the right place
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d

from evaluation.plots.style import BLUE, GREY, add_axes, name_axes, new_figure
from ratslam.classic import view_templates
from ratslam.classic.view_templates import TemplateConfig
from ratslam.core.compilation import prepare_precision

LENGTH, STEP, PIXELS = 10.0, 0.1, 24  # m, m, columns of a view
CONFIG = TemplateConfig(threshold=0.06)


def main() -> None:
    prepare_precision("float64")
    random = np.random.default_rng(1)
    wall = 2 * gaussian_filter1d(random.random(400), 6)  # brightness every 4 cm
    where = np.tile(np.arange(0, LENGTH, STEP), 2)
    first = (where / 0.04).astype(int)
    views = np.array([wall[k : k + 6 * PIXELS : 6] for k in first])
    views += random.normal(0, 0.005, views.shape)

    shape = (1, PIXELS, 1)
    match = jax.jit(lambda store, view: view_templates.match_view(CONFIG, shape, store, view))
    learn = jax.jit(view_templates.learn)
    store = view_templates.start(CONFIG, shape, 64, np.dtype("float64"))
    template, stored_at = np.zeros(len(where), int), list[float]()
    for k, view in enumerate(jnp.asarray(views)):
        found = match(store, view.reshape(shape))
        template[k] = int(found.template)
        if template[k] < 0:
            template[k] = len(stored_at)
            stored_at.append(where[k])
            store, _ = learn(store, view, jnp.int32(-1), jnp.zeros(3), jnp.asarray(True))
    half = len(where) // 2
    count = int(template[:half].max()) + 1
    right = np.abs(np.array(stored_at)[template[half:]] - where[half:]) < 1.0
    print(
        f"first walk: {count} templates stored; second walk: {len(stored_at) - count} stored, "
        f"{right.mean():.0%} of the views recognised at the right place"
    )

    figure = new_figure(5.2, "View templates", "a corridor walked twice; views are rows of 24 grey values")
    above, below = add_axes(figure, 0.62, 2.9, 7.0, 1.4), add_axes(figure, 0.62, 0.6, 7.0, 1.9)
    above.imshow(views[:half].T, aspect="auto", cmap="gray", extent=(0, LENGTH, 0, PIXELS))
    name_axes(above, "", "pixel")
    below.plot(where[:half], template[:half], color=GREY, lw=6, label="first walk")
    below.plot(where[:half], template[half:], color=BLUE, lw=1.3, label="second walk")
    below.set_xlim(0, LENGTH)
    below.legend(frameon=False, fontsize=9)
    name_axes(below, "place (m)", "template")
    figure.savefig("view_templates.png")


if __name__ == "__main__":
    main()
