"""The grid-filter table: a simulated Create in arenas never used for tuning; the rows name changed settings.

Errors are means over all reports of the distance between the online pose and the true pose, with the start
known and without alignment, beside those of dead reckoning.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.occupancy_score import score_grid
from evaluation.metrics.trajectory import position_error
from evaluation.papers.tables.comparison import measured_rows
from evaluation.papers.tables.markdown import markdown_header, markdown_row, select_rows
from evaluation.papers.trial_sessions import session_at_start
from ratslam.core.compilation import prepare_precision
from ratslam.runs.build_session import open_source, read_observations
from ratslam.runs.run_directory import true_grid
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.run_config import RunConfig
from robot.simulation.create.wheel_odometry import MEAN_ERRORS
from robot.sources.odometry import correct_observations
from robot.touch_source import open_touch_source, report_config_of
from robot.world.arena import Arena, wall_segments
from robot.world.walls import segment_distance
from tactile.base.se2 import compose, integrate
from tactile.base.types import MotionKind, Observation

_WORLDS: dict[str, dict[str, Any]] = {
    "A": {"arena": {"side": 1.25}, "reports": 900},
    "B": {"arena": {"side": 2.5}, "reports": 1500},
    "rotated": {"arena": {"side": 1.25, "rotated": True}, "reports": 900},
}
AS_PRINTED = {
    "likelihood": {"model": "literal"},
    "drift": {"session": 0.0, "move": 0.0, "step": 0.05},
    "resampling": {"schedule": "always", "scheme": "multinomial"},
    "footprint": {"wall": "edge", "along": 0.25},
}
ODOMETRY_ERRORS = {
    "bias": "one scale for the run",
    "move": "one for each straight or turn",
    "white": "new in each step",
    "measured": "as of real Creates",
    "measured, calibrated": "as of real Creates, mean scales corrected",
}
_NO_WALLS, _GEOMETRIC = ({"touch": {"reports": {"walls": walls}}} for walls in ("none", "geometric"))
_WIDE_DRIFT = {"grid": {"drift": {"heading_rate": 2e-3, "move": 0.08}}}
"""A heading drift of 0.12 rad/min, the RMS of real Creates, and larger errors of single moves."""
ROWS: dict[str, dict[str, Any]] = {
    "bias": {},
    "move": {},
    "white": {},
    "measured": {},
    "measured, calibrated": {},
    "measured, blobs only": _NO_WALLS,
    "measured, wide drift": _WIDE_DRIFT,
    "measured, calibrated, wide drift": _WIDE_DRIFT,
    "bias, wide drift": _WIDE_DRIFT,
    "move, wide drift": _WIDE_DRIFT,
    "bias, blobs only": _NO_WALLS,
    "move, blobs only": _NO_WALLS,
    "bias, geometric": _GEOMETRIC,
    "move, geometric": _GEOMETRIC,
    "bias, as printed": {"grid": AS_PRINTED},
    "move, as printed": {"grid": AS_PRINTED},
    "bias without run errors": {"grid": {"drift": {"session": 0.0}}},
    "move, temper 1, prior 0.3": {"grid": {"likelihood": {"free": 1.0, "unexplored": 0.3}}},
    "bias, BACK skipped": {},
    "move, BACK skipped": {},
    "bias, 1000 particles": {"grid": {"particles": 1000}},
    "move, 1000 particles": {"grid": {"particles": 1000}},
    "move, no compass": {"grid": {"likelihood": {"wall_direction_prior": False}}},
}
"""Settings; the name begins with the model of the odometry errors."""
DEFAULT_ROWS = (
    *((world, row) for world in "AB" for row in ODOMETRY_ERRORS),
    ("A", "bias, blobs only"),
    ("A", "bias, geometric"),
    ("A", "measured, wide drift"),
    ("B", "measured, wide drift"),
)
COLUMNS = (
    "arenas, odometry errors", "dead reckoning", "ratslam", "ratio", "below half, below",
    "wall angle off, beyond 15 degrees, estimated",
    "wall AUC, Brier skill (free), Chamfer both ways",
)  # fmt: skip


GridFigures = tuple[float, float, np.ndarray, int, list[float]]
"""The figures of one session: mean position error of the filter and of dead reckoning, m; [n] errors of the
wall directions given to the filter, rad; number of contacts that could give one; AUC, Brier skill, Brier
skill of free space alone, Chamfer map to walls and walls to map, m."""


def grid_table(
    rows: Sequence[str] | None = None,
    worlds: Sequence[str] | None = None,
    arenas: int = 10,
    first: int = 9000,
    workers: int = 0,
) -> Iterator[str]:
    """The lines of the table, each as soon as its sessions are done.

    Args:
        rows, worlds: each row in each world; without both `DEFAULT_ROWS`. first: seed of the first arena.

    Raises:
        InputError: no such row.
    """
    names = select_rows(rows, ROWS, tuple(ODOMETRY_ERRORS))
    places = [(world, row) for world in worlds or "AB" for row in names] if rows or worlds else DEFAULT_ROWS
    tasks = {
        f"{world}, {ODOMETRY_ERRORS.get(row, row)}": {
            str(arena): (world, row, arena) for arena in range(first, first + arenas)
        }
        for world, row in places
    }
    yield markdown_header(COLUMNS)
    for row, found in measured_rows(measure_session, tasks, workers):
        yield markdown_row([row, *_cells(found)])


def task_config(world: str, row: str, arena: int) -> RunConfig:
    """The configuration of a session of a row in the arena with this seed."""
    noise = row.replace(",", " ").split()[0]
    create_simulation = _WORLDS[world] | {"wheels": {"noise": noise}, "seed": arena}
    given = {"create_simulation": create_simulation, "backend": "grid", "session": {"precision": "float32"}}
    return RunConfig.model_validate(given | ROWS[row])


def measure_session(task: tuple[str, str, int]) -> GridFigures:
    """Runs and measures one session: of a world, a row and the seed of an arena."""
    world, row, _ = task
    prepare_precision("float64")
    config = task_config(*task)
    source: Any = open_source(config)
    config = complete(config, source)
    # The map has one size for all arenas of a world, so that the filter compiles once.
    grid = config.grid.model_copy(update={"side": 2 * _WORLDS[world]["arena"]["side"]})
    samples = list(read_observations(open_touch_source(source, config.touch)))
    truth = np.array([sample.truth for sample, _ in samples])
    observations = [observation for _, observation in samples]
    start = source.arena.start
    if "calibrated" in row:
        observations = correct_observations(MEAN_ERRORS, observations)
    moves = np.array([observation.odometry[:3] for observation in observations])
    if "BACK skipped" in row:
        still = observations[0].odometry._replace(dx=0.0, dy=0.0, dtheta=0.0, dt=0.5)
        observations = [
            o._replace(odometry=still) if o.motion == MotionKind.BACK else o for o in observations
        ]
    touch = report_config_of(source.info, config.touch.reports)
    session = session_at_start(grid, touch.mounts, touch.length, "float32", config.session.seed)
    online = np.array([step.pose for step in session.replay(observations)])
    walls = [(pose, each) for pose, each in zip(truth, observations, strict=True) if each.wall]
    readings = (sample.reading for sample in source)
    map: Any = session.map
    drawn = OccupancyGrid(map.occupancy(), np.full(2, -map.side * map.config.cell / 2), map.config.cell)
    scores = score_grid(drawn, true_grid(source.arena, drawn)).quantities
    names = ("map_auc", "map_brier_skill", "map_brier_skill_free", "map_chamfer_map", "map_chamfer_walls")
    values = [scores[name].value for name in names]
    return (
        position_error(compose(start, online), truth),
        position_error(integrate(moves, start), truth),
        np.array([_wall_error(source.arena, pose, observation) for pose, observation in walls]),
        sum(each.moment >= 2 and each.motion == MotionKind.FORWARD for each in readings),
        [np.nan if value is None else float(value) for value in values],
    )


def _wall_error(arena: Arena, pose: np.ndarray, observation: Observation) -> float:
    """Angle between an estimated wall direction and the wall segment nearest to the contact, rad."""
    foot = observation.wall_point
    normal = foot / np.hypot(*foot)
    middle = observation.point[observation.contact].mean(axis=0)
    contact = compose(pose, np.array([*(middle + normal * (np.hypot(*foot) - normal @ middle)), 0.0]))[:2]
    walls = wall_segments(arena)
    wall = walls[int(np.argmin(segment_distance(walls, contact[None])[0]))]
    true = np.arctan2(wall[3] - wall[1], wall[2] - wall[0])
    error = pose[2] + np.arctan2(normal[1], normal[0]) + np.pi / 2 - true
    return float(abs((error + np.pi / 2) % np.pi - np.pi / 2))


def _cells(found: Sequence[GridFigures]) -> list[str]:
    errors, reckoned, wall_errors, contacts, maps = zip(*found, strict=True)
    error, odometry = np.array(errors), np.array(reckoned)
    walls = np.degrees(np.concatenate(wall_errors))
    share = len(walls) / max(sum(contacts), 1)
    auc, skill, free, to_walls, to_map = np.nanmean(maps, axis=0)
    wall = f"{walls.mean():.1f} degrees, {(walls > 15.0).mean():.0%}, {share:.0%}"
    return [
        f"{odometry.mean():.3f} m",
        f"{error.mean():.3f}",
        f"{error.mean() / odometry.mean():.2f}",
        f"{(error < 0.5 * odometry).sum()}, {(error < odometry).sum()} of {len(found)}",
        wall if len(walls) else "-",
        f"{auc:.3f}, {skill:.2f} ({free:.2f}), {to_walls:.3f} and {to_map:.3f} m",
    ]
