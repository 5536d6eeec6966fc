"""A growth study: a long session on known ground and one on new ground, measured at growing lengths.

A simulation of whiskers gives both. Another session whose true poses are known, a recording of views or ids,
gives known ground: its course again and again, with noise of its own each time."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, PositiveInt

from evaluation.studies.study import with_settings
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import Document, load, override, validate
from ratslam.runs.settings.strict_yaml.document import Place
from robot.simulation.head.simulated_session import HeadSimulation
from robot.world.maze_routes import winding_loop
from robot.world.scene import PAPER_CIRCUITS, PathConfig
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.settings import Settings

SIDE = 64
"""Columns and rows of the maze of new ground, cells: the largest that can be simulated."""
SPARE = 1.05
"""Length of a route relative to the length wanted, as estimated from a shorter one."""

Ground = Literal["known ground", "new ground"]
Length = Annotated[int, Field(ge=0, le=1_000_000)]


class GrowthPlan(Settings):
    """The settings of a growth study."""

    first: PositiveInt = 400  # least length to measure at, steps; each further one is twice as long
    known_ground: Length = 3200  # greatest length of the session on known ground, steps; 0: no such session
    new_ground: Length = 3200  # greatest length of the session on new ground, steps; 0: no such session
    window: Length = 0  # steps before each length whose times are measured; 0: all since the length before

    def lengths(self, ground: Ground) -> list[int]:
        """The lengths to measure a session at, in increasing order."""
        most = self.known_ground if ground == "known ground" else self.new_ground
        found, length = list[int](), self.first
        while length < most:
            found.append(length)
            length *= 2
        return [*found, most] if most else []


class GrowthTask(NamedTuple):
    """One session of a growth study."""

    ground: Ground
    config: RunConfig  # a simulation of whiskers is at least as long as the greatest length
    lengths: list[int]  # to measure at, increasing, steps
    window: int = 0  # see `GrowthPlan`


class GrowthStudy(NamedTuple):
    """A checked growth study."""

    name: str
    tasks: list[GrowthTask]


def growth_study(path: Path, overrides: Sequence[str] = ()) -> GrowthStudy:
    """The growth study of a configuration file.

    Args:
        overrides: each `a.b=value`: a key of `GrowthPlan` where it is one, else of the configuration.

    Raises:
        InputError: the configuration is invalid, or the ground is too small.
    """
    own = [text for text in overrides if text.partition("=")[0] in GrowthPlan.model_fields]
    empty = Document({}, {(): Place("--preset growth", "--preset growth")})
    plan = validate(override(empty, own), GrowthPlan)
    document = override(load(path), [text for text in overrides if text not in own])
    config = validate(document, RunConfig).with_absolute_paths(path.parent.resolve())
    whiskers = config.simulation is not None
    tasks = []
    if lengths := plan.lengths("known ground"):
        known = _with_laps(config, lengths[-1]) if whiskers else config
        tasks.append(GrowthTask("known ground", known, lengths, plan.window))
    if whiskers and (lengths := plan.lengths("new ground")):
        tasks.append(GrowthTask("new ground", with_new_ground(config, lengths[-1]), lengths, plan.window))
    if not tasks:
        raise InputError("--preset growth", "no session", "known_ground or new_ground above 0 steps")
    return GrowthStudy(f"{path.stem}-growth", tasks)


def _with_laps(config: RunConfig, steps: int) -> RunConfig:
    """The configuration with its circuits repeated for at least so many steps."""
    assert config.simulation is not None
    word = config.simulation.path.circuits or PAPER_CIRCUITS
    laps, loop = 1, config.simulation.path.loop

    def repeated() -> RunConfig:
        circuits = (word * ceil(laps / len(word)))[:laps]
        return with_settings(config, {"simulation.path": PathConfig(circuits=circuits, loop=loop)})

    while (length := _length(found := repeated())) < steps:
        laps = max(laps + 1, ceil(SPARE * laps * steps / length))
    return found


def with_new_ground(config: RunConfig, steps: int) -> RunConfig:
    """The configuration in the largest maze, on a random route that enters no cell twice, of at least so many
    steps."""
    assert config.simulation is not None
    size = {"columns": SIDE, "rows": SIDE, "kind": "loop", "file": None}
    maze = config.simulation.maze.model_copy(update=size)
    seed = config.simulation.seed if maze.seed is None else maze.seed
    loop = tuple(winding_loop(SIDE, SIDE, stream(seed, "growth.route")))
    cells = 8
    while True:
        path = PathConfig(cells=loop[:cells], loop=loop)
        found = with_settings(config, {"simulation.maze": maze, "simulation.path": path})
        if (length := _length(found)) >= steps:
            return found
        if cells == len(loop):
            raise InputError("new_ground", f"{steps} steps", f"at most {length}, a visit of every cell")
        cells = min(max(cells + 1, ceil(SPARE * cells * steps / length)), len(loop))


def _length(config: RunConfig) -> int:
    """Number of whisks of a simulation."""
    assert config.simulation is not None
    cheapest = with_settings(config, {"simulation.fidelity": "kinematic", "simulation.raw": False}).simulation
    assert cheapest is not None
    return HeadSimulation(cheapest, config.touch.head).length or 0
