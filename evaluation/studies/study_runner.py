"""Runs the jobs of a study; a job with a record is not run again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from evaluation.studies.executor import Executor
from evaluation.studies.records import RunLog, RunRecord, record_of
from evaluation.studies.resources import one_core
from evaluation.studies.run_job import run_job, run_job_alone
from evaluation.studies.study import Job

KILLED = "its process was killed, for lack of memory for example"
Done = Callable[[RunRecord], object]


def run_jobs(
    jobs: Sequence[Job],
    log: RunLog,
    executor: Executor,
    done: Done | None = None,
    function: Callable[[Job], RunRecord] | None = None,
) -> Iterator[RunRecord]:
    """Yields the records of all jobs in their order; each is on disk before.

    Args:
        log: records of earlier calls; new ones are added, except of a killed process: the next call runs its
            job again. done: called with each record in the order of completion, once for each key.
        function: runs a job; default `run_job`.
    """
    found, done = dict(log.records), done or (lambda record: None)
    killed = partial(record_of, error=KILLED)
    wanted: dict[str, Job] = {}
    for job in jobs:
        wanted.setdefault(job.key, job)
    missing = [job for key, job in wanted.items() if key not in found]
    for key in filter(found.get, wanted):
        done(_labelled(found[key], wanted[key]))
    with closing(executor.completed(function or run_job, missing, killed)) as completed:
        for job in jobs:
            while job.key not in found:
                _, record = next(completed)
                if record.error != KILLED:
                    ran = record.machine and record.machine.model_copy(update={"workers": executor.processes})
                    record = record.model_copy(update={"machine": ran})
                    log.append(record)
                found[record.key] = record
                done(_labelled(record, wanted[record.key]))
            yield _labelled(found[job.key], job)


def measure_jobs(jobs: Sequence[Job], log: RunLog, done: Done | None = None) -> list[RunRecord]:
    """The records of all jobs, measured one at a time on one core, each in a process of its own.

    Jobs run seed by seed, so that a disturbance of the machine spreads over all configurations. Only the
    first run of a configuration compiles its kernels.
    """
    order = sorted(range(len(jobs)), key=lambda k: (jobs[k].seed, jobs[k].copy_number))
    with TemporaryDirectory(ignore_cleanup_errors=True) as kernels, one_core(), Executor(fresh=True) as fresh:
        alone = partial(run_job_alone, Path(kernels))
        records = dict(zip(order, run_jobs([jobs[k] for k in order], log, fresh, done, alone), strict=True))
    return [records[k] for k in range(len(jobs))]


def _labelled(record: RunRecord, job: Job) -> RunRecord:
    """The record under this job's row: several rows may have the same configuration."""
    return record.model_copy(update={"row": job.row, "varied": job.varied})
