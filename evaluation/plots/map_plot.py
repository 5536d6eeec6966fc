"""Plots in the frame of a map: the map of a run with truth, odometry and walls; the places at which a
localised session does not agree with its map; the sessions of a merged map; a way over its experiences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from evaluation.artifacts.run_reader import ChangeRow
from evaluation.metrics.run_metrics import IN_PLACE, Layers, RunArrays, arrange_pieces, bounds
from evaluation.metrics.scorecard import Scorecard
from evaluation.metrics.trajectory import align
from evaluation.plots import style
from evaluation.plots.style import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, SKY, VERMILLION, YELLOW
from tactile.base.se2 import compose

_ROOM = 0.2  # share of the map's size for drifting odometry
_JUMP = 5.0  # a step longer than this multiple of the usual one: the robot was moved by hand
_PALE, _DARK = 0.86, 0.62  # greys of a wall of height 0 and of the tallest wall
NAMED = 5
"""Number of pieces of a map with a colour of their own."""
PIECES = (BLUE, ORANGE, GREEN, PURPLE, SKY, INK)
"""Colours of the largest pieces, and of all others."""
NO_WALLS = np.zeros((0, 5))
NO_CLOSURES = np.zeros((0, 2), int)


def draw_map(
    run: RunArrays, card: Scorecard, walls: np.ndarray = NO_WALLS, closures: np.ndarray = NO_CLOSURES
) -> style.Figure:
    """Draws the map over truth and odometry with equal axes.

    All is in the frame of the map, in which commands take places: truth and walls are aligned to the map, and
    odometry to the truth, as for ATE; without truth, odometry starts at the first pose of the map. Of a map
    of several pieces it is the frame of `run.main`. The plot shows all of truth, walls and map, and odometry
    near them. In a maze laps overlap, so the trajectory and the loop closures are drawn instead of
    experiences and links.

    Args:
        run: the run. card: its scorecard, for the subtitle.
        walls: [B, 5] west, south, east, north, height, m, in the frame of the truth; needs truth.
        closures: [n, 2] steps joined by loop closures; drawn with walls.
    """
    known, localised = run.found.sum(), len(run.state) > 0
    of = f"piece {run.main + 1}, the largest" if run.has_pieces and not localised else style.MAP
    line = map_headline(card, f"found in {known:,} of {len(run.time):,} steps" if localised else "")
    run = arrange_pieces(run)
    layers = Layers.align(run)
    shown = walls if layers.truth is not None else NO_WALLS
    truth, corners = layers.truth, wall_corners(shown, layers.to_map)
    box = layers.box(0.0 if len(shown) else _ROOM, corners)
    figure, axes = style.map_figure(style.frame(box), card.name, line, of)
    if len(shown):
        draw_walls(axes, shown, layers.to_map)
        _paint_laps(axes, run, layers, card.exm.position, closures)
    else:
        _paint(axes, run, layers)
    start = layers.final if truth is None else truth[np.isfinite(truth).all(axis=1)]
    axes.plot(*start[0], "o", ms=9, mfc="none", mec=GREEN, mew=1.8, zorder=6, label="start")
    return style.add_legend(figure, axes)


def map_headline(card: Scorecard, found: str = "") -> str:
    """The main quantities in one line, of a localised session what was `found` first."""
    within = card.quantities.get("ate_within_pieces")
    ate, online = card.quantities["ate_final"], card.quantities["ate_online"]
    count = card.quantities["experiences"].value
    parts = [found] * bool(found) + [f"{count} experiences{' of the map' * bool(found)}"] * bool(count)
    if "pieces" in card.quantities and not found:
        count, share = (card.quantities[name].value for name in ("pieces", "unjoined_share"))
        parts.append(f"{count} pieces, {share:.0%} of the steps unjoined")
    if within is not None and within.value is not None:
        parts.append(f"ATE within pieces {within.value:.3g} m")
    elif ate.value is None:
        parts.append("no ground truth")
    else:
        raw = f"{ate.odometry:.3g} m odometry"
        parts.append(f"ATE (RMS) {ate.value:.3g} m final, {online.value:.3g} m online, {raw}")
    arr, arcr = card.quantities["exm_arr"].value, card.quantities["exm_arcr_strict"].value
    parts += [] if arr is None else [f"ARR {arr:.2f}"]
    parts += [] if arcr is None else [f"ARCR {arcr:.2f}"]
    return "  ·  ".join(parts)


def draw_walls(axes: style.Axes, walls: np.ndarray, to_map: np.ndarray = IN_PLACE) -> None:
    """Draws walls [B, 5], moved by `to_map` [3], in grey, tall ones darker."""
    from matplotlib.collections import PolyCollection

    height = walls[:, 4]
    shade = _PALE + (_DARK - _PALE) * height / height.max()
    greys = np.repeat(shade[:, None], 3, axis=1)
    boxes = list(wall_corners(walls, to_map))
    axes.add_collection(PolyCollection(boxes, facecolors=greys, linewidths=0, zorder=0.6))


def wall_corners(walls: np.ndarray, to_map: np.ndarray = IN_PLACE) -> np.ndarray:
    """The four corners [B, 4, 2] of each wall [B, 5], moved by `to_map` [3]."""
    corners = walls[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2)
    return compose(to_map, np.concatenate([corners, np.zeros((*corners.shape[:2], 1))], axis=-1))[..., :2]


def _paint(axes: style.Axes, run: RunArrays, layers: Layers) -> None:
    """Draws the layers in the order of the legend; `zorder` sets which layer is in front."""
    crowd = min(1.0, np.sqrt(150 / max(1, len(layers.nodes))))  # thinner strokes for many experiences
    truth, odometry, final, nodes, _ = layers
    if truth is not None:
        axes.plot(*truth.T, color=INK, lw=0.8, zorder=5, label="truth")
    axes.plot(*odometry.T, color=GREY, lw=0.9, ls=(0, (5, 3)), zorder=1, label="odometry")
    _paint_path(axes, run, final, lw=0.8, alpha=0.4, zorder=2)
    if len(nodes):
        dot = {"s": 26 * crowd**2, "color": BLUE, "edgecolors": "white", "linewidths": 0.6 * (crowd == 1)}
        axes.scatter(*nodes.T, zorder=4, label=f"experience{' of the map' * bool(len(run.state))}", **dot)
    older, lw = _older(run.links), 1.6 * crowd
    for links, color, label in (
        (run.links[~older], BLUE, "link"),
        (run.links[older], VERMILLION, "link to an older experience"),
    ):
        if len(links):
            style.add_lines(axes, nodes[links], color, lw=lw, zorder=3, label=label)


def _paint_laps(axes: style.Axes, run: RunArrays, layers: Layers, apart: float, pairs: np.ndarray) -> None:
    """Draws a run in a maze; a closure is wrong if its places are more than `apart` m apart in truth."""
    truth, odometry, final, nodes, _ = layers
    assert truth is not None
    line = split_at_jumps(truth, truth)
    axes.plot(*line.T, color=YELLOW, lw=5, solid_capstyle="butt", zorder=0.8, label="truth")
    _paint_path(axes, run, final, truth, lw=0.7, zorder=3)
    axes.plot(*odometry.T, color=GREY, lw=0.7, alpha=0.7, zorder=1, label="odometry")
    own = (run.created[run.links] >= 0).all(axis=1)
    if not own.all():
        name = "map" if len(run.state) else "map before"
        style.add_lines(axes, nodes[run.links[~own]], INK, lw=2.2, alpha=0.35, zorder=1.5, label=name)
    joined, place = (pairs, final) if len(pairs) else (run.links[own & _older(run.links)], nodes)
    steps = joined if len(pairs) else run.created[joined]
    with np.errstate(invalid="ignore"):
        wrong = np.hypot(*(truth[steps[:, 0]] - truth[steps[:, 1]]).T) > apart
    for some, color, over, name in (
        (~wrong, PURPLE, 5, "loop closure"),
        (wrong, VERMILLION, 2, f"false loop closure (over {apart:g} m)"),
    ):
        if some.any():
            style.add_lines(axes, place[joined[some]], color, lw=0.7, zorder=over, label=name)


def _paint_path(
    axes: style.Axes, run: RunArrays, path: np.ndarray, truth: np.ndarray | None = None, **line: Any
) -> None:
    """Draws the mapped path [N, 2], each piece of the map in a colour of its own, `run.main` in blue."""
    pieces = path_pieces(run, path, truth)
    for rank, name, points in pieces:
        if rank >= NAMED:
            name = "_" if rank > NAMED else f"{len(pieces) - NAMED} smaller pieces"
        axes.plot(*points.T, color=PIECES[min(rank, NAMED)], label=name or "mapped path", **line)


def path_pieces(
    run: RunArrays, path: np.ndarray, truth: np.ndarray | None
) -> list[tuple[int, str, np.ndarray]]:
    """Rank, name and line of each piece of a path [N, 2], `run.main` first with rank 0, interrupted where the
    robot was moved by hand (by the truth); a path in one piece has no name."""
    truth = path if len(run.state) else truth  # a pose that is searched for jumps as well

    def drawn(rows: np.ndarray | slice) -> np.ndarray:
        return path[rows] if truth is None else split_at_jumps(path[rows], truth[rows])

    if not run.has_pieces and not len(run.state):
        return [(0, "", drawn(slice(None)))]
    pieces = run.ranked_pieces()
    return [(rank, run.name_piece(one), drawn(np.flatnonzero(run.piece == one))) for rank, one in pieces]


def _older(links: np.ndarray) -> np.ndarray:
    """Which links join experiences that were not created in succession."""
    return np.abs(links[:, 0] - links[:, 1]) > 1


def split_at_jumps(line: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The line [N, 2], interrupted where the robot was moved by hand (by the truth)."""
    step = np.hypot(*np.diff(truth, axis=0).T)
    moving = step[np.isfinite(step) & (step > 0)]
    if len(moving) == 0:
        return line
    usual = np.quantile(moving, 0.9, method="lower")
    return np.insert(line, 1 + np.flatnonzero(step > _JUMP * usual), np.nan, axis=0)


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
    rows = run.truth_rows[run.found[run.truth_rows]]
    known = run.truth is not None and len(rows) > 0
    to_map = align(run.truth[rows], run.final[rows]) if known and run.truth is not None else IN_PLACE
    path = np.where(run.found[:, None], run.final[:, :2], np.nan)
    ground = run.nodes[run.node_piece == run.main]
    places = np.array([[change.x, change.y] for change in changes]).reshape(-1, 2)
    shown = walls if known else NO_WALLS
    seen = path if run.found.any() or len(ground) else np.zeros((1, 2))
    low, high = bounds(seen, ground[:, :2], places, wall_corners(shown, to_map))
    box = np.stack([low - _MARGIN, high + _MARGIN])
    line, found = "not found in the map: nothing compared", run.found.sum()
    if changes:
        verb, surest = "place has" if len(changes) == 1 else "places have", changes[0]
        sure = f"surest: {surest.evidence:.0f} nat in {surest.passes} passes"
        line = f"{len(changes)} {verb} changed  ·  {sure}"
    elif found:
        steps = f"{found:,} of {len(run.time):,} steps"
        line = f"the session agrees with the map in the {steps} that were found"
    figure, axes = style.map_figure(box, name, line, style.MAP)
    if len(shown):
        draw_walls(axes, shown, to_map)
    if len(ground):
        axes.plot(*ground[:, :2].T, ".", color=GREY, ms=4, mew=0, zorder=2, label="experience of the map")
    name = "path where found" if run.found.any() else "_"
    axes.plot(*path.T, color=BLUE, lw=0.8, alpha=0.6, zorder=3, label=name)
    _mark(axes, changes, places, np.ptp(box, axis=0).max())
    return style.add_legend(figure, axes)


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


