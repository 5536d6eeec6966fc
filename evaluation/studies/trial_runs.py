"""Short runs with the recommended settings and with each next cheaper setting."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from evaluation.studies.recommendation import FEWEST, Recommendation
from evaluation.studies.records import RunRecord
from evaluation.studies.resources import one_core
from evaluation.studies.run_job import run_job
from evaluation.studies.scene_statistics import short_session
from evaluation.studies.schema import StudyPlan
from evaluation.studies.study import Job, with_settings
from evaluation.studies.study_report import make_report, render
from ratslam.runs.open_source import open_source
from ratslam.runs.settings.run_config import RunConfig
from tactile.base.errors import InputError

COARSER = 1.5  # factor on the size of a cell in a cheaper step
FEWER = 3  # divisor of the number of particles in a cheaper step
ENERGY = 0.05
"""Energy that the classic backend injects for whisker views; the default outlasts their habituation."""


def cheaper_steps(config: RunConfig) -> dict[str, dict[str, Any]]:
    """The next cheaper step in every direction: settings in place of the recommended ones, by name."""
    steps = _cheaper_grid(config) if config.backend == "grid" else _cheaper_cells(config)
    if config.session.precision == "float64":
        steps["float32"] = {"session.precision": "float32"}
    if config.simulation is not None and (config.simulation.raw or config.simulation.fidelity == "dynamic"):
        steps["kinematic, no raw samples"] = {"simulation.fidelity": "kinematic", "simulation.raw": False}
    return steps


def try_settings(config: RunConfig, found: Sequence[Recommendation], cycles: int) -> list[RunRecord]:
    """Runs of the recommended settings, of the configured ones if they differ, and of every cheaper step.

    Args:
        config: completed by its source, with absolute paths. cycles: approximate length of the session.

    Raises:
        InputError: the session cannot be shortened, or not be run with the recommended settings.
    """
    with tempfile.TemporaryDirectory() as name, one_core():
        short = short_session(config, cycles, Path(name))
        with open_source(short) as source:
            length = source.length or cycles
        # Memory for the whole session from the start: each configuration compiles once.
        base = with_settings(short, {"session.reserve": length} | {each.key: each.value for each in found})
        steps: dict[str, dict[str, Any]] = {"recommended": {}}
        if any(each.changed for each in found):
            steps["as configured"] = {each.key: each.now for each in found}
        records = []
        for step, settings in (steps | cheaper_steps(base)).items():
            records.append(run_job(Job(step, {}, with_settings(base, settings), pace="live")))
            if records[0].error is not None:
                raise InputError("", records[0].error)
        return records


def render_trial_runs(records: Sequence[RunRecord]) -> str:
    """A table of time and error of each step, and what failed."""
    plan = StudyPlan(base=Path(), pace="live", report="costs")
    failed = [f"{record.row}: {record.error}" for record in records if record.error is not None]
    return "\n".join([render(make_report("", plan, records)), *failed])


def _cheaper_cells(config: RunConfig) -> dict[str, dict[str, Any]]:
    cells, steps = config.pose_cells, dict[str, dict[str, Any]]()
    if cells.cells_xy > FEWEST:
        fewer = max(FEWEST, cells.cells_xy // 2) | 1
        steps[f"{fewer} cells"] = {"pose_cells.cells_xy": fewer}
    size = float(f"{cells.cell_size * COARSER:.3g}")
    across = max(FEWEST, round(cells.cells_xy / COARSER)) | 1
    steps[f"cells of {size:g} m"] = {"pose_cells.cell_size": size, "pose_cells.cells_xy": across}
    turns = max(12, round(cells.cells_heading / COARSER))
    if turns < cells.cells_heading:
        steps[f"{turns} cells of heading"] = {"pose_cells.cells_heading": turns}
    if config.backend == "recall":
        steps["classic backend"] = {"backend": "classic"}
        if config.recording is None and "energy" not in config.templates.model_fields_set:
            steps["classic backend"]["templates.energy"] = ENERGY
    return steps


def _cheaper_grid(config: RunConfig) -> dict[str, dict[str, Any]]:
    grid, steps = config.grid, dict[str, dict[str, Any]]()
    fewer = max(2, grid.particles // FEWER)
    if fewer < grid.particles:
        steps[f"{fewer} particles"] = {"grid.particles": fewer}
    size = float(f"{grid.cell * COARSER:.3g}")
    return steps | {f"cells of {size:g} m": {"grid.cell": size}}
