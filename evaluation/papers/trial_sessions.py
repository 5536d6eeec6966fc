"""Sessions of experiments, held in memory, each from its source to what a table measures of it.

Whisker sessions and recordings (or perturbed copies of them) through a backend; sessions of the simulated
Create and their result by a grid filter, in the frame of the arena. A process runs many sessions of one kind
with one compiled kernel: a session object is reset to its start for each of them.

Controls replace the views of a source and leave its odometry and truth. A method that closes loops on
shuffled or blank views does so by odometry alone; ideal views give the upper bound of the rest of the method.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.trajectory import ate
from evaluation.studies.metrics import SessionResult
from evaluation.studies.perturbation import Perturbation
from ratslam.core.backend import Backend, Map
from ratslam.core.compilation import Precision, prepare_precision
from ratslam.core.session import Session, capacity_at
from ratslam.grid.config import GridConfig
from ratslam.grid.map import ContactLog, contact_log, draw_occupancy
from ratslam.methods.grid import GridBackend
from ratslam.methods.method_registry import Sensors, backend_settings, build
from ratslam.runs.build_session import build_session, open_observations
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.create.simulated_session import (
    CreateSimulation,
    CreateSimulationConfig,
    train_strain_templates,
)
from robot.sources.in_memory import InMemorySource, load_into_memory
from robot.touch_source import TouchSource, observation_of, report_config_of
from robot.world.arena import Arena, arena_text, make_arena, place_start
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import compose, integrate, wrap
from tactile.base.settings import Settings
from tactile.base.types import Array, Observation, stack
from tactile.wall_estimation.report_frontend import ReportFrontend, ReportFrontendConfig, WhiskerMount
from tactile.whisker_geometry import PlanarWhiskers


def collect_session(config: RunConfig, every: bool = True) -> tuple[RunConfig, InMemorySource]:
    """The configuration completed by its source, and the whole source in memory.

    Args:
        every: whether every step needs a true pose.

    Raises:
        InputError: the source cannot be read or simulated, or lacks true poses.
    """
    with open_observations(config) as (config, source):
        log = load_into_memory(source)
    if log.truth is None or (every and not np.isfinite(log.truth).all()):
        raise InputError(log.name, "steps without a true pose", "the true pose of every step")
    return config, log


def run_session(config: RunConfig, log: InMemorySource, session: Session | None = None) -> SessionResult:
    """Runs a session from memory, with a configuration completed by its source.

    Args:
        session: at its start; None: that of `start_session`.
    """
    session = session or start_session(config, log)
    steps, map = list(session.replay(observation_of(sample) for sample in log)), session.map
    place, live = np.array([int(step.estimate.place) for step in steps]), [step.pose for step in steps]
    nodes = map.graph().nodes
    rows = (nodes[k] for k in range(len(nodes)))
    node = np.array([[row["x"], row["y"], row["heading"]] for row in rows]).reshape(-1, 3)
    truth, odometry = np.asarray(log.truth), integrate(log.motion[:, :3])
    trajectory, place = map.trajectory(), np.where(place < len(node), place, -1)
    closures, piece = map.closures(), map.pieces()
    return SessionResult(truth, odometry, trajectory, place, node, closures, np.array(live), piece)


def start_session(config: RunConfig, log: InMemorySource) -> Session:
    """A session at its start, for a configuration completed by its source; the next call takes it back."""
    session = _compiled(_kind(config, log))
    session.restart(config.session.seed)
    return session


def new_session(
    config: RunConfig, log: InMemorySource, change: Callable[[Backend], None] | None = None
) -> Session:
    """The same, compiled anew and for the caller alone.

    Args:
        change: is done to the backend before.
    """
    session = _build(_kind(config, log), change)
    session.restart(config.session.seed)
    return session


def capacity_for(steps: int) -> int:
    """Memory rows for a session: a power of two, so that sessions of similar length share a kernel."""
    return capacity_at(max(steps, 1) - 1)


_Kind = tuple[str, Settings, Precision, tuple[int, int, int], int]
"""What sessions of one kernel share: name and settings of the method, precision, shape of views, rows."""


def _kind(config: RunConfig, log: InMemorySource) -> _Kind:
    method = backend_settings(config.backend, config)
    reserve = max(capacity_for(log.length), config.session.reserve)
    return config.backend, method, config.session.precision, log.view_shape, reserve


def _build(kind: _Kind, change: Callable[[Backend], None] | None = None) -> Session:
    name, method, precision, shape, reserve = kind
    prepare_precision(precision)
    backend = build(name, method, Sensors(shape), precision)
    if change is not None:
        change(backend)
    return Session(backend, reserve=reserve, precision=precision)


_compiled = lru_cache(maxsize=2)(_build)
"""A session of any state; a recently compiled one is used again."""


class ClosureClaims(NamedTuple):
    """What n candidates of closure sequences claim, beside the truth; n is 0 for maps without candidates.

    A candidate claims that its two steps have the same position, and headings that differ by the sectors that
    its view is shifted by.

    Attributes:
        sequence: [n] number of its sequence. accepted: [n] bool. distance: [n] between the true positions, m;
            NaN where the truth is unknown. turn: [n] between the claimed difference of the headings and the
            true one, rad, not negative; NaN likewise. log_odds: [n] that its sequence is true; NaN where no
            odds decide.
    """

    sequence: np.ndarray
    accepted: np.ndarray
    distance: np.ndarray
    turn: np.ndarray
    log_odds: np.ndarray


def known_ate(poses: np.ndarray, truth: np.ndarray) -> float:
    """ATE of poses [T, 3] at the steps whose true pose [T, 3] is known, m."""
    known = np.isfinite(truth).all(axis=1)
    return ate(poses[known], truth[known])


def run_recording(
    config: RunConfig, perturbation: Perturbation | None = None, seed: int = 0
) -> tuple[RunConfig, Session, SessionResult]:
    """Maps a recording, or the perturbed copy of a seed.

    Returns:
        the configuration completed for the recording, the finished session, and its outcome, with rows of NaN
        where the truth is unknown.

    Raises:
        InputError: the recording cannot be used, or has no truth.
    """
    config, log = collect_session(config, every=False)
    if perturbation is not None:
        log = perturbation(log, seed)
    session = build_session(config, log)
    return config, session, run_session(config, log, session)


def closure_claims(map: Map, truth: np.ndarray) -> ClosureClaims:
    """The claims of all candidates in closures.csv of a map that belong to a sequence, beside true poses
    [T, 3]."""
    rows = list[dict[str, str]]()
    if (write := map.files().get("closures.csv")) is not None:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "closures.csv"
            write(path)
            table = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
        rows = [row for row in table if int(row["sequence"]) >= 0]
    step, match, shift, sequence = (
        np.array([int(row[name]) for row in rows], int)
        for name in ("step", "match_step", "shift", "sequence")
    )
    later, earlier = truth[step], truth[match]
    angle = map.feedback().angle if rows else 0.0
    accepted = np.array([row["verdict"] == "accepted" for row in rows], bool)
    distance = np.hypot(*(later - earlier)[:, :2].T)
    turn = np.abs(wrap(later[:, 2] - earlier[:, 2] + shift * angle))
    odds = np.array([float(row["log_odds"]) for row in rows], float)
    return ClosureClaims(sequence, accepted, distance, turn, odds)


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
        templates = _trained_templates(robot)
    source = TouchSource(session.source, lambda: ReportFrontend(reports, templates), "touch.reports.mounts")
    return [observation_of(sample) for sample in source]


def run_filter(
    config: RunConfig, session: ArenaSession, reports: list[Observation], stops: tuple[int, ...]
) -> list[tuple[np.ndarray, np.ndarray, OccupancyGrid]]:
    """The result of the configured filter after each number of reports in `stops`, in the frame of the arena:
    poses [T, 3] as estimated at the time, final poses [T, 3], and the map drawn along these."""
    touch = report_config_of(session.source.info, config.touch.reports)
    grid = config.grid
    if grid.side is None:
        # The filter's map is centred on the start, with a margin of 0.4 m beyond the arena.
        grid = grid.model_copy(update={"side": 2 * (session.arena.side + 0.4)})
    slam = session_at_start(grid, touch.mounts, touch.length, config.session.precision, config.session.seed)
    start, marks = session.arena.start, collect_marks(reports)
    online: list[np.ndarray] = []
    found = []
    for stop in stops:
        online += [step.pose for step in slam.replay(reports[len(online) : stop])]
        path = compose(start, slam.map.trajectory())
        drawn = draw_map(grid, touch.feelers, session.arena, path, marks)
        found.append((compose(start, np.array(online)), path, drawn))
    return found


def draw_map(
    config: GridConfig, feelers: PlanarWhiskers, arena: Arena, path: np.ndarray, marks: ContactLog
) -> OccupancyGrid:
    """The map drawn along a path [T, 3], in the frame of the arena, with twice its side (Fox et al., II-D).

    Args:
        marks: of at least T reports.
    """
    side = round(2.0 * arena.side / config.cell)
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
    session = _compiled_filter(grid, mounts, length, precision)
    session.restart(seed)
    return session


@lru_cache(maxsize=4)
def _compiled_filter(
    grid: GridConfig, mounts: tuple[WhiskerMount, ...], length: float, precision: Precision
) -> Session:
    assert grid.side is not None
    feelers = ReportFrontendConfig(mounts=mounts, length=length).feelers
    prepare_precision(precision)
    return Session(_DistinctCells(grid, feelers, grid.side, precision), precision=precision)


class _DistinctCells(GridBackend):
    def counted(self, cell: Array, contact: Array) -> Array:
        return distinct_cells(cell, contact)


def distinct_cells(cell: Array, contact: Array) -> Array:
    """bool [N, W, G]: each cell along a whisker counts once in eq. 2, and not as free where its contact is.

    Args: see `GridBackend.counted`.
    """
    same = jnp.all(cell[:, :, :, None] == cell[:, :, None], axis=-1)  # [N, W, G, G]
    earlier = np.tri(cell.shape[2], k=-1, dtype=bool)
    repeated = jnp.any(same & earlier[None, None], axis=-1)
    return ~repeated & ~(same[..., -1] & contact[None, :, None])


_trained_templates = lru_cache(maxsize=1)(train_strain_templates)
"""Templates of a robot, trained once for all sessions as in the paper."""


Control = Literal["none", "shuffled", "blank", "ideal"]
"""`none`: unchanged; `shuffled`: random order; `blank`: all zero; `ideal`: a distinct view for each spot."""


def apply_control(log: InMemorySource, control: Control, seed: int) -> InMemorySource:
    """The source with replaced views; steps without a view stay without one."""
    if control == "none":
        return log
    views = np.zeros_like(log.views)
    if control == "shuffled":
        rows = np.flatnonzero(log.seen)
        views[rows] = log.views[stream(seed, "control.shuffled").permutation(rows)]
    elif control == "ideal":
        views = _ideal_views(log, seed)
    views = np.where(log.seen[:, None, None, None], views, log.views)
    return replace(log, digest=f"{log.digest}+{control}+{seed}", views=views)


def _ideal_views(log: InMemorySource, seed: int) -> np.ndarray:
    """Random views with half of the pixels lit, one for each spot of 6 cm and each of its 8 headings."""
    assert log.truth is not None
    spot = np.round(log.truth[:, :2] / 0.06)
    sector = np.round(log.truth[:, 2] / (2 * np.pi / 8)) % 8
    kinds, row = np.unique(np.column_stack([spot, sector]), axis=0, return_inverse=True)
    random = stream(seed, "control.ideal")
    shape = (len(kinds), *log.view_shape)
    return (random.random(shape) * (random.random(shape) < 0.5))[row.reshape(-1)]
