"""Jobs run so that their times can be believed: one after another on one core, each configuration in a
process of its own, so that its memory is its own and its kernels are compiled anew."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

from ratslam.experiments.pareto.cpu_affinity import one_core, others
from ratslam.experiments.studies.recorded_runs import FOLDER, results
from ratslam.experiments.studies.results import Result, read_result
from ratslam.experiments.studies.study import Job, made

Done = Callable[[Result], None]


class Measured(NamedTuple):
    """Attributes:
    results: in the order of the jobs. fresh: how many were run now. others: cores that other processes kept
        busy meanwhile; None where nobody knows.
    """

    results: list[Result]
    fresh: int
    others: float | None


def measured(jobs: Sequence[Job], directory: Path, workers: int = 1, done: Done | None = None) -> Measured:
    """The results of all jobs; what is in the directory already is not run again.

    Args:
        workers: processes at once. With more than one, times disturb each other.
        done: told of each result, of the same key only once.

    Raises:
        InputError: the directory cannot be made, or Dask is missing for several workers.
    """
    made(directory / FOLDER)
    wanted = {job.key: job for job in jobs}
    missing = [job for key, job in wanted.items() if read_result(directory / FOLDER, key) is None]
    with others() as busy:
        if workers > 1:
            found = list(results(jobs, directory, workers, None, done))
        else:
            found = _one_by_one(jobs, missing, directory, done)
        return Measured(found, len(missing), busy() if missing else None)


def _one_by_one(
    jobs: Sequence[Job], missing: Sequence[Job], directory: Path, done: Done | None
) -> list[Result]:
    wanted = {job.key: job for job in jobs}
    rows = {job.hash: [each for each in missing if each.hash == job.hash] for job in missing}
    known = [wanted[key] for key in wanted.keys() - {job.key for job in missing}]
    found: dict[str, Result] = {}
    with one_core():
        for row in [known, *rows.values()]:
            if row is not known:
                _alone(row, directory)
            found |= {job.key: read_result(directory / FOLDER, job.key) or _killed(job) for job in row}
            for job in row:
                if done:
                    done(_named(found[job.key], job))
    return [_named(found[job.key], job) for job in jobs]


def _alone(row: Sequence[Job], directory: Path) -> None:
    """Runs the jobs of one configuration in a new process; each leaves its file."""
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as kernels,
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
        suppress(BrokenProcessPool),  # it was killed; what it had done is there
    ):
        pool.submit(_run, pickle.dumps(list(row)), directory, kernels).result()


def _run(packed: bytes, directory: Path, kernels: str) -> None:
    """In the new process: what one seed compiles, the others fetch; nothing is there from elsewhere."""
    import jax

    jax.config.update("jax_compilation_cache_dir", kernels)
    for _ in results(pickle.loads(packed), directory, workers=1):
        pass


def _named(result: Result, job: Job) -> Result:
    """Another row of the study may have the same configuration."""
    return result.model_copy(update={"row": job.row, "varied": job.varied})


def _killed(job: Job) -> Result:
    """Not kept, so that it is tried again another time."""
    return Result(hash=job.hash, seed=job.seed, error="its process was killed, for want of memory say")
