"""The main job as a function, and its result: a view of a run directory."""

from __future__ import annotations

import os
from base64 import b64encode
from functools import cached_property
from html import escape
from io import BytesIO
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from evaluation.artifacts.run_reader import read_manifest, read_run, read_scorecard
from evaluation.cells.recording import NAME as CELLS
from evaluation.cells.recording import CellRecording, read_recording
from evaluation.metrics.scorecard import Scorecard, render_health, render_warnings, scorecard_html
from evaluation.plots.run_plots import run_plots
from evaluation.report.verdict import describe_score, judge_map
from ratslam.core.compilation import keep_kernels
from ratslam.mapping.pose_graph import read_json
from ratslam.runs.build_session import ConfigLike, resolve_config
from ratslam.runs.estimate import Health
from ratslam.runs.map_results import NAME, write_report
from ratslam.runs.run import run as write_run
from ratslam.runs.settings.run_config import RunConfig
from tactile.base.errors import InputError

if TYPE_CHECKING:
    import networkx
    from matplotlib.figure import Figure

RUNS = Path("runs")
"""Folder of the new run directories, in the working folder."""


def run(
    config: ConfigLike, directory: str | os.PathLike[str] | None = None, *, resume: Path | None = None
) -> Result:
    """Maps the source of a configuration, scores the map and plots it, with a progress bar.

    Args:
        config: a configuration, its file, or its name. directory: the new run directory; None: runs/NAME, or
            runs/NAME-2 and so on if there is one, so that nothing is lost or overwritten.
        resume: map to continue from, a run directory or its map.npz.

    Returns:
        the result; after Ctrl-C that of the steps so far, with `interrupted`.

    Raises:
        InputErrors: the configuration has errors.
        InputError: the source, the checkpoint or the run directory cannot be used.
    """
    keep_kernels()
    name = "run" if isinstance(config, RunConfig) else Path(config).stem
    if directory is None:
        paths = (RUNS / (name if number == 1 else f"{name}-{number}") for number in count(1))
        path = next(path for path in paths if not path.exists())
    else:
        path = Path(directory)
    write_run(resolve_config(config), path, resume)
    return Result(path)


class Result:
    """The result of a run, read from its directory; a notebook shows its map and its scorecard.

    Args:
        directory: of a scored run.

    Attributes:
        directory, scorecard: of the run. time: [T] of each step, s.
        trajectory: [T, 3] final poses: x m, y m, heading rad; those of the map, or odometry if the map is
            doubted. odometry: [T, 3] poses by odometry alone. truth: [T, 3] true poses, NaN where unknown;
            None if never known.
        health: how far input and map can be believed. warnings: about the input, a sentence each; () if it is
            clean.

    Raises:
        InputError: it is not the directory of a scored run.
    """

    def __init__(self, directory: str | os.PathLike[str]) -> None:
        self.directory = Path(directory).resolve()
        self.scorecard: Scorecard = read_scorecard(self.directory)
        run = read_run(self.directory)
        self.time, self.trajectory, self.odometry, self.truth = run.time, run.final, run.odometry, run.truth
        self.health, self.warnings = Health(run.doubt, run.unjudged, run.warnings), run.warnings

    @cached_property
    def graph(self) -> networkx.DiGraph:
        """The map: experiences with x, y (m) and heading (rad), and the links between them; empty for methods
        without a graph."""
        import networkx  # slow to import

        file = self.directory / "map.json"
        return read_json(file) if file.exists() else networkx.DiGraph()

    @cached_property
    def cells(self) -> CellRecording | None:
        """The recorded pose cells of this run's steps; None if its configuration has no `cells`.

        Raises:
            InputError: the file is broken.
        """
        file = self.directory / CELLS
        return read_recording(file) if file.exists() else None

    @cached_property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the run before its source ended."""
        file = self.directory / "manifest.json"
        return file.exists() and read_manifest(self.directory).status == "interrupted"

    def plot(self, name: str = "map") -> Figure:
        """A plot of the run as a matplotlib figure; a notebook shows it after `%matplotlib inline`.

        Args:
            name: `map`; with whiskers also `whiskers` and `experiences`, with a grid map also `grid`, with
                recorded pose cells also `cells`.

        Raises:
            InputError: the run has no such plot.
        """
        plots = run_plots(self.directory)
        if name not in plots:
            raise InputError("plot", repr(name), f"one of {', '.join(plots)}")
        return plots[name]()

    def report(self, path: str | os.PathLike[str] | None = None) -> Path:
        """Writes a page (HTML) about the run, which opens in a browser without network.

        Args:
            path: the file, which may replace a page only; None: report.html in the run directory.

        Returns:
            the path of the page.

        Raises:
            InputError: the extra [report] is not installed.
        """
        page = self.directory / NAME if path is None else Path(path)
        write_report([self.directory], page)
        return page

    def __repr__(self) -> str:
        error, parts = self.scorecard.quantities["ate_final"], [render_health(self.scorecard)]
        if error.value is not None:
            raw = "" if error.odometry is None else f" (odometry {error.odometry:.3g})"
            parts = [f"position error {error.value:.3g} {error.unit}{raw}", *parts]
        summary = ", ".join(part for part in parts if part)
        return f"<Result of {len(self.time)} steps in {self.directory}: {summary}>"

    def _repr_html_(self) -> str:
        picture = BytesIO()
        self.plot().savefig(picture, format="png")
        source = f"data:image/png;base64,{b64encode(picture.getvalue()).decode()}"
        image = f'<img src="{source}" alt="map of {escape(self.scorecard.name)}" style="max-width: 100%">'
        verdict = judge_map(self.health.doubt, self.health.reason)
        words = [f"{verdict.headline}. {verdict.reason} {describe_score(self.scorecard)}"]
        text = "".join(f"<p>{escape(line)}</p>" for line in words + render_warnings(self.scorecard))
        return f"<div>{image}{text}{scorecard_html(self.scorecard)}</div>"
