"""The proposed settings and each next cheaper step, tried on a short version of the session."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ratslam.config.run_config import RunConfig
from ratslam.experiments.sizing.recommendation import FEWEST, Proposal, with_settings
from ratslam.experiments.sizing.scene_statistics import short
from ratslam.experiments.studies.environment import one_core
from ratslam.experiments.studies.records import RunRecord
from ratslam.experiments.studies.run_job import run_job
from ratslam.experiments.studies.study import Job
from ratslam.pipeline.source import open_source
from tactile.base.errors import InputError

COARSER = 1.5
"""Size of a cell, of what it was."""
FEWER = 3
"""Of so many particles one is left."""
ENERGY = 0.05
"""What the classic matcher injects for views of whiskers, whose habituation the default outlasts."""


class Step(NamedTuple):
    """A way to do with less: its name, and settings beside the proposed ones."""

    name: str
    settings: dict[str, Any]


class Tried(NamedTuple):
    """A step, and what came of it."""

    step: Step
    result: RunRecord


def cheaper(config: RunConfig) -> list[Step]:
    """The next cheaper step in every direction from a configuration with the proposed settings."""
    steps = _less_grid(config) if config.backend == "grid" else _less_rat(config)
    if config.session.precision == "float64":
        steps.append(Step("float32", {"session.precision": "float32"}))
    if config.simulation is not None and (config.simulation.raw or config.simulation.fidelity == "dynamic"):
        steps.append(
            Step("kinematic, no raw samples", {"simulation.fidelity": "kinematic", "simulation.raw": False})
        )
    return steps


def tried(
    config: RunConfig,
    proposed: Sequence[Proposal],
    cycles: int,
    done: Callable[[Tried], None] | None = None,
) -> list[Tried]:
    """The proposed settings, those of the configuration if they are others, and every cheaper step.

    Args:
        config: completed by its source, with whole paths. cycles: of the short session, about.
        done: told of each as it comes.

    Raises:
        InputError: the session cannot be shortened, or not be run as proposed.
    """
    with tempfile.TemporaryDirectory() as name, one_core():
        briefly = short(config, cycles, Path(name))
        with open_source(briefly) as source:
            length = source.length or cycles
        # Room for all of it at the start: each configuration compiles once.
        briefly = with_settings(briefly, {"session.reserve": length})
        values = {each.key: each.value for each in proposed}
        base = with_settings(briefly, values)
        steps = [Step("proposed", {}), *cheaper(base)]
        if any(each.changed for each in proposed):
            steps.insert(1, Step("as configured", {each.key: each.now for each in proposed}))
        found = []
        for step in steps:
            one = Tried(step, _run(with_settings(base, step.settings)))
            if one.result.error is not None and step.name == "proposed":
                raise InputError("", one.result.error)
            found.append(one)
            if done:
                done(one)
        return found


def _less_rat(config: RunConfig) -> list[Step]:
    cells, steps = config.pose_cells, []
    if cells.cells_xy > FEWEST:
        fewer = max(FEWEST, cells.cells_xy // 2) | 1
        steps.append(Step(f"{fewer} cells", {"pose_cells.cells_xy": fewer}))
    size = float(f"{cells.cell_size * COARSER:.3g}")
    across = max(FEWEST, round(cells.cells_xy / COARSER)) | 1
    steps.append(Step(f"cells of {size:g} m", {"pose_cells.cell_size": size, "pose_cells.cells_xy": across}))
    turns = max(12, round(cells.cells_heading / COARSER))
    if turns < cells.cells_heading:
        steps.append(Step(f"{turns} cells of heading", {"pose_cells.cells_heading": turns}))
    if config.backend == "recall":
        classic: dict[str, Any] = {"backend": "classic"}
        if config.recording is None and "energy" not in config.templates.model_fields_set:
            classic["templates.energy"] = ENERGY
        steps.append(Step("classic matcher", classic))
    return steps


def _less_grid(config: RunConfig) -> list[Step]:
    grid, steps = config.grid, []
    fewer = max(2, grid.particles // FEWER)
    if fewer < grid.particles:
        steps.append(Step(f"{fewer} particles", {"grid.particles": fewer}))
    size = float(f"{grid.cell * COARSER:.3g}")
    return [*steps, Step(f"cells of {size:g} m", {"grid.cell": size})]


def _run(config: RunConfig) -> RunRecord:
    return run_job(Job("", {}, config, "", 0, pace="live"))
