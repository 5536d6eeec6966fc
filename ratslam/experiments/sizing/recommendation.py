"""What a scene needs: a value for each setting that costs time or memory, and why."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ratslam.attractor.config import PoseCellConfig
from ratslam.attractor.levels import SETTLED, window_levels
from ratslam.backends.grid import LIVE_SIDE
from ratslam.config.run_config import RunConfig
from ratslam.experiments.sizing.scene_statistics import Scene
from ratslam.grid.config import DriftConfig
from ratslam.grid.particle_maps import LAYERS
from robot.simulation.head.session import choose_tier

PART = 0.5
"""Cells that the packet moves in one sub-step at most."""
PARTS = 4
"""Sub-steps for all but a few cycles, beyond which cells are too fine for the robot's speed."""
SLOW = 0.05
"""Cells that a usual cycle moves at least, below which cells are coarser than the robot's speed asks for."""
FEWEST, MOST = 11, 201
"""Cells along an axis: a packet's, and so many as the moving window is known to be as fast with."""
PER_CELL = 100
"""Particles for each cell by which odometry may be off once it has crossed the scene."""
PARTICLES = 30, 3000
"""Fewest and most."""
MEMORY = 1024
"""Of all particles' maps, MiB, at most."""


class Proposal(NamedTuple):
    """A setting: its key path, what the configuration has, what is proposed, and why in a line."""

    key: str
    now: Any
    value: Any
    why: str

    @property
    def changed(self) -> bool:
        """Whether the configuration has another value."""
        return bool(self.value != self.now)


def proposals(config: RunConfig, scene: Scene) -> list[Proposal]:
    """For a configuration that its source has completed."""
    own = _grid(config, scene) if config.backend == "grid" else _rat(config, scene)
    return [*own, *_tier(config)]


def with_settings(config: Any, settings: dict[str, Any]) -> Any:
    """A configuration with values at key paths, taken for valid."""
    for key, value in settings.items():
        name, _, rest = key.partition(".")
        inner = with_settings(getattr(config, name), {rest: value}) if rest else value
        config = config.model_copy(update={name: inner})
    return config


def nice(value: float, side: int = 0) -> float:
    """The nearest of 1, 2 and 5 times a power of ten; for a side of 1 not below it, for -1 not above."""
    power = np.floor(np.log10(value))
    every = [float(f"{step}e{power + k:.0f}") for k in (-1, 0, 1) for step in (1, 2, 5)]
    allowed = [each for each in every if (each - value) * side >= 0]
    return min(allowed, key=lambda each: abs(np.log(each / value)))


def covering(span: float, cell: float) -> int:
    """Cells of a torus that does not wrap: odd, room for a packet at either end."""
    return max(FEWEST, int(np.ceil(span / cell)) + SETTLED) | 1


def _of(config: RunConfig, key: str, value: Any, why: str) -> Proposal:
    now: Any = config
    for name in key.split("."):
        now = getattr(now, name)
    return Proposal(key, now, value, why)


def _rat(config: RunConfig, scene: Scene) -> Iterator[Proposal]:
    cells = config.pose_cells
    yield (size := _cell_size(config, scene))
    yield (across := _cells_xy(config, scene, size.value))
    fitting = {"cell_size": size.value, "cells_xy": across.value, "engine": "window"}
    yield _engine(config, cells.model_copy(update=fitting))
    step = 2 * np.pi / cells.cells_heading
    turns = f"a turn of {scene.turn:.2g} rad takes {_parts(scene.turn / step)} sub-steps"
    yield _of(
        config, "pose_cells.cells_heading", cells.cells_heading, f"{np.degrees(step):.3g} degrees; {turns}"
    )
    yield _of(config, "backend", "recall", "weighs runs of views; classic takes the best single view")
    yield _of(config, "session.precision", "float64", "what the published figures are of")


def _cell_size(config: RunConfig, scene: Scene) -> Proposal:
    now = config.pose_cells.cell_size
    moved, most = scene.usual / now, scene.most / now
    why = f"a cycle moves {moved:.2g} cells (95 %: {most:.2g}): {_parts(most)} sub-steps of {PART:g} at most"
    value = now
    if _parts(most) > PARTS:
        value, why = nice(scene.most / (PART * PARTS), 1), f"{why}, where {PARTS} will do"
    elif moved < SLOW:
        value, why = nice(scene.usual / SLOW, -1), f"{why}, {1 / moved:.0f} cycles for one cell"
    return _of(config, "pose_cells.cell_size", value, why)


