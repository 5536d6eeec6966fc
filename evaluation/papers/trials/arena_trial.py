"""A session of the simulated Create and its result by a grid filter, in the frame of the arena.

Sessions in one arena start at different places. A process runs many sessions with few compiled filters.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from evaluation.metrics.occupancy_grid import OccupancyGrid
from ratslam.core.precision import Precision, prepare_precision
from ratslam.core.session import Session
from ratslam.grid.config import GridConfig
from ratslam.grid.likelihoods import distinct_cells
from ratslam.grid.map_drawing import ContactLog, contact_log, draw_occupancy
from ratslam.methods.grid import GridBackend
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.create.simulated_session import (
    CreateSimulation,
    CreateSimulationConfig,
    train_strain_templates,
)
from robot.touch_source import TouchSource, observation_of, report_config_of
from robot.world.arena import Arena, arena_text
from robot.world.random_arena import make_arena, place_start
from tactile.base.se2 import compose, integrate
from tactile.base.types import Observation, stack
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig, WhiskerMount
from tactile.wall_estimation.strain_templates import StrainTemplates
from tactile.whiskers.planar_whiskers import PlanarWhiskers

MAP_SCALE = 2.0  # side of a drawn map over the side of the arena (Fox et al. 2012, II-D)
MAP_MARGIN = 0.4  # margin of the filter's map, which is centred on the start, beyond the arena, m


class ArenaSession(NamedTuple):
    """A session of T reports.

    Attributes:
        source: of the reports. arena: with the robot's start. truth, odometry: [T, 3] true and dead-reckoned
            poses after each report.
    """

    source: CreateSimulation
    arena: Arena
    truth: np.ndarray
    odometry: np.ndarray


class FilterResult(NamedTuple):
    """The result of a filter after T reports, in the frame of the arena.

    Attributes:
        online: [T, 3] poses as estimated at the time. path: [T, 3] final poses. grid: the map drawn along
            `path`.
    """

    online: np.ndarray
    path: np.ndarray
    grid: OccupancyGrid


def simulate_session(config: CreateSimulationConfig) -> ArenaSession:
    """A session from a random start.

    Raises:
        InputError: it cannot be simulated.
    """
    made = place_start(make_arena(config.arena, config.seed), config.seed)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "arena.txt"
        file.write_text(arena_text(made), encoding="utf-8")
        arena = config.arena.model_copy(update={"file": file})
        source = CreateSimulation(config.model_copy(update={"arena": arena}))
    return ArenaSession(source, made, source.truth, compose(made.start, integrate(source.odometry[:, :3])))


def observe_session(config: RunConfig, session: ArenaSession, seed: int) -> list[Observation]:
    """The filter's observations of a session, with the configured wall estimator.

    Args:
        seed: of the drives for the training of strain templates.

    Raises:
        InputError: templates that cannot be used.
    """
    reports = report_config_of(session.source.info, config.touch.reports)
    templates = None
    if reports.templates is None and reports.walls in ("template", "fused"):
        made = session.source.config
        robot = CreateSimulationConfig(whiskers=made.whiskers, behaviour=made.behaviour, seed=seed)
        templates = _templates(robot)
    source = TouchSource(session.source, lambda: ReportFrontend(reports, templates), "touch.reports.mounts")
    return [observation_of(sample) for sample in source]


def run_filter(
    config: RunConfig, session: ArenaSession, reports: list[Observation], stops: tuple[int, ...]
) -> list[FilterResult]:
    """The result of the configured filter after each number of reports in `stops`."""
    touch = report_config_of(session.source.info, config.touch.reports)
    grid = config.grid
    if grid.side is None:
        grid = grid.model_copy(update={"side": 2 * (session.arena.side + MAP_MARGIN)})
    slam = session_at_start(grid, touch.mounts, touch.length, config.session.precision, config.session.seed)
    start, marks = session.arena.start, collect_marks(reports)
    online: list[np.ndarray] = []
    found = []
    for stop in stops:
        online += [step.pose for step in slam.replay(reports[len(online) : stop])]
        path = compose(start, slam.map.trajectory())
        drawn = draw_map(grid, touch.feelers, session.arena, path, marks)
        found.append(FilterResult(compose(start, np.array(online)), path, drawn))
    return found


def draw_map(
    config: GridConfig, feelers: PlanarWhiskers, arena: Arena, path: np.ndarray, marks: ContactLog
) -> OccupancyGrid:
    """The map drawn along a path [T, 3], in the frame of the arena; `MAP_SCALE` gives its side.

    Args:
        marks: of at least T reports.
    """
    side = round(MAP_SCALE * arena.side / config.cell)
    middle = (arena.outer.min(axis=0) + arena.outer.max(axis=0)) / 2
    first = ContactLog(*(rows[: len(path)] for rows in marks))
    probability = draw_occupancy(config, feelers, side, path - np.array([*middle, 0.0]), first)
    return OccupancyGrid(probability, middle - side * config.cell / 2, config.cell)


def collect_marks(reports: list[Observation]) -> ContactLog:
    """The marks that the reports add to a map."""
    rows = stack(reports)
    wall = np.where(rows.wall[:, None], rows.wall_point, np.nan)
    return contact_log(rows.motion, rows.contact, rows.alive, rows.point, wall)


def session_at_start(
    grid: GridConfig, mounts: tuple[WhiskerMount, ...], length: float, precision: Precision, seed: int
) -> Session:
    """A session at its start; a recently compiled one is used again."""
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
    backend = GridBackend(grid, feelers, grid.side, precision, distinct_cells)
    return Session(backend, precision=precision)


@lru_cache(maxsize=1)
def _templates(config: CreateSimulationConfig) -> StrainTemplates:
    """Templates of a robot, trained once for all sessions as in the paper."""
    return train_strain_templates(config)
