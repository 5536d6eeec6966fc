"""Writes what follows from the map of a run directory or merged folder: files, scores, plots and the report.

The report is one page of HTML about runs, made from their directories.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.artifacts.run_reader import MERGE_REPORT as MERGED
from evaluation.artifacts.run_reader import (
    PIECES,
    is_merged,
    read_run,
    read_session_steps,
    write_closure_pairs,
    write_pieces,
)
from evaluation.metrics.energy_metric import read_relations
from evaluation.metrics.metric_registry import build_metrics
from evaluation.metrics.scorecard import Scorecard, score_run
from evaluation.metrics.trajectory import read_tum, write_tum
from evaluation.plots.map_plot import draw_sessions
from evaluation.plots.run_plots import plot_writers
from evaluation.report import PAGE_START
from evaluation.report.page import check_report_libraries, write_page
from evaluation.report.run_report import read_run_report
from ratslam.core.backend import Map
from ratslam.runs.settings.packaged import read_citation
from ratslam.runs.settings.run_config import ScoreConfig, changed_settings
from tactile.base.errors import InputError
from tactile.base.files import require_new_file, write_atomically, write_text_atomically

NAME = "report.html"
"""Name of the page in a run directory."""


def write_report(directories: Sequence[Path], path: Path) -> None:
    """Writes the page of a run, or of several and their comparison; the file works without network.

    Args:
        directories: of runs, also of interrupted or killed ones. path: the file; a page that was
            there is replaced.

    Raises:
        InputError: a folder holds no run or a malformed one, the file exists and is no page, or the extra
            [report] is not installed.
    """
    check_report_libraries("report")
    require_new_file(path, replaces=PAGE_START)
    runs = []
    for directory in directories:
        try:
            settings = changed_settings(directory / "config.yaml")
        except InputError:
            settings = None  # of a configuration of another version
        runs.append((read_run_report(directory), settings))
    write_page(path, runs, read_citation())


DERIVED = ("pieces.csv", "health.json", "calibration.yaml", "closures.csv")
"""Files that only some maps have."""


def write_map_results(folder: Path, made: Map, time: np.ndarray) -> None:
    """Writes trajectories, pieces, health, graph, closures and calibration of a map, each atomically;
    those of an earlier map that this one lacks are removed.

    Args:
        time: [n] s, of the last n steps, which are those of the folder.
    """
    first = len(made.pieces()) - len(time)
    final, own, piece = (path[first:] for path in (made.trajectory(), made.map_trajectory(), made.pieces()))
    write_atomically(folder / "trajectory.tum", lambda path: write_tum(path, time, final))
    write_atomically(folder / "map.tum", lambda path: write_tum(path, time, own))
    files: dict[str, Callable[[Path], Any]] = dict(made.files())
    if made.pieces().any():
        files[PIECES] = lambda path: write_pieces(path, time, piece)
    doubt, reason, pairs = made.final_doubt(), made.unjudged(), made.closures()
    if np.isfinite(doubt) or reason:
        health = {"worse_than_odometry": doubt if np.isfinite(doubt) else None}
        text = json.dumps(health | ({"reason": reason} if reason else {})) + "\n"
        files["health.json"] = lambda path: path.write_text(text, encoding="utf-8")
    if len(pairs):
        files.setdefault("closures.csv", lambda path: write_closure_pairs(path, pairs))
    for name, write in files.items():
        write_atomically(folder / name, write)
    for name in DERIVED:
        if name not in files:
            (folder / name).unlink(missing_ok=True)


def write_merged_results(folder: Path, made: Map, name: str, steps: Sequence[int]) -> None:
    """The same for a merged map, whose steps have no times but their numbers, and its picture.

    Args:
        name: title of the picture. steps: of each session, in the order of the map.
    """
    path, piece = made.trajectory(), made.pieces()
    write_map_results(folder, made, np.arange(len(path), dtype=float))
    write_atomically(folder / "map.png", draw_sessions(name, path, piece, steps).savefig)


def rewrite_results(folder: Path, made: Map, config: ScoreConfig) -> None:
    """Writes the files that follow from a map that was changed in its run directory or merged folder.

    Raises:
        InputError: a file is missing or malformed, or the run has steps that its map lacks.
    """
    steps = len(made.pieces())
    if is_merged(folder):
        sessions = read_session_steps(folder)
        if sum(sessions) != steps:
            found = f"sessions of {sum(sessions)} steps beside a map of {steps}"
            raise InputError(str(folder / MERGED), found, "those of the map")
        write_merged_results(folder, made, folder.resolve().name, sessions)
        return
    online = folder / "online.tum"
    time, _ = read_tum(online)
    if len(time) > steps:
        cure = "end it with `ratslam run --continue` first, or write the map alone to a new file with -o"
        raise InputError(str(online), f"{len(time)} steps beside a map of {steps}", "a run that ended", cure)
    write_map_results(folder, made, time)
    score_and_plot(folder, config)
    (folder / NAME).unlink(missing_ok=True)


def score_and_plot(folder: Path, config: ScoreConfig) -> Scorecard:
    """Scores a run directory and plots it; see `Runner.finish`."""
    relations = read_relations(config.relations) if config.relations else None
    metrics, exm = build_metrics(config.metrics), config.experience_metric
    card = score_run(read_run(folder), folder.name, exm=exm, relations=relations, metrics=metrics)
    write_text_atomically(folder / "scorecard.json", card.model_dump_json(indent=2) + "\n")
    for name, save in plot_writers(folder).items():
        write_atomically(folder / name, save)
    return card