def draw_sessions(title: str, path: np.ndarray, piece: np.ndarray, steps: Sequence[int]) -> style.Figure:
    """Draws the paths of the sessions of a merged map, each in a colour of its own; pieces that nothing joins
    beside each other.

    Args:
        path: [T, 3] poses of all steps in the map, m, m, rad. piece: [T] the piece of each. steps: number of
            steps of each session, in the order of `path`.
    """
    # The pieces where pictures show them: beside each other.
    count = len(path)
    run = RunArrays(
        time=np.arange(float(count)), truth=None, online=path, final=path, odometry=path,
        experience=np.full(count, -1), created=np.zeros(0, int), nodes=np.zeros((0, 3)),
        links=np.zeros((0, 2), int), piece=piece,
    )  # fmt: skip
    shown = arrange_pieces(run).final[:, :2]
    pieces, largest = len(np.unique(piece)), int(np.bincount(piece).argmax())
    joined = "joined" if pieces == 1 else f"{pieces} pieces"
    line = f"{len(steps)} sessions, {len(path)} steps  ·  {joined}"
    of = style.MAP if pieces == 1 else f"piece {largest + 1}, the largest"
    figure, axes = style.map_figure(style.frame(shown), title, line, of)
    ends = np.cumsum(steps).tolist()
    for number, (count, end) in enumerate(zip(steps, ends, strict=True)):
        own = slice(end - count, end)
        parted = np.flatnonzero(np.diff(piece[own])) + 1  # no line from one piece to the next
        drawn, colour = np.insert(shown[own], parted, np.nan, axis=0), PIECES[min(number, NAMED)]
        label = f"map {number + 1}, {count} steps"
        axes.plot(*drawn.T, color=colour, lw=0.9, alpha=0.8, zorder=3, label=label)
        label = "start" if number == 0 else "_"
        axes.plot(*shown[end - count], "o", ms=8, mfc="none", mec=GREEN, mew=1.6, zorder=4, label=label)
    return style.add_legend(figure, axes)


