"""The command on studies: sweep, and with it tuning on several objectives."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tqdm import tqdm

from ratslam.cli.common import INPUT_ERROR, Commands, add_set, add_workers, prepare_jax

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""How many threads NumPy sums with."""


def add_commands(commands: Commands) -> None:
    """Registers it."""
    sweep = commands.add(
        "sweep", _sweep, "run the configurations of a study over seeds, or tune",
        "sweep configs/study_maze.yaml", "study",
    )  # fmt: skip
    sweep.add_argument("study", help="the YAML file")
    add_set(sweep)
    add_workers(sweep)
    sweep.add_argument(
        "--scheduler", metavar="tcp://HOST:PORT", help="of Dask, that has workers, instead of processes here"
    )
    sweep.add_argument(
        "-o", "--output", type=Path, metavar="DIR",
        help="where results are kept, and taken from if they are there (default runs/<study>)",
    )  # fmt: skip
    sweep.add_argument("--tune", action="store_true", help="choose parameters as the study's `tune` says")


class Progress:
    """A bar for the runs of a study; it hears of each that is done, and keeps what failed.

    Args:
        total: runs. directory: of their results.
    """

    def __init__(self, total: int | None, directory: Path) -> None:
        self.failed: list[Any] = []
        self._directory = directory
        self._bar = tqdm(
            total=total, unit="run", desc=directory.name, file=sys.stderr, mininterval=0.5, delay=1.0
        )

    def __enter__(self) -> Self:
        return self

    def __call__(self, result: Any = None) -> None:
        """A run is done; without its result if that was not looked at."""
        if result is not None and result.error is not None:
            self.failed.append(result)
        self._bar.update()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()
        if kind is KeyboardInterrupt:
            print(
                f"ratslam: {self._bar.n} runs are kept in {self._directory}; the same command goes on",
                file=sys.stderr,
            )

    def told(self) -> int:
        """Says what failed; the exit code."""
        from ratslam.experiments.studies.report import label

        for result in self.failed:
            where = f"{label(result.row, result.varied)}, seed {result.seed}"
            for line in result.error.splitlines():
                print(f"ratslam: error: {where}: {line}", file=sys.stderr)
        if self.failed:
            print(
                f"ratslam: {len(self.failed)} runs failed; where that is kept in "
                f"{self._directory}, remove the file there to try again",
                file=sys.stderr,
            )
        return INPUT_ERROR if self.failed else 0


def settle_threads() -> None:
    """One thread for NumPy, as workers have, so that results are the same; call it before NumPy loads."""
    for name in THREADS:
        os.environ.setdefault(name, "1")


def _sweep(arguments: argparse.Namespace) -> int:
    settle_threads()
    prepare_jax()
    from ratslam.experiments.studies.study import read_study

    study = read_study(arguments.study, arguments.set)
    directory = arguments.output or Path("runs") / study.name
    return (_tune if arguments.tune else _table)(arguments, study, directory)


def _table(arguments: argparse.Namespace, study: Any, directory: Path) -> int:
    from ratslam.experiments.studies.recorded_runs import FOLDER, results
    from ratslam.experiments.studies.report import remarks, rows, save, table
    from ratslam.experiments.studies.study import jobs

    asked = jobs(study)
    with Progress(len({job.key for job in asked}), directory / FOLDER) as progress:
        found = list(results(asked, directory, arguments.workers, arguments.scheduler, progress))
    lines = rows(found)
    paths = save(lines, directory)
    print("\n\n".join([table(lines), *remarks(found, directory / FOLDER)]))
    print(f"\n{paths[0]} and {paths[1].name} hold all quantities, {directory / FOLDER} every run")
    return progress.told()


def _tune(arguments: argparse.Namespace, study: Any, directory: Path) -> int:
    from ratslam.experiments.studies.recorded_runs import FOLDER
    from ratslam.experiments.studies.tuning import report, save, tune

    plan = study.plan
    total = plan.tune and plan.tune.trials * len(plan.every_seed())
    with Progress(total, directory / FOLDER) as progress:
        trials = tune(study, directory, arguments.workers, arguments.scheduler, progress)
    print(report(trials))
    print(f"\n{save(trials, directory)} holds all trials; the same command with more of them goes on")
    if any(trial.values for trial in trials):
        return 0
    print("ratslam: error: no trial has a value of every objective", file=sys.stderr)
    return progress.told() or INPUT_ERROR
