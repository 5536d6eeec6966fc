"""Studies of short sessions, and runs without sessions."""

import json
import os
import subprocess
from collections.abc import Callable, Iterable
from pathlib import Path

import jax
import pytest

from evaluation.metrics.metric import Quantity
from evaluation.studies.machine import machine
from evaluation.studies.run_job import RunRecord
from evaluation.studies.study import Job
from tests.helpers.live import until

PATIENCE = 240.0
TINY = {
    "simulation.maze": {"columns": 3, "rows": 2, "loop": 6},
    "simulation.path": {"circuits": "C"},
    "simulation.whisking.rate": 0.5,
    "pose_cells.cells_xy": 11,
    "pose_cells.cells_heading": 12,
    "backend": "classic",
}
"""Some 40 whisks."""


def preset(name: str, config: Path, assignments: Iterable[str], output: Path) -> list[str]:
    given = [part for each in assignments for part in ("--set", each)]
    return ["study", "--preset", name, str(config), *given, "-o", str(output)]


def wait_until(ready: Callable[[], object], process: subprocess.Popen[str]) -> None:
    until(lambda: ready() or process.poll() is not None, seconds=PATIENCE)
    assert ready(), process.communicate()


def kill(process: subprocess.Popen[str], number: int) -> tuple[str, str]:
    """Sends a signal to the program and its workers; its output."""
    os.killpg(process.pid, number)
    return process.communicate(timeout=PATIENCE)


def record(row="", seed=0, time=100.0, error=None, varied=None, odometry=None, hash=None, **values):
    told = {"unit": "", "odometry": odometry}
    quantities = {name: Quantity(label=name, value=value, **told) for name, value in values.items()}
    measured = {"step_time": time, "step_time_p99": 2 * time, "run_time": 3 * time, "compile_time": 1.0}
    return RunRecord(
        hash=hash or row or "none", seed=seed, row=row, varied=varied or {}, steps=10, quantities=quantities,
        measured=measured | {"memory": 400.0}, error=error, machine=machine(),
    )  # fmt: skip


@pytest.fixture(autouse=True)
def shared_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Worker processes fetch the kernels that this process has compiled."""
    for name in ("compilation_cache_dir", "persistent_cache_min_compile_time_secs",
                 "persistent_cache_min_entry_size_bytes"):  # fmt: skip
        monkeypatch.setenv(f"JAX_{name.upper()}", str(getattr(jax.config, f"jax_{name}")))


@pytest.fixture
def tiny(tmp_path: Path) -> Callable[..., Path]:
    def write(**content: object) -> Path:
        (tmp_path / "base.yaml").write_text("simulation: {}\n")
        path = tmp_path / "study.yaml"
        settings = TINY | dict(content.pop("set", {}))  # type: ignore[call-overload]
        path.write_text(json.dumps({"base": "base.yaml", "set": settings, **content}))
        return path

    return write


@pytest.fixture
def stubbed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replaces runs by records that follow from settings and seed; the keys of the runs."""
    keys: list[str] = []

    def run_job(job: Job) -> RunRecord:
        keys.append(job.key)
        score = job.config.keyframes.min_score
        values = {"error": "keyframes.min_score: too much"}
        if score <= 40:
            arr = 1 / (1 + abs(score - 12) + job.config.recall.guard)
            values = {"energy_all": (score - 7) ** 2 + job.seed, "exm_arr": arr}
        found = record(time=1000 / score, seed=job.seed, hash=job.hash, **values)
        return found.model_copy(update={"copy_number": job.copy_number})

    monkeypatch.setattr("evaluation.studies.run_job.run_job", run_job)
    return keys
