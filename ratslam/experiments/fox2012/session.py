"""A session of the simulated Create, and what a grid filter makes of it, in the frame of the arena.

Sessions of one arena begin at different places. One process makes many of them with few compiled filters.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from evaluation.metrics.occupancy_grid import GridTruth, OccupancyGrid, cell_centres
from ratslam.backends.grid import GridBackend
from ratslam.config.run_config import RunConfig
from ratslam.core.precision import Precision, prepare_precision
from ratslam.core.session import Session
from ratslam.grid.config import GridConfig
from ratslam.grid.map_drawing import Marks, draw, marks_of
from robot.simulation.create.session import CreateSimulation, CreateSimulationConfig, train_strain_templates
from robot.touch_source import TouchSource, observation_of, report_config_of
from robot.world.arena import Arena, arena_text, has_clearance, is_enclosed, is_occupied, wall_segments
from robot.world.random_arena import make_arena
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, integrate
from tactile.base.types import Observation, stack
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig, WhiskerMount
from tactile.wall_estimation.strain_templates import StrainTemplates
from tactile.whiskers.planar_whiskers import PlanarWhiskers

ROOM = 0.2
"""Free space around a start, m: the robot's, and a little."""
OVERSPILL = 2.0
"""A chart covers the arena so many times over, in each direction (Fox et al. 2012, II-D)."""
BEYOND = 0.4
"""Of the filter's map, whose middle is the start: so much more than the arena to every side, m."""


class Outing(NamedTuple):
    """A session of T reports.

    Attributes:
        source: of its reports. arena: with the robot's start. truth, odometry: [T, 3] poses after each
            report, true and reckoned from the start.
    """

    source: CreateSimulation
    arena: Arena
    truth: np.ndarray
    odometry: np.ndarray


class Mapped(NamedTuple):
    """What a filter made of the first T reports; all in the frame of the arena.

    Attributes:
        told: [T, 3] poses as told at the time. path: [T, 3] as known in the end. grid: the map drawn along
            that path.
    """

    told: np.ndarray
    path: np.ndarray
    grid: OccupancyGrid


def outing(config: CreateSimulationConfig) -> Outing:
    """The session, from a start that its seed draws.

    Raises:
        InputError: it cannot be simulated.
    """
    made = started(make_arena(config.arena, config.seed), config.seed)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "arena.txt"
        file.write_text(arena_text(made), encoding="utf-8")
        source = CreateSimulation(
            config.model_copy(update={"arena": config.arena.model_copy(update={"file": file})})
        )
    return Outing(source, made, source.truth, compose(made.start, integrate(source.odometry[:, :3])))


def started(arena: Arena, seed: int) -> Arena:
    """The arena with another start, anywhere that the robot fits in.

    Raises:
        InputError: it fits in nowhere.
    """
    random = stream(seed, "start")
    low, high = arena.outer.min(axis=0), arena.outer.max(axis=0)
    places, heading = random.uniform(low, high, (1000, 2)), random.uniform(-np.pi, np.pi)
    there = places[has_clearance(arena, places, ROOM)]
    if not len(there):
        raise InputError(
            "create_simulation.arena", "no room for a start", f"{ROOM:g} m of free space somewhere"
        )
    return arena._replace(start=np.array([*there[0], heading]))


def felt(config: RunConfig, outing: Outing, seed: int) -> list[Observation]:
    """What the filter is given of a session by the configuration's estimator of walls.

    Args:
        seed: of the drives into walls that strain templates are trained with.

    Raises:
        InputError: templates that cannot be used.
    """
    reports = report_config_of(outing.source.info, config.touch.reports)
    templates = None
    if reports.templates is None and reports.walls in ("template", "fused"):
        made = outing.source.config
        templates = _templates(
            CreateSimulationConfig(whiskers=made.whiskers, behaviour=made.behaviour, seed=seed)
        )
    source = TouchSource(outing.source, lambda: ReportFrontend(reports, templates), "touch.reports.mounts")
    return [observation_of(sample) for sample in source]


def mapped(
    config: RunConfig, outing: Outing, reports: list[Observation], stops: tuple[int, ...]
) -> list[Mapped]:
    """What the configuration's filter has made of the reports at each stop, a number of them."""
    touch = report_config_of(outing.source.info, config.touch.reports)
    grid = config.grid
    if grid.side is None:
        grid = grid.model_copy(update={"side": 2 * (span(outing.arena) + BEYOND)})
    session = session_at_start(
        grid, touch.mounts, touch.length, config.session.precision, config.session.seed
    )
    start, marks = outing.arena.start, felt_marks(reports)
    told: list[np.ndarray] = []
    found = []
    for stop in stops:
        told += [step.pose for step in session.replay(reports[len(told) : stop])]
        path = compose(start, session.map.trajectory())
        drawn = chart(grid, touch.feelers, outing.arena, path, marks)
        found.append(Mapped(compose(start, np.array(told)), path, drawn))
    return found


def chart(
    config: GridConfig, feelers: PlanarWhiskers, arena: Arena, path: np.ndarray, marks: Marks
) -> OccupancyGrid:
    """The map drawn along a path [T, 3] in the frame of the arena, which it covers `OVERSPILL` times over.

    Args:
        marks: of T reports or more.
    """
    side = round(OVERSPILL * span(arena) / config.cell)
    middle = _middle(arena)
    first = Marks(*(rows[: len(path)] for rows in marks))
    probability = draw(config, feelers, side, path - np.array([*middle, 0.0]), first)
    return OccupancyGrid(probability, middle - side * config.cell / 2, config.cell)


def truth_of(arena: Arena, grid: OccupancyGrid) -> GridTruth:
    """What is really there, on the cells of a chart."""
    place = cell_centres(grid)
    return GridTruth(is_occupied(arena, place), is_enclosed(arena, place), wall_segments(arena))


def span(arena: Arena) -> float:
    """Its larger side, m."""
    return float(np.ptp(arena.outer, axis=0).max())


def felt_marks(reports: list[Observation]) -> Marks:
    """What there is to draw of them."""
    rows = stack(reports)
    wall = np.where(rows.wall[:, None], rows.wall_point, np.nan)
    return marks_of(rows.motion, rows.contact, rows.alive, rows.point, wall)


def _middle(arena: Arena) -> np.ndarray:
    return (arena.outer.min(axis=0) + arena.outer.max(axis=0)) / 2


def session_at_start(
    grid: GridConfig, mounts: tuple[WhiskerMount, ...], length: float, precision: Precision, seed: int
) -> Session:
    """A session at its start, compiled already if one like it was asked for lately."""
    session = _compiled(grid, mounts, length, precision)
    session.restart(seed)
    return session


@lru_cache(maxsize=4)
def _compiled(
    grid: GridConfig, mounts: tuple[WhiskerMount, ...], length: float, precision: Precision
) -> Session:
    assert grid.side is not None
    feelers = ReportFrontendConfig(mounts=mounts, length=length).feelers
    prepare_precision(precision)
    return Session(GridBackend(grid, feelers, grid.side, precision), precision=precision)


@lru_cache(maxsize=1)
def _templates(config: CreateSimulationConfig) -> StrainTemplates:
    """Of a robot: as off-line in the paper, for all sessions."""
    return train_strain_templates(config)
