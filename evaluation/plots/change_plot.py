"""Plot of the places at which a localised session does not agree with its map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.artifacts.change_table import ChangeRow
from evaluation.metrics.run_arrays import RunArrays, truth_rows
from evaluation.metrics.trajectory import align
from evaluation.plots import style
from evaluation.plots.map_plot import IN_PLACE, NO_WALLS, bounds, draw_walls, wall_corners
from evaluation.plots.style import BLUE, GREEN, GREY, PURPLE, VERMILLION

_MARGIN = 0.06  # m around all
_KINDS = {
    "new": (VERMILLION, "something new"),
    "gone": (GREEN, "something gone"),
    "different": (PURPLE, "different"),
}


def draw_changes(
    name: str, run: RunArrays, changes: Sequence[ChangeRow], walls: np.ndarray = NO_WALLS
) -> style.Figure:
    """Draws the path of a session in its map, and the changes.

    Args:
        name: of the run. run: its poses in the frame of the map; drawn where they were found. changes: the
            surest first. walls: [B, 5] west, south, east, north, height, m, as the session found them; drawn
            with truth, in whose frame they are.
    """
    rows = truth_rows(run)[run.found[truth_rows(run)]]
    known = run.truth is not None and len(rows) > 0
    to_map = align(run.truth[rows], run.final[rows]) if known and run.truth is not None else IN_PLACE
    path = np.where(run.found[:, None], run.final[:, :2], np.nan)
    ground = run.nodes[run.node_piece == run.main]
    places = np.array([[change.x, change.y] for change in changes]).reshape(-1, 2)
    shown = walls if known else NO_WALLS
    seen = path if run.found.any() or len(ground) else np.zeros((1, 2))
    low, high = bounds(seen, ground[:, :2], places, wall_corners(shown, to_map))
    box = np.stack([low - _MARGIN, high + _MARGIN])
    figure, axes = style.map_figure(box, name, _headline(run, changes), style.MAP)
    if len(shown):
        draw_walls(axes, shown, to_map)
    if len(ground):
        axes.plot(*ground[:, :2].T, ".", color=GREY, ms=4, mew=0, zorder=2, label="experience of the map")
    name = "path where found" if run.found.any() else "_"
    axes.plot(*path.T, color=BLUE, lw=0.8, alpha=0.6, zorder=3, label=name)
    _mark(axes, changes, places, np.ptp(box, axis=0).max())
    style.add_legend(figure, axes)
    return figure


def _mark(axes: style.Axes, changes: Sequence[ChangeRow], places: np.ndarray, size: float) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Circle

    labelled = set()
    for number, (change, place) in enumerate(zip(changes, places, strict=True), start=1):
        color, what = _KINDS[change.kind]
        label = None if what in labelled else what
        labelled.add(what)
        radius = max(change.extent / 2, 0.02 * size)
        ring = {"facecolor": (*to_rgb(color), 0.18), "edgecolor": color, "lw": 2.0, "zorder": 6}
        axes.add_patch(Circle((place[0], place[1]), radius, label=label, **ring))
        at = (place[0] + 1.1 * radius, place[1] + 1.1 * radius)
        axes.text(*at, str(number), color=color, fontsize=11, fontweight="bold", zorder=7)


def _headline(run: RunArrays, changes: Sequence[ChangeRow]) -> str:
    if not changes:
        known = run.found.sum()
        where = f"in the {known:,} of {len(run.time):,} steps that were found"
        return (
            f"the session agrees with the map {where}" if known else "not found in the map: nothing compared"
        )
    places = "place has" if len(changes) == 1 else "places have"
    surest = changes[0]
    return f"{len(changes)} {places} changed  ·  surest: {surest.evidence:.0f} nat in {surest.passes} passes"
