"""Recommended values, with reasons, of the settings that cost time or memory; and short runs that try them.

The settings follow from the path of odometry. The trial runs have the recommended settings, the configured
ones and each next cheaper setting.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from evaluation.studies.machine import one_core
from evaluation.studies.run_job import RunRecord, run_job
from evaluation.studies.scene_statistics import Scene, short_session
from evaluation.studies.study import Job, StudyPlan, with_settings
from evaluation.studies.study_report import make_report, plain, render, render_table
from ratslam.classic.config import NetworkConfig, network_of
from ratslam.classic.levels import SETTLED, window_levels
from ratslam.classic.pose_cells import LARGEST_SUBSTEP
from ratslam.grid.particles import LAYERS
from ratslam.methods.grid import LIVE_SIDE
from ratslam.runs.build_session import open_source
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import open_path
from ratslam.runs.settings.yaml_document import Dumper
from robot.simulation.head.simulated_session import choose_tier
from tactile.base.errors import InputError

PARTS = 4  # largest number of sub-steps of all but a few cycles; with more, cells are too fine for the speed
SLOW = 0.05  # smallest motion of a usual cycle, cells; with less, cells are too coarse for the robot's speed
FEWEST, MOST = 11, 201
"""Cells along an axis: at least those of a packet, at most those measured with the moving window."""
PER_CELL = 100  # particles per cell of odometry error across the scene
PARTICLES = 30, 3000  # smallest and largest number of particles
MEMORY = 1024  # largest memory of all particles' maps, MiB


class _Recommendation(NamedTuple):
    """A setting: key path, present value, recommended value, reason in one line."""

    key: str
    now: Any
    value: Any
    why: str

    @property
    def changed(self) -> bool:
        """Whether the recommended value differs from the present one."""
        return bool(self.value != self.now)


def recommend(config: RunConfig, scene: Scene) -> list[_Recommendation]:
    """Recommendations for a configuration that its source has completed."""
    own = _grid(config, scene) if config.backend == "grid" else _rat(config, scene)
    return [*own, *_tier(config)]


def round_number(value: float, side: int = 0, steps: tuple[int, ...] = (1, 2, 5)) -> float:
    """The nearest of some steps times a power of ten; not below the value if side is 1, not above if -1."""
    power = np.floor(np.log10(value))
    every = [float(f"{step}e{power + k:.0f}") for k in (-1, 0, 1) for step in steps]
    allowed = [each for each in every if (each - value) * side >= 0]
    return min(allowed, key=lambda each: abs(np.log(each / value)))


def render_recommendations(found: Sequence[_Recommendation]) -> str:
    """A table of settings: present value, recommended value, reason."""
    rows = [[each.key, *map(plain, (each.now, each.value)), each.why] for each in found]
    return render_table([["setting", "now", "recommended", "why"], *rows])


def changed_settings_yaml(found: Sequence[_Recommendation]) -> str:
    """YAML of the settings to change; '' if there are none."""
    tree: dict[str, Any] = {}
    for each in found:
        if each.changed:
            section, path = open_path(tree, each.key, each.key)
            section[path[-1]] = each.value
    return yaml.dump(tree, Dumper=Dumper, sort_keys=False) if tree else ""


def _of(config: RunConfig, key: str, value: Any, why: str) -> _Recommendation:
    now: Any = config
    for name in key.split("."):
        now = getattr(now, name)
    return _Recommendation(key, now, value, why)


def _rat(config: RunConfig, scene: Scene) -> Iterator[_Recommendation]:
    cells = config.pose_cells
    yield (size := _cell_size(config, scene))
    yield (across := _cells_xy(config, scene, size.value))
    fitting = {"cell_size": size.value, "cells_xy": across.value, "engine": "window"}
    yield _engine(config, network_of(cells, config.attractor).model_copy(update=fitting))
    step = 2 * np.pi / cells.cells_heading
    turns = f"a turn of {scene.turn:.2g} rad takes {_parts(scene.turn / step)} sub-steps"
    why = f"{np.degrees(step):.3g} degrees; {turns}"
    yield _of(config, "pose_cells.cells_heading", cells.cells_heading, why)
    yield _of(config, "backend", "recall", "weighs runs of views; classic takes the best single view")
    yield _of(config, "session.precision", "float64", "what the published figures are of")


def _cell_size(config: RunConfig, scene: Scene) -> _Recommendation:
    now = config.pose_cells.cell_size
    moved, most = scene.usual / now, scene.most / now
    steps = f"{_parts(most)} sub-steps of {LARGEST_SUBSTEP:g} at most"
    value, why = now, f"a cycle moves {moved:.2g} cells (95 %: {most:.2g}): {steps}"
    if _parts(most) > PARTS:
        value, why = round_number(scene.most / (LARGEST_SUBSTEP * PARTS), 1), f"{why}, where {PARTS} will do"
    elif moved < SLOW:
        value, why = round_number(scene.usual / SLOW, -1), f"{why}, {1 / moved:.0f} cycles for one cell"
    return _of(config, "pose_cells.cell_size", value, why)


def _cells_xy(config: RunConfig, scene: Scene, size: float) -> _Recommendation:
    now, span = config.pose_cells.cells_xy, max(scene.span)
    # An odd number of cells of a torus that does not wrap, with space for a packet at either end.
    cover = min(max(FEWEST, int(np.ceil(span / size)) + SETTLED) | 1, MOST)
    # What recall and its map do is the same on any torus: then the one there is will do.
    value = now if config.backend == "recall" and FEWEST <= now <= cover else cover
    wraps = span / (value * size)
    free = ", which recall does not mind" * (config.backend == "recall")
    twice = f"wraps {wraps:.1f} x{free}" if wraps > 1 else "none twice"
    return _of(config, "pose_cells.cells_xy", value, f"the path spans {span / size:.0f} cells: {twice}")


def _engine(config: RunConfig, proposed: NetworkConfig) -> _Recommendation:
    levels = window_levels(proposed, np.dtype(float))
    shapes = ["x".join(map(str, level.window.shape[::-1])) for level in levels]
    if len(levels) == 1:
        return _of(config, "attractor.engine", "dense", f"{shapes[0]} cells are too few for a window")
    share = np.prod(levels[0].window.shape) / np.prod(levels[-1].window.shape)
    several = [f"{level.windows} of " * (level.windows > 1) for level in levels]
    then = ", ".join(map("".join, zip(several[1:-1], shapes[1:-1], strict=True)))
    why = f"{shapes[0]} of {shapes[-1]} cells ({share:.0%}); where not exact, {then}{', ' if then else ''}all"
    return _of(config, "attractor.engine", "window", why)


def _grid(config: RunConfig, scene: Scene) -> Iterator[_Recommendation]:
    grid, side = config.grid, config.grid.side or LIVE_SIDE
    blob, cell = grid.footprint.blob_sd, round_number(grid.footprint.blob_sd)
    across = int(np.ceil(side / cell))
    # Standard deviation of odometry after crossing the scene, by the filter's drift model.
    span, drift = max(scene.span), grid.drift
    cycles = max(span / scene.usual, 1.0)
    along = span * np.hypot(np.hypot(drift.session, drift.move), drift.step / np.sqrt(cycles))
    aside = span * drift.heading * np.sqrt(cycles / 3)
    off = float(np.hypot(along, aside)) / cell
    wanted = int(np.clip(round_number(max(PER_CELL * off, 1.0), steps=(1, 2, 3, 5)), *PARTICLES))
    each = LAYERS * across**2 * np.dtype(np.float32).itemsize / 2**20
    count = min(wanted, max(PARTICLES[0], int(MEMORY / each)))
    yield _of(config, "grid.cell", cell, f"as fine as the mark of a contact, {blob:g} m")
    why = f"{span:.3g} m of path and what whiskers reach from it: {across} cells"
    yield _of(config, "grid.side", side, why)
    room = f"{count * each:.0f} MiB" + f", {wanted} do not fit in {MEMORY}" * (count < wanted)
    why = f"{PER_CELL} for each cell ({off:.2g}) that odometry is off across the scene; {room}"
    yield _of(config, "grid.particles", count, why)
    yield _of(config, "session.precision", "float32", "half the memory; evidence needs no more digits")


def _tier(config: RunConfig) -> Iterator[_Recommendation]:
    simulation = config.simulation
    if simulation is None:
        return
    tier, reason = choose_tier(simulation.model_copy(update={"fidelity": "auto"}))
    auto = simulation.fidelity == "auto"
    why = f"{tier}: " * auto + f"{reason}; `study --preset tiers` compares them"
    yield _of(config, "simulation.fidelity", "auto" if auto else tier, why)


def _parts(cells: float) -> int:
    """Number of sub-steps for a motion in cells."""
    return max(1, int(np.ceil(cells / LARGEST_SUBSTEP - 1e-9)))


COARSER = 1.5  # factor on the size of a cell in a cheaper step
FEWER = 3  # divisor of the number of particles in a cheaper step
ENERGY = 0.05
"""Energy that the classic backend injects for whisker views; the default outlasts their habituation."""


def cheaper_steps(config: RunConfig) -> dict[str, dict[str, Any]]:
    """The next cheaper step in every direction: settings in place of the recommended ones, by name."""
    grid, cells, steps = config.grid, config.pose_cells, dict[str, dict[str, Any]]()
    if config.backend == "grid":
        fewer = max(2, grid.particles // FEWER)
        if fewer < grid.particles:
            steps[f"{fewer} particles"] = {"grid.particles": fewer}
        size = float(f"{grid.cell * COARSER:.3g}")
        steps[f"cells of {size:g} m"] = {"grid.cell": size}
    else:
        fewer = max(FEWEST, cells.cells_xy // 2) | 1
        if cells.cells_xy > FEWEST:
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
    if config.session.precision == "float64":
        steps["float32"] = {"session.precision": "float32"}
    if config.simulation is not None and (config.simulation.raw or config.simulation.fidelity == "dynamic"):
        steps["kinematic, no raw samples"] = {"simulation.fidelity": "kinematic", "simulation.raw": False}
    return steps


def try_settings(config: RunConfig, found: Sequence[_Recommendation], cycles: int) -> list[RunRecord]:
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