def _cells_xy(config: RunConfig, scene: Scene, size: float) -> Proposal:
    now, span = config.pose_cells.cells_xy, max(scene.span)
    cover = min(covering(span, size), MOST)
    # What recall and its map do is the same on any torus: then the one there is will do.
    value = now if config.backend == "recall" and FEWEST <= now <= cover else cover
    wraps = span / (value * size)
    told = f"the path spans {span / size:.0f} cells: " + (
        f"wraps {wraps:.1f} x" if wraps > 1 else "none twice"
    )
    free = ", which recall does not mind" if config.backend == "recall" and wraps > 1 else ""
    return _of(config, "pose_cells.cells_xy", value, told + free)


def _engine(config: RunConfig, proposed: PoseCellConfig) -> Proposal:
    levels = window_levels(proposed, np.dtype(float))
    shapes = ["x".join(map(str, level.window.shape[::-1])) for level in levels]
    if len(levels) == 1:
        return _of(config, "pose_cells.engine", "dense", f"{shapes[0]} cells are too few for a window")
    share = np.prod(levels[0].window.shape) / np.prod(levels[-1].window.shape)
    several = [f"{level.windows} of " * (level.windows > 1) for level in levels]
    then = ", ".join(map("".join, zip(several[1:-1], shapes[1:-1], strict=True)))
    why = f"{shapes[0]} of {shapes[-1]} cells ({share:.0%}); where not exact, {then}{', ' if then else ''}all"
    return _of(config, "pose_cells.engine", "window", why)


def _grid(config: RunConfig, scene: Scene) -> Iterator[Proposal]:
    grid, side = config.grid, config.grid.side or LIVE_SIDE
    blob, cell = grid.footprint.blob_sd, nice(grid.footprint.blob_sd)
    across = int(np.ceil(side / cell))
    off = _drifted(grid.drift, scene) / cell
    wanted = int(np.clip(_step(PER_CELL * off), *PARTICLES))
    each = LAYERS * across**2 * np.dtype(np.float32).itemsize / 2**20
    count = min(wanted, max(PARTICLES[0], int(MEMORY / each)))
    yield _of(config, "grid.cell", cell, f"as fine as the mark of a contact, {blob:g} m")
    why = f"{max(scene.span):.3g} m of path and what whiskers reach from it: {across} cells"
    yield _of(config, "grid.side", side, why)
    why = (
        f"{PER_CELL} for each cell ({off:.2g}) that odometry is off across the scene; {count * each:.0f} MiB"
    )
    less = f", {wanted} do not fit in {MEMORY}" if count < wanted else ""
    yield _of(config, "grid.particles", count, why + less)
    yield _of(config, "session.precision", "float32", "half the memory; evidence needs no more digits")


def _tier(config: RunConfig) -> Iterator[Proposal]:
    simulation = config.simulation
    if simulation is None:
        return
    chosen = choose_tier(simulation.model_copy(update={"fidelity": "auto"}))
    value = "auto" if simulation.fidelity == "auto" else chosen.name
    named = f"{chosen.name}: " if value == "auto" else ""
    why = f"{named}{chosen.why}; `study --preset tiers` compares them"
    yield _of(config, "simulation.fidelity", value, why)


def _parts(cells: float) -> int:
    """Sub-steps for so many cells."""
    return max(1, int(np.ceil(cells / PART - 1e-9)))


def _drifted(drift: DriftConfig, scene: Scene) -> float:
    """Standard deviation of odometry after crossing the scene, as the filter believes it, m."""
    span = max(scene.span)
    cycles = max(span / scene.usual, 1.0)
    lasting = np.hypot(drift.session, drift.move)
    along = span * np.hypot(lasting, drift.step / np.sqrt(cycles))
    aside = span * drift.heading * np.sqrt(cycles / 3)
    return float(np.hypot(along, aside))


def _step(count: float) -> float:
    """The nearest of 1, 2, 3 and 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(max(count, 1.0)))
    return float(min((1, 2, 3, 5, 10), key=lambda step: abs(np.log(step * power / max(count, 1.0)))) * power)
