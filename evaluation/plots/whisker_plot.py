"""Plot of the whisker images of a session: all as columns over time, and some at their poses."""

from __future__ import annotations

import numpy as np

from evaluation.artifacts.run_reader import WhiskerViews
from evaluation.metrics.exm import base_end
from evaluation.metrics.run_metrics import RunArrays, bounds
from evaluation.metrics.scorecard import Scorecard
from evaluation.plots import style
from evaluation.plots.map_plot import NO_WALLS, draw_walls, split_at_jumps, wall_corners
from evaluation.plots.style import GREY, INK, LABEL_GREY, LINE_GREY
from tactile.base.errors import InputError

MAX_HEADS = 12
"""Largest number of images drawn at their poses."""
STRIP_COLUMNS = 540
"""Whisks in one strip, two pixels each."""
MAX_STRIPS = 3
"""Largest number of strips; of a longer session every n-th whisk is shown."""

_NOTHING, _DEAD = "#f3f3f3", "#8f8f8f"
_ROW, _GAP, _MARKS, _BOTTOM, _KEY = 0.062, 0.5, 0.22, 0.62, 1.25  # inches
_FLATTEST, _TALLEST = 0.35, 1.3
_REACH = 0.078  # radius of a drawn head, m; fits between the walls of a maze cell
_LARGEST, _LEAST = 0.08, 0.045  # limits of the radius as shares of the scene
_HOLE = 0.28  # share of the radius without whiskers


