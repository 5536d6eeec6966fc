"""The figure of the sheets: grid cells that read the belief of `backend: recall` on a twisted torus.

The map is made by the belief and not by the sheet (`ratslam.network.grid_cells`), so that a twisted and a
square sheet read the same sessions. Odometry has errors, views anchor the belief; beside it exact odometry
without views, which is path integration alone. Cells are drawn by the seed, none is selected.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from evaluation.cells.grid_score import autocorrelogram
from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import ShuffledScores
from evaluation.cells.topology import Holes, find_holes, shuffled_holes
from evaluation.papers.cells.panels import name_panel, panel_row
from evaluation.papers.cells.rat_sessions import RatSessions
from evaluation.papers.cells.torus import measure_cells
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from evaluation.plots import style
from ratslam.network.config import SheetConfig
from ratslam.network.grid_cells import sheet_activity, sheet_waves
from ratslam.network.pose_cells import ViewCells
from ratslam.runs.build_session import open_observations
from ratslam.runs.settings.run_config import load_config
from tactile.base.se2 import between, wrap

CELLS, SHUFFLES, SESSIONS, SECONDS = 64, 20, 5, 599.0
HOLE_SHUFFLES = 20
TURN = 0.3
"""Largest rotation of a map against the true frame of its first pose, rad."""
CELLS_ACROSS = 10
"""Pose cells along the shorter side of the box."""
SPACINGS = 3.0
"""Shorter side of the box over the distance between fields."""
BINS = 12
"""Bins of a map for each spacing; maps are smoothed by 1.5 of them."""
GOAL, LARGEST_ERROR = 0.8, 0.25
"""Median grid score; error of what the cells say, spacings."""


BOXES = {"sargolini": (1.0, 1.0), "tanni": (3.5, 2.5)}
"""Of the packaged paths of rats, m."""
DARK = ["rat_simulation.phases=[{start: 0, dark: true}]"]
DARK += ["rat_simulation.odometry={speed_white: 0, heading_white: 0}"]
TWISTED = "twisted sheet"
WAYS: Mapping[str, tuple[bool, list[str]]] = {
    TWISTED: (True, []),
    "square sheet (control)": (False, []),
    "twisted sheet, exact odometry without views": (True, DARK),
}
COLOURS = dict(zip(WAYS, (style.BLUE, style.VERMILLION, style.GREEN), strict=True))


class _Sheets(NamedTuple):
    """Grid cells of n sessions of one path and one sheet, C of each.

    Attributes:
        hexagonal, square: lattice scores [n * C] and their shuffles. error: [n] root mean square of
            `sheet_errors`, spacings. maps: [C, H, W] of the first session. holes: its own, then of
            shuffles; of the twisted sheet alone, and not without ripser.
    """

    hexagonal: ShuffledScores
    square: ShuffledScores
    error: np.ndarray
    maps: np.ndarray
    holes: list[Holes]


_Result = Mapping[str, Mapping[str, _Sheets]]
"""By path and by sheet."""


def measure_sheets(
    task: Task, cells: int = CELLS, shuffles: int = SHUFFLES, paths: tuple[str, ...] = tuple(BOXES),
    seconds: float = SECONDS,
) -> _Result:  # fmt: skip
    """The grid cells of sessions of each path and sheet; the controls have one session each.

    Args:
        cells: of a session. shuffles: of each cell. seconds: of a session.
    """
    return {
        path: {way: _measure(task, path, way, cells, shuffles, seconds) for way in WAYS} for path in paths
    }


def _measure(task: Task, path: str, way: str, cells: int, shuffles: int, seconds: float) -> _Sheets:
    box = BOXES[path]
    spacing = min(box) / SPACINGS
    bin, found, errors, holes = spacing / BINS, [], [], []
    for seed in task.seeds(SESSIONS) if way == TWISTED else (task.first,):
        recording = record_sheet(path, way, cells, seed, seconds)
        active = recording.activity
        found.append(measure_cells(recording, active, box, bin, shuffles, seed, 1.5 * bin))
        if way == TWISTED and seed == task.first and find_spec("ripser"):
            holes = [find_holes(active), *shuffled_holes(active, len(active) / seconds, HOLE_SHUFFLES, seed)]
        errors.append(np.sqrt(np.mean(sheet_errors(recording, spacing) ** 2)) / spacing)
    hexagonal, square = (
        ShuffledScores(
            np.concatenate([each.score for each in scores]),
            np.concatenate([each.shuffled for each in scores], axis=1),
        )
        for scores in ([one.hexagonal for one in found], [one.square for one in found])
    )
    return _Sheets(hexagonal, square, np.array(errors), found[0].maps, holes)


def record_sheet(path: str, way: str, cells: int, seed: int, seconds: float) -> CellRecording:
    """The grid cells of a session of `rat_grid`.

    Args:
        path: of `BOXES`. way: of `WAYS`. cells: drawn by the seed, which is also that of the odometry's
            errors.
    """
    (width, height), (twisted, more) = BOXES[path], WAYS[way]
    sheet = {"spacing": min(width, height) / SPACINGS, "twisted": twisted}
    own = [f"rat_simulation.seconds={seconds}", f"rat_simulation.seed={seed}", f"session.seed={seed}"]
    own += [f"rat_simulation.path.file={path}", f"rat_simulation.box={{width: {width}, height: {height}}}"]
    own += [f"pose_cells.cell_size={min(width, height) / CELLS_ACROSS}"]
    own += [f"cells={json.dumps({'chosen': cells, 'sheet': sheet})}"]
    with open_observations(load_config("rat_grid", own + more)) as (config, source):
        return RatSessions(config).run(source)


def sheet_errors(recording: CellRecording, spacing: float) -> np.ndarray:
    """[T] distance, m, from the true place to the nearest one at which a certain belief would make the
    recorded cells as active as they are, by least squares; about 0.4 spacings by chance.

    Maps have a frame of their own: one rotation of at most `TURN` and one shift are fitted over the session.
    """
    sheet = SheetConfig(spacing=spacing, twisted=recording.shape[1] < recording.shape[2])
    at = np.stack(np.unravel_index(np.arange(np.prod(recording.shape)), recording.shape)[:0:-1], axis=1)
    at = np.column_stack([at * recording.cell_size, np.zeros(len(at))])
    nothing = jnp.zeros((1, 0), jnp.float32)
    certain = partial(
        sheet_activity, sheet, nothing, ViewCells(*[nothing] * 6), jnp.zeros(3), chosen=recording.cell
    )
    tuned = np.asarray(jax.vmap(certain)(jnp.asarray(at)), np.float64)
    best = (2 * recording.activity @ tuned.T - (tuned**2).sum(axis=1)).argmax(axis=1)
    found, true = at[best, :2], between(recording.truth[0], recording.truth)[:, :2]
    waves = sheet_waves(sheet)
    turns = np.linspace(-TURN, TURN, 121)

    def phases(turn: float) -> np.ndarray:
        c, s = np.cos(turn), np.sin(turn)
        return (found - true @ np.array([[c, s], [-s, c]])) @ waves.T

    turn = max(turns, key=lambda turn: np.abs(np.exp(1j * phases(turn)).mean(axis=0)).sum())
    phase = phases(turn)
    rest = wrap(phase - np.angle(np.exp(1j * phase).mean(axis=0)))
    return np.sqrt((rest**2).sum(axis=1) * 2 / (waves**2).sum())


def _table_sheets(result: _Result) -> list[str]:
    columns = (
        "path", "sheet", "cells", "grid score: median", "5 to 95 % of cells", "95 % of shuffles", "above it",
        "square score", "error, spacings: median", "worst",
    )  # fmt: skip
    boxes = ", ".join(f"{path} {BOXES[path][0]:g} x {BOXES[path][1]:g} m" for path in result)
    above = (
        f"Cells drawn by the seed, none selected; {boxes}; {SPACINGS:.2f} spacings along the shorter side."
        f" Goal: median grid score of at least {GOAL:g}, an error below {LARGEST_ERROR:g} spacings. The map"
        " is the same with each sheet and without one."
    )
    rows = []
    for path, ways in result.items():
        for way, found in ways.items():
            scores = found.hexagonal
            known = scores.score[np.isfinite(scores.score)]
            low, high = np.percentile(known, [5, 95]) if known.size else (np.nan, np.nan)
            control = f"{np.nanmedian(scores.percentile):.2f}", f"{100 * scores.above.mean():.0f} %"
            spread = f"{np.median(known) if known.size else np.nan:.2f}", f"{low:.2f} to {high:.2f}"
            square = f"{np.nanmedian(found.square.score):.2f}"
            errors = f"{np.median(found.error):.2f}", f"{found.error.max():.2f}"
            rows.append([path, way, str(len(scores.score)), *spread, *control, square, *errors])
    lines = [holes_line(path, ways[TWISTED].holes) for path, ways in result.items()]
    below = (
        "Not shown: a sheet that is learned, several modules, distortion by the walls: the lattice is built"
        " in, and what is measured is whether the belief is sharp enough to show it."
    )
    return table_lines([above], columns, rows, [*filter(None, lines), below])


def holes_line(path: str, holes: list[Holes]) -> str:
    """What persistent homology found; "" without it."""
    if not holes:
        return ""
    (loops, voids), *others = holes
    most = [max(each[kind].max(initial=0.0) for each in others) for kind in (0, 1)]
    counts = int((loops > most[0]).sum()), int((voids > most[1]).sum())
    longest = ", ".join(f"{each:.2f}" for each in loops[:3])
    return (
        f"Persistent homology, {path}: {counts[0]} loops and {counts[1]} voids live longer than all of"
        f" {len(others)} shuffles (goal: 2 and 1 at least). Loops {longest}; shuffles {most[0]:.2f} at most;"
        f" void {voids.max(initial=0.0):.2f}; shuffles {most[1]:.2f}."
    )


SHOWN = 6
"""Cells drawn of each path."""
GAP, HEAD, LOW, HIGH = 0.12, 0.3, 1.0, 1.4
"""Inches: between maps; above a row of them; below and height of the histograms."""


def _draw_sheets(result: _Result, png: Path) -> None:
    """Rate maps and autocorrelograms of the first cells of the twisted sheet, and all scores."""
    medians = {path: np.nanmedian(ways[TWISTED].hexagonal.score) for path, ways in result.items()}
    line = "median grid score: " + ", ".join(f"{path} {score:.2f}" for path, score in medians.items())
    line += "; maps of the first cells drawn, below each its autocorrelogram"
    wide = (style.INNER - (SHOWN - 1) * GAP) / SHOWN
    tall = [wide * BOXES[path][1] / BOXES[path][0] for path in result]
    height = style.TOP + sum(2 * (HEAD + each) for each in tall) + 0.3 + HIGH + LOW
    figure = style.new_figure(height, "Hexagons from a twisted sheet", line)
    top = height - style.TOP
    for (path, ways), up in zip(result.items(), tall, strict=True):
        maps = ways[TWISTED].maps[:SHOWN]
        kinds: list[tuple[str, np.ndarray, dict[str, Any]]] = [
            (f"{path}: rates, dark 0 to yellow their peak", maps, {"cmap": "viridis", "vmin": 0}),
            ("autocorrelograms", autocorrelogram(maps), {"cmap": "RdBu_r", "vmin": -1, "vmax": 1}),
        ]
        for name, images, how in kinds:
            top -= HEAD
            figure.text(style.LEFT / style.WIDTH, (top + 0.07) / height, name, fontsize=9, color=style.INK)
            top -= up
            for column, values in enumerate(images):
                axes = style.add_axes(figure, style.LEFT + column * (wide + GAP), top, wide, up)
                axes.imshow(values, origin="lower", aspect="auto", **how)
                axes.set(xticks=[], yticks=[])
    panels = panel_row(figure, len(result), 0.6, LOW, HIGH)
    for panel, (path, ways) in zip(panels, result.items(), strict=True):
        for way, found in ways.items():
            known = found.hexagonal.score[np.isfinite(found.hexagonal.score)]
            bins = np.linspace(-1.0, 1.6, 53).tolist()
            panel.hist(known, bins, color=COLOURS[way], alpha=0.6, label=way, density=True)
        name_panel(panel, "", f"grid score, {path}", "density")
    style.add_legend(figure, panels[0], columns=3).savefig(png)


FIGURE = Figure("Hexagons from a twisted sheet", measure_sheets, _table_sheets, _draw_sheets)
