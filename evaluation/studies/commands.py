"""The commands that run a configuration many times: study, size."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ratslam.cli.common import INPUT_ERROR, Commands, add_config, positive_integer, prepare_jax, read_config
from ratslam.runs.settings.packaged import find_config
from tactile.base.errors import InputError, tell
from tactile.base.files import require_new_file, require_own_folder

GROWTH = "growth"
"""Preset that measures long sessions."""
CELLS = "cells"
"""Preset that simulates many networks of pose cells."""
PRESETS = ("ablate", "vary", "spread", "tiers", "backends", "pareto", GROWTH, CELLS)
"""Names of presets, known before JAX is loaded."""
REFUSED = {GROWTH: ("search", "workers", "scheduler", "error"), CELLS: ("search", "error")}
"""Options that do not suit a preset."""
CYCLES = 800
"""Cycles of the session that `size` tries settings on."""
FEWEST_CYCLES = 50
"""Least number of those cycles; in fewer, no place is recognised."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables for the number of threads of NumPy."""


def add_commands(commands: Commands) -> None:
    """Registers the commands of this module."""
    does = "run many configurations over seeds and compare them"
    study = commands.add("study", _study, does, "study study_maze", "study")
    add_config(study, "study file, or a configuration with --preset (YAML)")
    study.add_argument("--preset", choices=PRESETS, help="make the study from a configuration")
    tune = "search parameters by the study's `tune` section"
    study.add_argument("--search", action="store_true", help=tune)
    study.add_argument(
        "--workers", type=positive_integer, metavar="N",
        help="Dask processes (default: one per core; 1 without Dask, and 1 with `report: pareto`, so that no "
        "run disturbs the timing of another)",
    )  # fmt: skip
    study.add_argument("--scheduler", metavar="tcp://HOST:PORT", help="Dask scheduler to use instead")
    study.add_argument(
        "-o", "--output", type=Path, metavar="DIR",
        check=partial(require_own_folder, marks=["runs.jsonl", "growth.jsonl", "sets"]),
        help="folder of records and tables; recorded runs are not repeated (default runs/STUDY)",
    )  # fmt: skip
    error = "error on the Pareto front: em, ate, exm, map, ... or a scorecard quantity"
    study.add_argument("--error", metavar="NAME", help=error)
    share = "share by which --preset vary changes a number (default 0.2)"
    study.add_argument("--by", type=float, default=0.2, metavar="SHARE", help=share)
    length = "length of a session of --preset tiers, s (default 600)"
    study.add_argument("--seconds", type=float, default=600.0, metavar="S", help=length)

    size = commands.add("size", _size, "recommend settings for a scene", "size whisker_maze", "study")
    add_config(size)
    length = f"length of the trial session (default {CYCLES})"
    size.add_argument("--cycles", type=positive_integer, default=CYCLES, metavar="N", help=length)


class _Progress(AbstractContextManager["_Progress"]):
    """A progress bar over runs, which collects the failed ones.

    Args:
        total: number of runs. path: of the file of records. unit: name of a run.
    """

    def __init__(self, total: int | None, path: Path, unit: str = "run") -> None:
        self.failed: list[Any] = []
        self._path = path
        from tqdm import tqdm

        self._bar = tqdm(total=total, unit=unit, file=sys.stderr, mininterval=0.5, delay=1.0)

    def __call__(self, record: Any) -> None:
        """Counts a run."""
        if record.error is not None:
            self.failed.append(record)
        self.count(1)

    def count(self, runs: int) -> None:
        """Counts runs that did not fail."""
        self._bar.update(runs)

    def __exit__(self, kind: type[BaseException] | None, *details: object) -> None:
        self._bar.close()
        if kind is KeyboardInterrupt:
            tell(f"{self._bar.n} {self._bar.unit}s are kept in {self._path}; the same command continues")

    def report_failures(self) -> int:
        """Prints the failed runs; returns the exit code."""
        from evaluation.studies.study_report import label

        for record in self.failed:
            copy = f", copy {record.copy_number}" if record.copy_number else ""
            where = f"{label(record.row, record.varied)}, seed {record.seed}{copy}"
            for line in record.error.splitlines():
                print(f"ratslam: error: {where}: {line}", file=sys.stderr)
        if self.failed:
            tell(f"{len(self.failed)} runs failed; delete their lines in {self._path} to repeat them")
        return INPUT_ERROR if self.failed else 0


