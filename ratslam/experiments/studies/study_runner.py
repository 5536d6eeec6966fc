"""Runs the jobs of a study; a job with a record is not run again."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

from ratslam.experiments.studies.environment import one_core
from ratslam.experiments.studies.executor import Executor
from ratslam.experiments.studies.records import RunLog, RunRecord
from ratslam.experiments.studies.run_job import run_job, run_job_alone
from ratslam.experiments.studies.study import Job

KILLED = "its process was killed, for lack of memory for example"
Done = Callable[[RunRecord], object]


def run_jobs(
    jobs: Sequence[Job], log: RunLog, executor: Executor, done: Done | None = None
) -> Iterator[RunRecord]:
    """Yields the records of all jobs in their order; each is on disk before.

    Args:
        log: records of earlier calls; new ones are added.
        done: called with each record in the order of completion, once for each key.
    """
    missing, wanted = _missing(jobs, log, done), _first_of_each_key(jobs)
    with closing(executor.completed(run_job, missing, _killed)) as completed:
        found = dict(log.records)
        for job in jobs:
            while job.key not in found:
                _, record = next(completed)
                found[record.key] = record = _keep(record, log, executor.processes)
                if done:
                    done(_named(record, wanted[record.key]))
            yield _named(found[job.key], job)


def measure_jobs(jobs: Sequence[Job], log: RunLog, done: Done | None = None) -> list[RunRecord]:
    """The records of all jobs, measured one at a time on one core, each in a process of its own.

    Jobs run seed by seed, so that a disturbance of the machine spreads over all configurations. Only the
    first run of a configuration compiles its kernels.
    """
    missing = sorted(_missing(jobs, log, done), key=lambda job: (job.seed, job.copy_number))
    found = dict(log.records)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as kernels, one_core():
        tasks = [(job, Path(kernels) / job.hash) for job in missing]
        with Executor(fresh=True) as executor:
            for _, record in executor.completed(run_job_alone, tasks, lambda task: _killed(task[0])):
                found[record.key] = _keep(record, log, 1)
                if done:
                    done(record)
    return [_named(found[job.key], job) for job in jobs]


def _missing(jobs: Sequence[Job], log: RunLog, done: Done | None) -> list[Job]:
    """The jobs without a record, each key once."""
    wanted = _first_of_each_key(jobs)
    if done:
        for key, job in wanted.items():
            if key in log.records:
                done(_named(log.records[key], job))
    return [job for key, job in wanted.items() if key not in log.records]


def _first_of_each_key(jobs: Sequence[Job]) -> dict[str, Job]:
    wanted: dict[str, Job] = {}
    for job in jobs:
        wanted.setdefault(job.key, job)
    return wanted


def _keep(record: RunRecord, log: RunLog, processes: int) -> RunRecord:
    """Adds a record to the log, unless its process was killed: then the next call tries again."""
    if record.error != KILLED:
        ran = record.machine and record.machine.model_copy(update={"workers": processes})
        record = record.model_copy(update={"machine": ran})
        log.append(record)
    return record


def _named(record: RunRecord, job: Job) -> RunRecord:
    """The record under this job's row: several rows may have the same configuration."""
    return record.model_copy(update={"row": job.row, "varied": job.varied})


def _killed(job: Job) -> RunRecord:
    return RunRecord(
        hash=job.hash,
        seed=job.seed,
        copy_number=job.copy_number,
        row=job.row,
        varied=job.varied,
        error=KILLED,
    )
