"""A run as the report shows it, read from its directory; its loop closures and views as data for the page."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.artifacts.grid_files import read_grid, read_grid_truth
from evaluation.artifacts.run_reader import (
    RUNNING,
    ClosureTable,
    ClosureViews,
    Manifest,
    check_run_directory,
    read_closure_table,
    read_closure_views,
    read_columns,
    read_manifest,
    read_run,
    read_scorecard,
    read_walls,
)
from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.occupancy_score import GridScore
from evaluation.metrics.run_metrics import UNFINISHED, Layers, RunArrays, arrange_pieces
from evaluation.metrics.scorecard import Scorecard, score_run
from evaluation.metrics.trajectory import read_tum
from evaluation.report.verdict import Verdict, judge_map
from tactile.base.bounded import read_json, read_plain_yaml, read_text
from tactile.base.errors import InputError
from tactile.base.se2 import between

SOURCES = {
    "recording": "a recording",
    "simulation": "a simulated whisker head in a maze",
    "create_simulation": "a simulated Create with whiskers",
    "rat_simulation": "a simulated rat in a box with cues",
    "source": "a registered source",
    "live": "a live session",
}
"""Sections of a configuration that name its source, and what each is."""


class RunReport(NamedTuple):
    """A run of N steps.

    Attributes:
        backend, source: method, and kind of source; '' where the configuration cannot be read.
        doubt: [N] probability at each step that the map is worse than odometry, NaN: not judged.
        spread: [N] standard deviation of the position at each step, m. belief: [n, 3] probability of the
            heaviest packet of the pose cells, of the second and of a new place, at the steps `belief_step`
            [n]; n = 0 of methods whose pose cells hold no belief.
        online_error: [k, 2] time, s, and error of the current pose then, m.
        cost: [k, 2] number of steps, and mean computing time of one of the last of them, s.
        run: its arrays, pieces of the map as `arrange_pieces` draws them.
        layers: paths in the frame of the map, to which `layers.to_map` moves `walls`.
        map_path: [N, 2] the path of a doubted map in that frame; None: `layers.final` is that of the map.
        truth_lines: [S, 4] true walls of a grid's arena, m. grid: in the frame of the layers.
    """

    name: str
    manifest: Manifest
    backend: str
    source: str
    run: RunArrays
    card: Scorecard
    verdict: Verdict
    doubt: np.ndarray
    spread: np.ndarray
    belief: np.ndarray
    belief_step: np.ndarray
    online_error: np.ndarray
    cost: np.ndarray
    layers: Layers
    map_path: np.ndarray | None
    walls: np.ndarray
    truth_lines: np.ndarray
    grid: OccupancyGrid | None
    grid_score: GridScore | None
    closures: ClosureTable
    views: ClosureViews | None
    files: Sequence[tuple[str, int, str]]

    def describe_status(self) -> str:
        """How the run ended, in a few words."""
        count, total, status = len(self.run.time), self.manifest.total, self.manifest.status
        steps = f"{count:,} steps" if total in (None, count) else f"{count:,} of {total:,} steps"
        known = {"complete": "finished,", "interrupted": "interrupted after"}
        known[RUNNING] = "not finished: killed, or still running, after"
        return f"{known.get(status, f'ended as {status} after')} {steps}"


def read_run_report(directory: Path) -> RunReport:
    """Reads a run directory, also that of an interrupted, killed or unfinished run; such a run is scored and
    judged by what is there.

    Raises:
        InputError: the folder holds no run, a run without steps, or a malformed file.
    """
    check_run_directory(directory)
    measured, steps = read_run(directory), directory / "steps.csv"
    run = arrange_pieces(measured)
    count = len(run.time)
    doubt = read_columns(steps, "doubt", empty=np.nan)[0][:count]
    verdict, known = judge_map(run.doubt, run.unjudged), doubt[np.isfinite(doubt)]
    if run.unjudged == UNFINISHED and len(known):
        run = run._replace(doubt=float(known[-1]))
        verdict = judge_map(run.doubt)
        reason = f"{verdict.reason} This is the judgement at the last step in its files."
        verdict = verdict._replace(reason=reason)
    name = directory.resolve().name
    scored = (directory / "scorecard.json").exists()
    layers, lines, grid = _layers(directory, run)
    file, expected = directory / "gridscore.json", "the scores of a grid"
    score = read_json(file, expected, GridScore.model_validate) if file.exists() else None
    belief, belief_step = _belief(steps, count)
    step, steps_of, seconds = _columns(directory / "timing.csv", "step", "steps", "seconds").T
    return RunReport(
        name=name,
        manifest=read_manifest(directory),
        **_method(directory),
        run=run,
        card=read_scorecard(directory) if scored else score_run(measured, name),
        verdict=verdict,
        doubt=doubt,
        spread=np.hypot(*read_columns(steps, "sd_x", "sd_y"))[:count],
        belief=belief,
        belief_step=belief_step,
        online_error=_columns(directory / "online_error.csv", "t", "error"),
        cost=np.column_stack([step, seconds / np.maximum(steps_of, 1)]),
        layers=layers,
        map_path=_map_path(directory, measured),
        walls=read_walls(directory) if layers.truth is not None else np.zeros((0, 5)),
        truth_lines=lines,
        grid=grid,
        grid_score=score,
        closures=read_closure_table(directory),
        views=read_closure_views(directory),
        files=list_run_files(directory),
    )


def _method(directory: Path) -> dict[str, str]:
    """Backend and kind of source by the configuration."""
    try:
        given = read_plain_yaml(directory / "config.yaml", "the configuration of a run")
    except InputError:
        given = {}
    source = next((words for name, words in SOURCES.items() if given.get(name) is not None), "")
    backend = given.get("backend")
    return {"backend": backend if isinstance(backend, str) else "", "source": source}


def _layers(directory: Path, run: RunArrays) -> tuple[Layers, np.ndarray, OccupancyGrid | None]:
    """Paths, true walls [S, 4] and grid in one frame: that of the map."""
    nothing = np.zeros((0, 4))
    if not (directory / "grid.npz").exists():
        return Layers.align(run), nothing, None
    grid, lines, truth = read_grid(directory / "grid.npz"), nothing, None
    if (directory / "arena.npz").exists():
        arena, start = read_grid_truth(directory / "arena.npz")
        lines = arena.segments
        truth = None if run.truth is None else between(start, run.truth)
    if truth is None:
        return Layers.align(run), lines, grid
    paths = (truth[:, :2], run.odometry[:, :2], run.final[:, :2], run.nodes[:, :2])
    return Layers(*paths), lines, grid


def _map_path(directory: Path, run: RunArrays) -> np.ndarray | None:
    """The path of the map of a doubted run, in the frame of its layers."""
    file = directory / "map.tum"
    if not file.exists() or not (directory / "trajectory.tum").exists():
        return None
    path = read_tum(file)[1][: len(run.time)]
    if len(path) < len(run.time) or np.array_equal(path, run.final):
        return None
    return arrange_pieces(run._replace(final=path)).final[:, :2]


def _belief(steps: Path, count: int) -> tuple[np.ndarray, np.ndarray]:
    """`RunReport.belief` and the steps of its rows."""
    header = read_text(steps, "a file of a run directory").partition("\n")[0].split(",")
    if "second" not in header:
        return np.zeros((0, 3)), np.zeros(0, int)
    keyframe, *belief = read_columns(steps, "keyframe", "posterior", "second", "novelty")
    keyframe = keyframe[:count]
    at = np.flatnonzero(keyframe >= 0)
    return np.stack(belief, axis=1)[at], at


def _columns(file: Path, *names: str) -> np.ndarray:
    """Columns of a file as an array; without rows if there is none."""
    return np.column_stack(read_columns(file, *names)) if file.exists() else np.zeros((0, len(names)))


VIEW_BYTES = 2_000_000
"""Most bytes of views in a page, before their encoding adds a third; larger views lose resolution."""
LABELS = {
    "shift": "turn between the views, columns",
    "posterior": "posterior",
    "log_ratio": "log-likelihood ratio to a new place",
    "sequence": "sequence",
    "distance": "squared Mahalanobis distance",
    "weight": "robust weight",
    "log_odds": "log odds of the sequence",
}
"""What the columns of evidence are; others are named as in the file."""
_LEFT_OUT = ("keyframe", "match")  # they say the same as the steps
WORDS = {"accepted": "accepted", "open": "not accepted", "undone": "undone"}
"""Verdicts as the page names them; others are named as in the file."""


def closure_records(table: ClosureTable, run: RunArrays) -> dict[str, Any]:
    """The closures in columns: the steps that each joins, their times (s from the first step), how far they
    are apart in truth (m; None where unknown), verdict and evidence."""
    inside = (table.steps >= 0) & (table.steps < len(run.time))
    rows = np.where(inside, table.steps, 0)
    time = np.where(inside, run.time[rows] - run.time[0], np.nan)
    apart = np.full(len(rows), np.nan)
    if run.truth is not None and len(rows):
        ends = np.where(inside[..., None], run.truth[rows][..., :2], np.nan)
        apart = np.hypot(*(ends[:, 0] - ends[:, 1]).T)
    evidence = {name: column for name, column in table.evidence.items() if name not in _LEFT_OUT}
    return {
        "steps": table.steps.tolist(),
        "times": [_plain_numbers(row) for row in time],
        "apart": _plain_numbers(apart),
        "verdicts": [WORDS.get(verdict, verdict) for verdict in table.verdicts],
        "evidence": [
            {"name": name, "label": LABELS.get(name, name), "values": _plain_numbers(column)}
            for name, column in evidence.items()
        ],
    }


def view_records(views: ClosureViews | None) -> dict[str, Any] | None:
    """The views as one string of bytes; those of too many bytes are reduced, see `VIEW_BYTES`."""
    if views is None:
        return None
    image, shape = views.view, views.view.shape[1:]
    while image.size > VIEW_BYTES and max(image.shape[1:]) > 1:
        image = halve(image)
    # The factor, at least 1, that makes the brightest hundredth of the non-zero pixels white. Views of a room
    # that is small beside the range of the sensor would be black otherwise.
    seen = image[image > 0]
    gain = max(255 / float(np.quantile(seen, 0.99)), 1.0) if seen.size else 1.0
    image = np.minimum(np.ceil(image * gain), 255).astype(np.uint8)
    return {
        "steps": views.step.tolist(),
        "gain": gain,
        "rows": image.shape[1],
        "columns": image.shape[2],
        "shape": list(shape),
        "pixels": b64encode(np.ascontiguousarray(image).tobytes()).decode(),
    }


def halve(image: np.ndarray) -> np.ndarray:
    """Images [n, R, C] at half the resolution along their longer side: means of two neighbours; the last
    pixel of an odd side has no neighbour and stays."""
    axis = 1 + int(image.shape[2] >= image.shape[1])
    starts = np.arange(0, image.shape[axis], 2)
    count = np.minimum(2, image.shape[axis] - starts)
    total = np.add.reduceat(image.astype(np.uint16), starts, axis)
    return (total // np.expand_dims(count, (0, 3 - axis))).astype(np.uint8)


def _plain_numbers(values: np.ndarray) -> list[float | str | None]:
    """Values [n] of 5 digits for JSON; NaN as None, infinity as "inf"."""
    return [
        None if np.isnan(value) else float(f"{value:.5g}") if np.isfinite(value) else f"{value}"
        for value in np.asarray(values, float).tolist()
    ]


FILES = {
    "config.yaml": "the completed configuration; `run` accepts it from any folder",
    "manifest.json": "status, versions, seed, and hashes of input and configuration",
    "scorecard.json": "the scores of the run",
    "gridscore.json": "the scores of the occupancy grid",
    "trajectory.tum": "final trajectory: that of the map, or odometry if the map is doubted",
    "map.tum": "final trajectory of the map, doubted or not",
    "pieces.csv": "piece of the map in which each step is; poses of different pieces cannot be compared",
    "localisation.csv": "state and probability of the pose in a saved map, a line for each step",
    "changes.csv": "places where a session does not agree with the saved map",
    "changes.png": "picture of the saved map with these places",
    "online.tum": "the pose at each step as it was known then",
    "odometry.tum": "dead reckoning of the raw odometry",
    "truth.tum": "true poses, where known",
    "steps.csv": "a line for each step: place, action, pose, spread, doubt, outcome, evidence",
    "online_error.csv": "error of the current pose while the run went on, m",
    "timing.csv": "computing time of each chunk of steps, s; differs from run to run",
    "health.json": "probability that the map is worse than odometry; null with its reason",
    "closures.csv": "loop closures that the map considered, with evidence and verdicts",
    "closure_views.npz": "the views that loop closures join, as 8-bit images",
    "views.npz": "whisker images of all steps",
    "map.json": "experiences and their links as a node-link graph",
    "map.g2o": "the pose graph, for other optimisers",
    "map.npz": "the map; `run --continue` goes on from it",
    "calibration.yaml": "calibration of the odometry, as settings for the next session",
    "grid.npz": "occupancy grid: probability, origin, cell",
    "map.pgm": "occupancy grid as an image, for nav2",
    "map.yaml": "description of map.pgm, for nav2",
    "maze.txt": "the maze",
    "walls.csv": "the walls of the maze, m",
    "arena.txt": "the arena",
    "arena.npz": "the true occupancy of the arena",
    "map.png": "picture of the map",
    "whiskers.png": "picture of the whisker images",
    "experiences.png": "picture of the current experience at each step",
    "grid.png": "picture of the occupancy grid",
    "cells.png": "picture of recorded pose cells",
    "cells.npz": "recorded pose cells",
    "cells.rows": "pose cells recorded so far, of a run that goes on or was killed",
    "watch.png": "picture by `watch` of the run in progress",
    "report.html": "this kind of page",
    "session.mcap": "recording of a live session",
    "live.json": "report of a live session",
    "mapper.log": "log of a live session",
}
"""In the order of the page."""
OTHER = "not a file of ratslam's own"


def list_run_files(directory: Path) -> list[tuple[str, int, str]]:
    """Name, size in bytes and content of the files of a run directory, known ones first; no hidden ones."""
    found = {path.name: path for path in sorted(directory.iterdir()) if path.is_file()}
    order = [name for name in FILES if name in found]
    order += [name for name in found if name not in FILES and not name.startswith(".")]
    return [(name, found[name].stat().st_size, FILES.get(name, OTHER)) for name in order]
