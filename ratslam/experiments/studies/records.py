"""The record of a run, and the file of a study that holds one record a line."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from pydantic import Field

from evaluation.metrics.metric import Quantity
from tactile.base.config import Settings
from tactile.base.errors import InputError

FILE = "runs.jsonl"
"""Name of the file of records in a study's directory."""


class Timing(Settings):
    """Duration of a run's parts; None where too few steps were taken to measure it."""

    pace: str
    """`live`: steps were taken one at a time; `replay`: a chunk at a time."""
    median_us: float | None
    """Median time per step once compiled, microseconds."""
    p99_us: float | None
    """99 % quantile of the time per step, over steps if live, else over chunks, microseconds."""
    compile_s: float
    """Time spent on compiling, without the steps themselves, s."""
    compilations: int
    """Number of kernels compiled or fetched from the cache on disk."""
    finish_s: float
    """Time for the final map, s."""
    total_s: float
    """Time of the whole run including simulation and scoring, s."""

    def values(self, steps: int) -> dict[str, float | None]:
        """The times by their names in `studies.metrics`."""
        whole = 1e6 * max(self.total_s - self.compile_s, 0.0) / steps if steps else None
        times = self.median_us, self.p99_us, whole, self.compile_s
        return dict(zip(("step_time", "step_time_p99", "run_time", "compile_time"), times, strict=True))


class Machine(Settings):
    """Where a run was computed."""

    processor: str
    """Name of the processor."""
    device: str
    """Device of the kernels: `cpu`, or the name of an accelerator."""
    versions: dict[str, str]
    """Versions of what decides the speed."""
    build: str
    """First digits of the sha256 of ratslam's code."""
    workers: int = 1
    """Number of processes that shared the work."""
    other_load: float | None = None
    """Number of cores that other processes kept busy meanwhile; None where the system does not say."""


class RunRecord(Settings):
    """Outcome of one run. `quantities` and `steps` do not depend on the machine; the rest does."""

    hash: str
    """Hash of the configuration without its seed."""
    seed: int
    """Seed of the simulation or session."""
    copy_number: int = 0
    """Seed of the perturbed copy of the session; 0: the session itself."""
    row: str = ""
    """Name of the study's row."""
    varied: dict[str, Any] = Field(default_factory=dict)
    """Combination of the varied settings, by key path."""
    steps: int = 0
    """Number of observations."""
    source: str = ""
    """Digest of the session."""
    quantities: dict[str, Quantity] = Field(default_factory=dict)
    """Scored quantities by name."""
    timing: Timing | None = None
    """Duration."""
    memory: float | None = None
    """Peak memory, MiB: of this run where the peak can be reset (Linux), else of the process so far."""
    machine: Machine | None = None
    """Where it was computed."""
    error: str | None = None
    """Why there is no outcome."""

    @property
    def key(self) -> str:
        """Identifies the run: two runs with one key are the same."""
        return run_key(self.hash, self.seed, self.copy_number)

    def value(self, name: str) -> float | None:
        """A quantity by any name of `studies.metrics`; None if the run has none."""
        if name in self.quantities:
            return self.quantities[name].value
        if name == "memory":
            return self.memory
        return self.timing.values(self.steps).get(name) if self.timing else None


def run_key(hash: str, seed: int, copy_number: int) -> str:
    """The key of a run."""
    return f"{hash}-{seed}-{copy_number}" if copy_number else f"{hash}-{seed}"


class RunLog:
    """The records in a directory. A kill loses at most the record that was being written.

    Args:
        directory: is created if missing.

    Raises:
        InputError: the directory cannot be created.
    """

    def __init__(self, directory: Path) -> None:
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            found = f"cannot be made ({error.strerror})"
            raise InputError(str(directory), found, "a folder to write to") from None
        self.path = directory / FILE
        self.records: dict[str, RunRecord] = {}
        lines = self.path.read_bytes().splitlines() if self.path.exists() else []
        for line in lines:
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
