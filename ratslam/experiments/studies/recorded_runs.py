"""Runs the jobs of a study and records their results; a job with a recorded result is not run again."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from types import TracebackType
from typing import Self

from ratslam.experiments.studies.executor import DEATHS, Executor
from ratslam.experiments.studies.results import Result, read_result, write_result
from ratslam.experiments.studies.run_job import run_job
from ratslam.experiments.studies.study import Job, made

KILLED = "its process was killed"
FOLDER = "results"
"""Where in a study's directory the results are."""


class Pool:
    """Processes that may be asked more than once; they start when they are needed first.

    Args:
        workers: how many; 0: as many as there are cores; 1: the work is done in this process. scheduler:
            address of a Dask scheduler that has workers, instead. most: jobs that are asked for at once.
    """

    def __init__(self, workers: int = 0, scheduler: str | None = None, most: int = 0) -> None:
        self._executor = Executor(workers, scheduler, most)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._executor.__exit__(kind, error, trace)

    def results(
        self, jobs: Sequence[Job], directory: Path, done: Callable[[Result], None] | None = None
    ) -> Iterator[Result]:
        """See `results`."""
        folder = directory / FOLDER
        made(folder)
        wanted = {job.key: job for job in reversed(jobs)}  # of equal ones, the first
        found = {key: kept for key in wanted if (kept := read_result(folder, key)) is not None}
        missing = [job for key, job in reversed(wanted.items()) if key not in found]
        if done:
            for key, result in found.items():
                done(_named(result, wanted[key]))
        with closing(self._fresh(missing, folder)) as fresh:
            for job in jobs:
                while job.key not in found:
                    result = next(fresh)
                    found[result.key] = result
                    if done:
                        done(_named(result, wanted[result.key]))
                yield _named(found[job.key], job)

    def _fresh(self, jobs: Sequence[Job], folder: Path) -> Generator[Result, None, None]:
        """Results as they come, each on disk if it is worth keeping."""
        for _, result in self._executor.completed(run_job, jobs, _killed):
            if result.error is None or not result.error.startswith(KILLED):
                count = {"workers": self._executor.processes}
                machine = result.machine and result.machine.model_copy(update=count)
                result = result.model_copy(update={"machine": machine})
                write_result(folder, result)
            yield result


def results(
    jobs: Sequence[Job],
    directory: Path,
    workers: int = 0,
    scheduler: str | None = None,
    done: Callable[[Result], None] | None = None,
) -> Iterator[Result]:
    """The results of all jobs, in their order. Each is on disk before it is told.

    Args:
        directory: results are kept in `results` there, and taken from there. workers: processes; 0: as many
            as there are cores; 1: this one. scheduler: address of a Dask scheduler with workers, instead.
        done: told of each result as soon as it is there, whichever is first; of the same key only once.

    Raises:
        InputError: the directory cannot be made, Dask is missing, or no scheduler answers.
    """
    with Pool(workers, scheduler) as pool:
        yield from pool.results(jobs, directory, done)


def _named(result: Result, job: Job) -> Result:
    """Another study, or another row of this one, may have the same configuration under another name."""
    return result.model_copy(update={"row": job.row, "varied": job.varied})


def _killed(job: Job) -> Result:
    """For now: it is not kept, so that it is tried again another time."""
    error = f"{KILLED} {DEATHS + 1} times, for want of memory say; ask for fewer --workers"
    return Result(hash=job.hash, seed=job.seed, row=job.row, varied=job.varied, error=error)
