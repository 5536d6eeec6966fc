"""The record of a run, and the file of a study that holds one record a line."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pydantic import Field

from evaluation.metrics.metric import Quantity
from evaluation.studies.machine import Machine
from evaluation.studies.study import Job, run_key
from tactile.base.errors import os_errors_of
from tactile.base.settings import Settings

FILE = "runs.jsonl"  # name of the file of records in a study's directory


class RunRecord(Settings):
    """Outcome of one run. `quantities` and `steps` do not depend on the machine; the rest does."""

    hash: str  # hash of the configuration without its seed
    seed: int  # seed of the simulation or session
    copy_number: int = 0  # seed of the perturbed copy of the session; 0: the session itself
    row: str = ""  # name of the study's row
    varied: dict[str, Any] = Field(default_factory=dict)  # combination of the varied settings, by key path
    steps: int = 0  # number of observations
    source: str = ""  # digest of the session
    quantities: dict[str, Quantity] = Field(default_factory=dict)  # scored quantities by name
    measured: dict[str, float | None] = Field(default_factory=dict)  # by names of `metrics.MEASURED`
    machine: Machine | None = None  # where it was computed
    error: str | None = None  # why there is no outcome

    @property
    def key(self) -> str:
        """Identifies the run: two runs with one key are the same."""
        return run_key(self.hash, self.seed, self.copy_number)

    def value(self, name: str) -> float | None:
        """A quantity by its name in `metrics.METRICS`; None if the run has none."""
        return self.quantities[name].value if name in self.quantities else self.measured.get(name)

    def odometry(self, name: str) -> float | None:
        """A quantity of raw odometry; None if the run has none."""
        return self.quantities[name].odometry if name in self.quantities else None


def record_of(job: Job, error: str | None = None, machine: Machine | None = None) -> RunRecord:
    """The record of a job without an outcome."""
    names = {name: getattr(job, name) for name in ("hash", "seed", "copy_number", "row", "varied")}
    return RunRecord(**names, error=error, machine=machine)


class RunLog:
    """The records in a directory. A kill loses at most the record that was being written.

    Args:
        directory: is created if missing; an `InputError` says that it cannot be.
    """

    def __init__(self, directory: Path) -> None:
        with os_errors_of(directory, "cannot be made", "a folder to write to"):
            directory.mkdir(parents=True, exist_ok=True)
        self.path = directory / FILE
        self.records: dict[str, RunRecord] = {}
        for line in self.path.read_bytes().splitlines() if self.path.exists() else []:
            try:
                record = RunRecord.model_validate_json(line)
            except ValueError:  # cut off by a kill
                continue
            self.records[record.key] = record

    def append(self, record: RunRecord) -> None:
        """Adds a record; it is on disk when this returns."""
        with self.path.open("ab+") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 1, 0))
            cut_off = size > 0 and file.read(1) != b"\n"
            # One write: two studies may append to one file.
            file.write(b"\n" * cut_off + record.model_dump_json().encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        self.records[record.key] = record
