"""The five lines that open the score of a run: what was done, error, closures, warnings, health."""

from __future__ import annotations

from pathlib import Path

from evaluation.artifacts.closure_table import count_closures
from evaluation.artifacts.manifest import read_manifest
from evaluation.artifacts.run_reader import read_run
from evaluation.metrics.run_metrics import path_length
from evaluation.metrics.scorecard import Scorecard, render_error, render_health, render_warnings


def summarise(directory: Path, card: Scorecard, method: str) -> str:
    """The lines on a run directory; one more for each further warning about the input.

    Args:
        method: name of the backend.

    Raises:
        InputError: a file is missing or malformed.
    """
    run, source, closures = read_run(directory), read_manifest(directory).source, count_closures(directory)
    extent = f"{run.time[-1] - run.time[0]:.3g} s, {path_length(run.odometry):.3g} m by odometry"
    accepted = f"{closures.accepted} of {closures.proposed} proposed were accepted" if closures else "none"
    return "\n".join(
        [
            f"{directory}: {len(run.time)} steps of {source} by {method}, {extent}",
            render_error(card),
            f"closures: {accepted}",
            *(render_warnings(card) or ["warnings: none"]),
            render_health(card),
        ]
    )