def draw_way(
    title: str, line: str, nodes: np.ndarray, links: np.ndarray, way: np.ndarray, felt: np.ndarray
) -> style.Figure:
    """Draws experiences, their links, contacts felt beside them and the way.

    Args:
        line: subtitle. nodes: [N, 2] experiences, m. links: [L, 2] their indices. way: [K, 3] poses of the
            way, K >= 1 (m, m, rad). felt: [n, 2] contacts in the map, m; may be empty.
    """
    box = style.frame(np.concatenate([nodes, felt, way[:, :2]]))
    figure, axes = style.map_figure(box, title, line, style.MAP)
    if len(felt):
        axes.plot(*felt.T, ".", color=GREY, ms=2.2, mew=0, zorder=1, label="contact felt")
    if len(links):
        style.add_lines(axes, nodes[links], BLUE, lw=0.7, alpha=0.55, zorder=2, label="link")
    axes.plot(*nodes.T, "o", color=BLUE, ms=2.4, mew=0, zorder=3, label="experience")
    axes.plot(*way[:, :2].T, color=VERMILLION, lw=3.2, solid_capstyle="round", zorder=4, label="way")
    axes.plot(*way[0, :2], "o", ms=9, mfc="white", mec=GREEN, mew=2.2, ls="none", zorder=5, label="start")
    axes.plot(*way[-1, :2], "*", ms=15, color=INK, mec="white", mew=0.8, ls="none", zorder=5, label="goal")
    return style.add_legend(figure, axes, columns=6)
