"""The table of recordings with laser views, camera-like views or given place ids.

ATE is the RMS position error of the final map after a rigid alignment, in metres. A closure is false if its
two steps are more than `FALSE_CLOSURE_CELLS` pose cells apart in truth. Perturbed copies have another start,
noise and dropped frames (`robot.sources.perturbation`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import ate
from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import load, override, validate
from ratslam.experiments.studies.executor import run_tasks
from ratslam.experiments.tables.markdown import markdown_header, markdown_row
from ratslam.pipeline.runner import build_session
from ratslam.pipeline.source import open_observations
from robot.sources.in_memory import load_into_memory
from robot.sources.perturbation import perturb
from robot.touch_source import observation_of
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

FALSE_CLOSURE_CELLS = 2.5
DATA = "RATSLAM_DATA"
"""Environment variable: the folder of the real recordings, which are not part of the project."""
GOLDEN = "../tests/golden"
"""Folder of test recordings, from the folder of the configurations."""


class Recording(NamedTuple):
    """A row: its label, configuration, another recording in `GOLDEN`, whether it is one of `DATA`, and
    assignments of settings."""

    label: str
    config: str
    file: str = ""
    real: bool = False
    settings: tuple[str, ...] = ()


ROWS = {
    "square": Recording("`configs/square.yaml`, synthetic", "configs/square.yaml"),
    "figure8": Recording(
        "`b_figure8_alias`, a third of the places look alike", "configs/square.yaml", "b_figure8_alias.npz"
    ),
    "kidnap": Recording(
        "`e_kidnap`, carried away once, `keyframes.may_be_carried`",
        "configs/square.yaml",
        "e_kidnap.npz",
        settings=("keyframes.may_be_carried=true",),
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
    missing = {row: reason for row in rows if (reason := _missing(ROWS[row], folder))}
    present = [row for row in rows if row not in missing]
    tasks = []
    for row in present:
        tasks.append((_config(ROWS[row], folder, ["backend=classic"]), 0))
        tasks += [(_config(ROWS[row], folder), seed) for seed in range(copies + 1)]
    results = run_tasks(measure_recording, tasks, workers=workers)
    yield markdown_header(COLUMNS)
    for row in present:
        classic, ours, *perturbed_copies = (next(results) for _ in range(copies + 2))
        errors = [copy.ate for copy in perturbed_copies]
        spread = f"{_metres(np.median(errors))}, {_metres(max(errors))}" if errors else "-"
        yield markdown_row([ROWS[row].label, _metres(ours.odometry), _cell(classic), _cell(ours), spread])
    yield from ["", *(f"Left out: {row}: {reason}" for row, reason in missing.items())] if missing else []


def measure_recording(task: tuple[RunConfig, int]) -> RecordingFigures:
    """Runs and measures one recording, perturbed with a seed (0: not at all).

    Raises:
        InputError: the recording cannot be used, or has no truth.
    """
    given, seed = task
    with open_observations(given) as (config, source):
        log = load_into_memory(source)
    if log.truth is None:
        raise InputError(log.name, "no true poses", "a recording with truth")
    log = perturb(log, seed) if seed else log
    session = build_session(config, log)
    list(session.replay(observation_of(sample) for sample in log))
    truth = np.asarray(log.truth)
    known = np.isfinite(truth).all(axis=1)
    closures = session.map.closures()
    apart = np.hypot(*(truth[closures[:, 0]] - truth[closures[:, 1]])[:, :2].T)
    return RecordingFigures(
        ate=ate(session.map.trajectory()[known], truth[known]),
        odometry=ate(integrate(log.motion[:, :3])[known], truth[known]),
        closures=len(closures),
        false_closures=int((apart > FALSE_CLOSURE_CELLS * config.pose_cells.cell_size).sum()),
    )


def _missing(recording: Recording, folder: Path) -> str:
    """The reason that a recording cannot be used; "" if it can."""
    if recording.real and not os.environ.get(DATA):
        return f"set {DATA} to the folder of the real recordings"
    config = folder / recording.config
    files = config, config.parent / GOLDEN / recording.file
    absent = [file for file in files if not file.exists()]
    return f"{absent[0]} does not exist; run the command in the repository" if absent else ""


def _config(recording: Recording, folder: Path, assignments: Sequence[str] = ()) -> RunConfig:
    path = folder / recording.config
    other = [f"recording.file={GOLDEN}/{recording.file}"] if recording.file else []
    document = override(load(path), [*other, *recording.settings, *assignments])
    return validate(document, RunConfig).with_absolute_paths(path.parent.resolve())


def _cell(figures: RecordingFigures) -> str:
    return f"{_metres(figures.ate)} ({figures.closures}, {figures.false_closures})"


def _metres(value: float | np.floating) -> str:
    return f"{value:.3f}" if value < 1 else f"{value:.2f}"