def draw_whiskers(
    run: RunArrays, card: Scorecard, images: WhiskerViews, walls: np.ndarray = NO_WALLS
) -> style.Figure:
    """Draws whiskers over time, coloured by obstacle height, and some images at their poses.

    Args:
        card: for the title. images: one for each step of the run.
        walls: [B, 5] west, south, east, north, height, m, in the frame of the truth; needs truth.

    Raises:
        InputError: the numbers of images and steps differ.
    """
    from matplotlib.colors import to_rgb

    if len(images.view) != len(run.time):
        raise InputError("views.npz", f"{len(images.view)} images", f"{len(run.time)}, one for each step")
    rows = run.truth_rows
    pose = run.final if len(rows) == 0 or run.truth is None else run.truth
    steps = np.arange(len(pose)) if len(rows) == 0 else rows
    shown = walls if len(rows) else NO_WALLS
    # The corners of the scene and the radius of a drawn head, m.
    low, upper = bounds(pose[steps, :2], wall_corners(shown))
    extent = max((upper - low).max(), 1e-3)
    reach = float(np.clip(_REACH, _LEAST * extent, _LARGEST * extent))
    middle, size = (low + upper) / 2, upper - low + (0.02 * extent if len(shown) else 2.6 * reach)
    size = np.maximum(size, size[::-1] * [1 / _TALLEST, _FLATTEST])
    box = np.stack([middle - size / 2, middle + size / 2])
    try:
        loop = steps[: max(1, base_end(pose[steps]))]  # the first loop
    except InputError:
        loop = steps
    chosen = _spread(pose, loop, 2.4 * reach)

    parts = np.array_split(np.arange(len(run.time)), min(MAX_STRIPS, -(-len(run.time) // STRIP_COLUMNS)))
    high = (style.INNER - _KEY) * (box[1, 1] - box[0, 1]) / (box[1, 0] - box[0, 0])
    tall = images.view[0].size * _ROW
    total = style.TOP + _MARKS + len(parts) * (tall + _GAP) + 0.25 + high + _BOTTOM
    rings = ", ".join(f"{1000 * length:.0f}" for length in images.length)
    touched = (images.view > 0).sum() / max(1, images.alive.sum())
    heads = f"rings of {images.view.shape[2]} whiskers, {rings} mm long"
    line = f"{len(images.view)} whisks  ·  {heads}  ·  {touched:.0%} of whiskers in contact"
    figure = style.new_figure(total, card.name, line)

    pixels, bottom = _colors(images.view), total - style.TOP - _MARKS + _GAP
    pixels[images.view == 0] = to_rgb(_NOTHING)
    pixels[~images.alive] = to_rgb(_DEAD)
    for part in parts:
        bottom -= tall + _GAP
        axes = style.add_axes(figure, style.LEFT, bottom, style.INNER, tall)
        _paint_strip(axes, run.time, pixels, part, chosen)
        rows_of_ring = images.view.shape[2] * (np.arange(len(images.length)) + 0.5)
        axes.set_yticks(rows_of_ring, [f"{1000 * length:.0f} mm" for length in images.length])
    style.name_axes(axes, "time (s); rows: whiskers of each ring, anticlockwise from ahead", "")

    axes = style.add_axes(figure, style.LEFT, _BOTTOM, style.INNER - _KEY, high)
    axes.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal")
    style.metre_grid(axes, style.TRUTH if len(rows) else style.MAP)
    if len(shown):
        draw_walls(axes, shown)
    axes.plot(*split_at_jumps(pose[steps, :2], pose[steps, :2]).T, color=LINE_GREY, lw=0.8, zorder=0.8)
    for number, step in enumerate(chosen, start=1):
        _paint_head(axes, pose[step], reach, pixels[step], images.azimuth)
        x, y, _ = pose[step]
        axes.text(x, y, str(number), ha="center", va="center", fontsize=7, color=INK, zorder=5)
    _paint_key(figure, images, style.LEFT + style.INNER - _KEY, high)
    return figure


def _spread(pose: np.ndarray, steps: np.ndarray, apart: float) -> np.ndarray:
    """Up to `MAX_HEADS` of the steps, in order, at least `apart` m from each other.

    Starting with the first, each next one is the farthest from those chosen before.
    """
    chosen = [0]
    place = pose[steps, :2]
    away = np.hypot(*(place - place[0]).T)
    while len(chosen) < MAX_HEADS and away.max() >= apart:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.hypot(*(place - place[chosen[-1]]).T))
    return np.sort(steps[chosen])


def _colors(share: np.ndarray) -> np.ndarray:
    """The colours [..., 3] of heights, given as shares [...] of the tallest."""
    import matplotlib

    return matplotlib.colormaps["viridis_r"](share)[..., :3]


def _paint_strip(
    axes: style.Axes, time: np.ndarray, pixels: np.ndarray, part: np.ndarray, chosen: np.ndarray
) -> None:
    """Draws the images of the steps `part` as columns, and marks the chosen steps."""
    rings, columns = pixels.shape[1:3]
    some = part[:: -(-len(part) // STRIP_COLUMNS)]
    whisk = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    start, end = float(time[part[0]]) - whisk / 2, float(time[part[-1]]) + whisk / 2
    strip, extent = pixels[some].reshape(len(some), -1, 3).swapaxes(0, 1), (start, end, rings * columns, 0)
    axes.imshow(strip, extent=extent, aspect="auto", interpolation="nearest", zorder=1)
    axes.hlines(columns * np.arange(1, rings), start, end, color="white", lw=1.2, zorder=2)
    axes.set(xlim=(start, end), ylim=(rings * columns, 0))
    axes.tick_params(pad=2)
    for number, step in enumerate(chosen, start=1):
        if part[0] <= step <= part[-1]:
            axes.plot(time[step], -0.5, "v", ms=3, color=INK, clip_on=False, zorder=3)
            axes.annotate(
                str(number), (time[step], -0.5), (0, 3), textcoords="offset points",
                ha="center", fontsize=7, color=INK, annotation_clip=False,
            )  # fmt: skip


def _paint_head(
    axes: style.Axes, pose: np.ndarray, reach: float, pixels: np.ndarray, azimuth: np.ndarray
) -> None:
    """Draws an image as rings around the head, the shortest whiskers inside; the arrow points ahead."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle, Polygon, Wedge

    rings, columns = pixels.shape[:2]
    hole, half = _HOLE * reach, 180 / columns
    thick = (reach - hole) / rings
    centre, middle = (float(pose[0]), float(pose[1])), np.degrees(pose[2] + azimuth)
    wedges = [
        Wedge(centre, hole + (ring + 1) * thick, middle[column] - half, middle[column] + half, width=thick)
        for ring, column in np.ndindex(rings, columns)
    ]
    face = pixels.reshape(-1, 3)
    axes.add_patch(Circle(centre, reach, facecolor="white", edgecolor=GREY, lw=0.7, zorder=2.9))
    axes.add_collection(PatchCollection(wedges, facecolors=face, edgecolors="white", lw=0.6, zorder=3))
    ahead = np.array([np.cos(pose[2]), np.sin(pose[2])])
    beside = np.array([-ahead[1], ahead[0]])
    tip = np.stack([1.24 * ahead, 1.05 * ahead + 0.11 * beside, 1.05 * ahead - 0.11 * beside])
    axes.add_patch(Polygon(pose[:2] + reach * tip, facecolor=INK, edgecolor="none", zorder=4))


def _paint_key(figure: style.Figure, images: WhiskerViews, left: float, high: float) -> None:
    """Draws the key: rings of a head and the colour scale."""
    from matplotlib.patches import Patch

    rings, columns = images.view.shape[1:]
    top, size = _BOTTOM + high, _KEY - 0.2
    axes = style.add_axes(figure, left + 0.2, top - size, size, size)
    axes.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), aspect="equal", xticks=[], yticks=[])
    shades = np.repeat(np.linspace(0.95, 0.8, rings), columns)
    pixels = np.repeat(shades[:, None], 3, axis=1).reshape(rings, columns, 3)
    _paint_head(axes, np.array([0.0, 0.0, np.pi / 2]), 1.0, pixels, images.azimuth)
    axes.text(0.16, 1.14, "ahead", fontsize=7.5, color=LABEL_GREY, va="center")
    for ring, length in enumerate(images.length):
        out = _HOLE + (ring + 0.5) * (1 - _HOLE) / rings
        axes.text(0, -out, f"{1000 * length:.0f}", size=6.5, color=INK, ha="center", va="center", zorder=5)

    tall = max(0.5, min(1.6, high - size - 1.0))
    box = left + 0.35, top - size - 0.35 - tall, 0.16, tall
    ramp = _colors(np.linspace(0, 1, 256))[:, None]
    style.add_scale(figure, box, ramp, 1000 * images.tallest, "height (mm)", 8)
    across, up = figure.get_size_inches()
    handles = [Patch(facecolor=_NOTHING, edgecolor=LABEL_GREY, lw=0.4, label="no contact")]
    if not images.alive.all():
        handles.append(Patch(facecolor=_DEAD, label="no signal"))
    figure.legend(
        handles=handles, loc="upper left", frameon=False, fontsize=8, labelcolor=LABEL_GREY, borderpad=0,
        borderaxespad=0, handlelength=1.0, handletextpad=0.5,
        bbox_to_anchor=((left + 0.33) / across, (top - size - 0.5 - tall) / up),
    )  # fmt: skip