def _prepare() -> None:
    """Prepares JAX; limits NumPy to one thread in this process and its workers, so that results are equal.

    Call it before NumPy is loaded.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")
    prepare_jax()


def _study(arguments: argparse.Namespace) -> int:
    _prepare()
    for option in REFUSED.get(arguments.preset, ()):
        if getattr(arguments, option):
            preset = arguments.preset
            expected = "no search" if preset == CELLS else "one session at a time, without search"
            raise InputError(f"--{option}", f"with --preset {preset}", expected, "leave it out")
    if arguments.preset == GROWTH:
        return _growth(arguments)
    if arguments.preset == CELLS:
        return _cells(arguments)
    from evaluation.studies.executor import Executor
    from evaluation.studies.metrics import find_error
    from evaluation.studies.parameter_search import search, search_plan
    from evaluation.studies.presets import preset_study
    from evaluation.studies.run_job import RunLog, measure_jobs, run_jobs
    from evaluation.studies.study import read_study
    from evaluation.studies.study_report import make_report, render, save_report

    remarks: list[str] = []
    if arguments.preset:
        config, changes = find_config(arguments.config), {"by": arguments.by, "seconds": arguments.seconds}
        study, remarks = preset_study(arguments.preset, config, arguments.set, **changes)
    else:
        study = read_study(find_config(arguments.config), arguments.set)
    error, plan = find_error(arguments.error) if arguments.error else None, study.plan
    runs = len({job.key for job in study.jobs})
    if searching := arguments.search:
        runs = search_plan(study).trials * len(plan.every_seed()) * max(plan.copies, 1)
    alone = plan.report == "pareto" and arguments.scheduler is None and arguments.workers in (None, 1)
    log = RunLog(_folder(arguments, study.name, "runs.jsonl"))
    with _Progress(runs, log.path) as progress, Executor(arguments.workers, arguments.scheduler) as executor:
        if searching:
            records = search(study, log, executor, progress)
        elif alone:
            records = measure_jobs(study.jobs, log, progress)
        else:
            records = list(run_jobs(study.jobs, log, executor, progress))
    report = make_report(study.name, plan, records, error, searching)
    report = replace(report, remarks=[*report.remarks, *remarks])
    paths = save_report(report, log.path.parent)
    print(render(report))
    print(f"\n{log.path} holds every run, {', '.join(path.name for path in paths)} the table")
    if not searching:
        return progress.report_failures()
    if any(row.optimal for row in report.rows):
        return 0
    print("ratslam: error: no trial has a value of every objective", file=sys.stderr)
    return progress.report_failures() or INPUT_ERROR


def _folder(arguments: argparse.Namespace, name: str, mark: str) -> Path:
    """The folder of a study, which is new or has the mark of an earlier call."""
    folder: Path = arguments.output or Path("runs") / name
    require_own_folder(folder, [mark])
    return folder


def _growth(arguments: argparse.Namespace) -> int:
    from evaluation.studies.growth import growth_study, read_rows, render_growth, run_growth, save_growth

    name, tasks = growth_study(find_config(arguments.config), arguments.set)
    folder = _folder(arguments, name, "growth.jsonl")
    require_new_file(folder / "growth.jsonl", parents=True)
    try:
        run_growth(tasks, folder)
    finally:  # an interrupted study has the table of what it measured
        if rows := read_rows(folder):
            paths = save_growth(name, rows, folder)
            print(render_growth(rows))
            print(f"\n{folder} holds {', '.join(path.name for path in paths)}")
    return 0


def _cells(arguments: argparse.Namespace) -> int:
    from evaluation.studies.cell_study import FOLDER, cell_study, render_cells, run_cell_study, save_cells
    from evaluation.studies.executor import Executor

    study = cell_study(find_config(arguments.config), arguments.set)
    folder = _folder(arguments, study.name, "sets")
    progress = _Progress(study.plan.sets, folder / FOLDER, "set")
    with progress, Executor(arguments.workers, arguments.scheduler) as executor:
        scores = run_cell_study(study, folder, executor, progress.count)
    paths = save_cells(study, scores, folder)
    print(render_cells(study, scores))
    print(f"\n{folder} holds {', '.join(path.name for path in paths)}")
    return 0


def _size(arguments: argparse.Namespace) -> None:
    if arguments.cycles < FEWEST_CYCLES:
        raise InputError("--cycles", str(arguments.cycles), f"{FEWEST_CYCLES} or more")
    _prepare()
    from evaluation.studies import recommendation as advice
    from evaluation.studies.scene_statistics import scene_of, with_tier
    from ratslam.runs.build_session import open_source
    from ratslam.runs.settings.completion import complete

    path, config = arguments.config, read_config(arguments)
    with open_source(with_tier(config, "kinematic")) as source:
        scene, config = scene_of(source), complete(config, source)
    found = advice.recommend(config, scene)
    print("trial runs take a minute or two, and several on a busy machine", flush=True)
    print(f"{scene.describe()}\n\n{advice.render_recommendations(found)}\n", flush=True)
    runs = advice.try_settings(config, found, arguments.cycles)
    print(f"Cost of each cheaper step, over {runs[0].steps} of {scene.cycles} cycles, one seed:\n")
    print(advice.render_trial_runs(runs))
    text = advice.changed_settings_yaml(found)
    print(f"\nFor {path.name}:\n\n{text}" if text else f"\n{path.name} has these settings already")
