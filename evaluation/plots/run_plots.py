"""Plots of a run, made from its directory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evaluation.artifacts.grid_files import read_grid, read_grid_truth
from evaluation.artifacts.run_reader import (
    CHANGES,
    read_changes,
    read_closures,
    read_run,
    read_scorecard,
    read_walls,
    read_whisker_views,
)
from evaluation.cells import recording
from evaluation.metrics.occupancy_score import GridScore
from evaluation.metrics.run_metrics import Layers, RunArrays, arrange_pieces
from evaluation.plots.cell_plot import draw_recorded_cells
from evaluation.plots.experience_plot import draw_experience_history
from evaluation.plots.grid_plot import GridPanel, draw_grid, grid_headline
from evaluation.plots.map_plot import draw_changes, draw_map
from evaluation.plots.whisker_plot import draw_whiskers
from tactile.base.bounded import read_json
from tactile.base.se2 import between

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def run_plots(directory: Path) -> dict[str, Callable[[], Figure]]:
    """The plots of a scored run: name -> function that draws the plot.

    Every run has `map`, runs with whiskers also `whiskers` and `experiences`, sessions localised in a map
    also `changes`, runs with a grid map also `grid`, runs with recorded pose cells also `cells`.

    Raises:
        InputError: a file is missing or malformed.
    """
    run, card = read_run(directory), read_scorecard(directory)
    walls, closures = read_walls(directory), read_closures(directory)
    plots: dict[str, Callable[[], Figure]] = {"map": lambda: draw_map(run, card, walls, closures)}
    if (directory / "views.npz").exists():
        images = read_whisker_views(directory / "views.npz")
        plots["whiskers"] = lambda: draw_whiskers(run, card, images, walls)
        plots["experiences"] = lambda: draw_experience_history(run, card)
    if (directory / CHANGES).exists():
        changes = read_changes(directory / CHANGES)
        plots["changes"] = lambda: draw_changes(card.name, run, changes, walls)
    if (directory / "grid.npz").exists():
        plots["grid"] = lambda: draw_grid(_grid_panel(directory, run))
    cells = directory / recording.NAME
    if cells.exists():
        title = f"Pose cells: {card.name}"
        plots["cells"] = lambda: draw_recorded_cells(title, recording.read_recording(cells))
    return plots


def plot_writers(directory: Path) -> dict[str, Callable[[Path], None]]:
    """The plots of `run_plots` as files: file name -> function that saves the plot to a path.

    Equal directories give equal bytes.
    """
    return {
        f"{name}.png": lambda path, draw=draw: draw().savefig(path)  # type: ignore[misc]
        for name, draw in run_plots(directory).items()
    }


def _grid_panel(directory: Path, run: RunArrays) -> GridPanel:
    """The grid map of a run with its truth, if known."""
    grid = read_grid(directory / "grid.npz")
    if len(run.state):
        shown = arrange_pieces(run)
        layers = Layers.align(shown)
        true = np.full((1, 2), np.nan) if layers.truth is None else layers.truth
        known = np.where(run.found[:, None], shown.final[:, :2], np.nan)
        line = f"found in {run.found.sum():,} of {len(run.time):,} steps"
        return GridPanel(directory.name, line, grid, paths=(true, known, layers.odometry))
    if run.truth is None or not (directory / "arena.npz").exists():
        return GridPanel(directory.name, "", grid)
    truth, start = read_grid_truth(directory / "arena.npz")
    score = read_json(directory / "gridscore.json", "the scores of a grid", GridScore.model_validate)
    paths = (between(start, run.truth), run.online, run.odometry)
    return GridPanel(directory.name, grid_headline(score), grid, truth.segments, paths)
