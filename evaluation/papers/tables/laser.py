"""The table of recordings with laser views, camera-like views or given place ids.

ATE is the RMS position error of the final map after a rigid alignment, in metres. A closure is false if its
two steps are more than `FALSE_CLOSURE_CELLS` pose cells apart in truth. Perturbed copies have another start,
noise and dropped frames (`evaluation.studies.perturbation`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.papers.tables.recordings import GOLDEN, Recording, metres
from evaluation.papers.trials.recording_trial import run_recording
from evaluation.studies.executor import run_tasks
from evaluation.studies.perturbation import perturb
from ratslam.runs.settings.run_config import RunConfig

FALSE_CLOSURE_CELLS = 2.5

ROWS = {
    "square": Recording("`configs/square.yaml`, synthetic", "configs/square.yaml"),
    "figure8": Recording(
        "`b_figure8_alias`, a third of the places look alike",
        "configs/square.yaml",
        (f"recording.file={GOLDEN}/b_figure8_alias.npz",),
    ),
    "kidnap": Recording(
        "`e_kidnap`, carried away once, `keyframes.may_be_carried`",
        "configs/square.yaml",
        (f"recording.file={GOLDEN}/e_kidnap.npz", "keyframes.may_be_carried=true"),
    ),
    "tuc": Recording(
        "`configs/tuc_lecture_hall.yaml`, real, given place ids", "configs/tuc_lecture_hall.yaml", real=True
    ),
    "intel": Recording(
        "`configs/intel_laser.yaml`, real, 18-number laser views", "configs/intel_laser.yaml", real=True
    ),
}
COLUMNS = (
    "recording", "odometry", "classic (closures, false)", "ratslam (closures, false)",
    "perturbed: median, maximum",
)  # fmt: skip


class RecordingFigures(NamedTuple):
    """The figures of one run: ATE of the final map and of dead reckoning, m; closures and false ones."""

    ate: float
    odometry: float
    closures: int
    false_closures: int


def laser_table(
    rows: Sequence[str] = tuple(ROWS), copies: int = 10, workers: int = 0, folder: Path = Path()
) -> Iterator[str]:
    """The lines of the table; rows whose recordings are missing are named below it.

    Args:
        folder: of the repository, which holds `configs` and `tests`.
    """
    missing = {row: reason for row in rows if (reason := ROWS[row].missing(folder))}
    present = [row for row in rows if row not in missing]
    tasks = []
    for row in present:
        tasks.append((ROWS[row].configuration(folder, "backend=classic"), 0))
        tasks += [(ROWS[row].configuration(folder), seed) for seed in range(copies + 1)]
    results = run_tasks(measure_recording, tasks, workers=workers)
    yield markdown_header(COLUMNS)
    for row in present:
        classic, ours, *perturbed_copies = (next(results) for _ in range(copies + 2))
        errors = [copy.ate for copy in perturbed_copies]
        spread = f"{metres(np.median(errors))}, {metres(max(errors))}" if errors else "-"
        yield markdown_row([ROWS[row].label, metres(ours.odometry), _cell(classic), _cell(ours), spread])
    yield from ["", *(f"Left out: {row}: {reason}" for row, reason in missing.items())] if missing else []


def measure_recording(task: tuple[RunConfig, int]) -> RecordingFigures:
    """Runs and measures one recording, perturbed with a seed (0: not at all).

    Raises:
        InputError: the recording cannot be used, or has no truth.
    """
    config, seed = task
    run = run_recording(config, perturb if seed else None, seed)
    closures = run.session.map.closures()
    apart = np.hypot(*(run.truth[closures[:, 0]] - run.truth[closures[:, 1]])[:, :2].T)
    return RecordingFigures(
        ate=run.ate(run.final),
        odometry=run.ate(run.odometry),
        closures=len(closures),
        false_closures=int((apart > FALSE_CLOSURE_CELLS * run.config.pose_cells.cell_size).sum()),
    )


def _cell(figures: RecordingFigures) -> str:
    return f"{metres(figures.ate)} ({figures.closures}, {figures.false_closures})"
