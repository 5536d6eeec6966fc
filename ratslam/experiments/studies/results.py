"""What a job leaves behind: one file, written whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field

from evaluation.metrics.metric import Quantity
from ratslam.experiments.studies.metrics import MEASURED
from tactile.base.atomic_write import flush_to_disk, write_atomically
from tactile.base.config import Settings


class Timing(Settings):
    """How long it took; None where too few steps were taken to tell."""

    pace: str
    """Whether steps were taken one at a time (`live`) or a chunk at a time (`replay`)."""
    median_us: float | None
    """Of the time per step once compiled, microseconds."""
    p99_us: float | None
    """Its 99 % quantile, over steps if live, else over chunks."""
    compile_s: float
    """Spent on compiling, beyond what the steps themselves took, s."""
    compilations: int
    """Kernels compiled, or fetched from the lasting cache."""
    finish_s: float
    """For the final map, s."""
    total_s: float
    """All in all, simulating and judging included, s."""


class Memory(Settings):
    """How much memory a job took, MiB."""

    peak: float
    """Most that the process held."""
    before: float
    """What it held before the job."""
    exact: bool
    """Whether the peak is this job's, not of all that the process did before."""


class Machine(Settings):
    """Where a job ran."""

    processor: str
    """Its name."""
    device: str
    """Where kernels ran: cpu, or the name of an accelerator."""
    versions: dict[str, str]
    """Of what counts for speed."""
    build: str
    """sha256 of ratslam's own code, its beginning."""
    workers: int = 1
    """Jobs that ran at once."""


class Result(Settings):
    """A job's answer. `quantities` and `steps` are the same wherever it ran; the rest was measured."""

    hash: str
    """Of the configuration without its seed."""
    seed: int
    """Of what was simulated."""
    row: str = ""
    """The study's name for it."""
    varied: dict[str, Any] = Field(default_factory=dict)
    """The combination."""
    steps: int = 0
    """Observations."""
    source: str = ""
    """Digest of what was run on."""
    quantities: dict[str, Quantity] = Field(default_factory=dict)
    """What was scored, by name."""
    timing: Timing | None = None
    """How fast."""
    memory: Memory | None = None
    """How large."""
    machine: Machine | None = None
    """Where."""
    error: str | None = None
    """Why there is nothing of all that."""

    @property
    def key(self) -> str:
        """The name of its file."""
        return f"{self.hash}-{self.seed}"

    def value(self, name: str) -> float | None:
        """A quantity by any name of `ratslam.experiments.studies.metrics`; None where there is none."""
        if name in MEASURED:
            return self._measured().get(name)
        return self.quantities[name].value if name in self.quantities else None

    def _measured(self) -> dict[str, float | None]:
        found: dict[str, float | None] = {}
        if self.timing:
            found["step_time"], found["step_time_p99"] = self.timing.median_us, self.timing.p99_us
            found["compile_time"] = self.timing.compile_s
        if self.memory:
            found["memory"] = self.memory.peak
        return found


def read_result(folder: Path, key: str) -> Result | None:
    """The result of that key; None where there is none, or only a part or something else."""
    try:
        result = Result.model_validate_json((folder / f"{key}.json").read_bytes())
    except (FileNotFoundError, ValueError):
        return None
    return result if result.key == key else None


def write_result(folder: Path, result: Result) -> None:
    """Leaves a result under its key: whoever looks finds all of it or nothing."""

    def write(path: Path) -> None:
        path.write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")
        flush_to_disk(path)

    write_atomically(folder / f"{result.key}.json", write)
