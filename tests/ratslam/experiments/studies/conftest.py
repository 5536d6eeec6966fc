"""Studies of sessions that take a moment, and jobs that take none."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from evaluation.metrics.metric import Quantity
from ratslam.experiments.studies.results import Result
from ratslam.experiments.studies.study import Job

TINY = {
    "simulation.maze": {"columns": 3, "rows": 2, "loop": 6},
    "simulation.path": {"circuits": "C"},
    "simulation.whisking.rate": 0.5,
    "pose_cells.cells_xy": 11,
    "pose_cells.cells_heading": 12,
    "backend": "classic",
}
"""Some 40 whisks."""


@pytest.fixture
def tiny(tmp_path: Path) -> Callable[..., Path]:
    """Writes a study of tiny sessions."""

    def write(**content: object) -> Path:
        (tmp_path / "base.yaml").write_text("simulation: {}\n")
        path = tmp_path / "study.yaml"
        settings = TINY | dict(content.pop("set", {}))  # type: ignore[call-overload]
        path.write_text(json.dumps({"base": "base.yaml", "set": settings, **content}))
        return path

    return write


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Jobs are not run: their answers follow from settings and seed. The keys asked for."""
    asked: list[str] = []

    def run_job(job: Job) -> Result:
        asked.append(job.key)
        if job.config.keyframes.min_score > 40:
            return Result(hash=job.hash, seed=job.seed, error="keyframes.min_score: too much")
        values = {
            "energy_all": (job.config.keyframes.min_score - 7) ** 2 + job.seed,
            "exm_arr": 1 / (1 + abs(job.config.keyframes.min_score - 12) + job.config.recall.modes),
        }
        quantities = {name: Quantity(label=name, value=value, unit="") for name, value in values.items()}
        return Result(hash=job.hash, seed=job.seed, quantities=quantities, steps=1)

    monkeypatch.setattr("ratslam.experiments.studies.recorded_runs.run_job", run_job)
    return asked
