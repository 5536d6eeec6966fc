"""Runs a protocol: each session through all mappers and methods.

A set is a session: an arena, a start, the behaviour of the robot and the errors of its odometry, all from one
seed. All mappers and methods run on the same sets, so their differences are paired.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np

from evaluation.metrics.grid_error import CONVENTIONS
from evaluation.metrics.grid_score import GridScore, score_grid
from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.revisits import path_metrics
from evaluation.metrics.trajectory import position_error
from ratslam.config.run_config import RunConfig
from ratslam.experiments.fox2012.protocols import (
    FILTERED,
    PROTOCOLS,
    RECKONED,
    TRUE,
    Protocol,
    session_config,
)
from ratslam.experiments.fox2012.report import draw_reproduction, render_results
from ratslam.experiments.trials.arena_trial import (
    ArenaSession,
    FilterResult,
    collect_marks,
    draw_map,
    observe_session,
    run_filter,
    simulate_session,
)
from ratslam.experiments.trials.reproduction import Paper, ResultRow, run_with_progress
from ratslam.pipeline.artifacts import true_grid
from robot.touch_source import report_config_of
from robot.world.arena import Arena
from tactile.base.random_streams import stream

KEY = ("world", "method", "mapper", "along")
"""Names of a result; the map is drawn `along` the scored path: `FILTERED`, `RECKONED` or `TRUE`."""
MAP_METRICS = (
    "map_brier_skill", "map_brier_skill_free", "map_log_loss", "map_auc", "map_auc_free", "map_chamfer_map",
    "map_chamfer_walls",
)  # fmt: skip
FIELDS = (
    "reports", "online_error", "final_error", "online_heading_error_deg", "revisits", "revisits_closed",
    "revisit_gap", "odometry_error", *(each.column for each in CONVENTIONS), *MAP_METRICS,
)  # fmt: skip
"""Columns of metrics in NAME.csv."""


class SessionJob(NamedTuple):
    """A session to simulate and filter.

    Attributes:
        seed: of the session. training: seed of the strain templates. stops: numbers of reports after which
            the result is scored; 0: all. variants: configurations by method and mapper.
    """

    world: str
    number: int
    seed: int
    training: int
    stops: tuple[int, ...]
    variants: Mapping[tuple[str, str], RunConfig]


class MapResult(NamedTuple):
    """The map and the paths [T, 3] of a row, in the frame of the arena; `stop` is the index of its stop."""

    stop: int
    score: GridScore
    grid: OccupancyGrid
    arena: Arena
    truth: np.ndarray
    odometry: np.ndarray
    online: np.ndarray


def plan_jobs(protocol: Protocol, sets: int, seed: int, assignments: Sequence[str] = ()) -> list[SessionJob]:
    """All sessions of a reproduction, set by set.

    Raises:
        InputError: an invalid assignment.
    """
    jobs = []
    for number, world in product(range(sets), protocol.worlds):
        own = int(stream(seed, f"arenas.set.{number}").integers(2**31))
        arena = seed if protocol.one_arena else own
        session, where = f"create_simulation.seed={own}", f"create_simulation.arena.seed={arena}"
        settings = (session, where, f"session.seed={own}", *assignments)
        variants = {
            (method, mapper): session_config(world, method, mapper, settings)
            for method, mapper in product(protocol.methods, protocol.mappers)
        }
        jobs.append(SessionJob(world.name, number, own, seed, protocol.stops, variants))
    return jobs


def run_job(job: SessionJob) -> list[ResultRow]:
    """The results of all variants on a session, and of their marks along paths without a filter.

    Raises:
        InputError: the session cannot be simulated.
    """
    some = next(iter(job.variants.values()))
    assert some.create_simulation is not None
    session = simulate_session(some.create_simulation)
    count = len(session.truth)
    stops = tuple(min(stop, count) if stop else count for stop in job.stops)
    found: list[ResultRow] = []
    for variant, config in job.variants.items():
        reports = observe_session(config, session, job.training)
        marks = collect_marks(reports)
        feelers = report_config_of(session.source.info, config.touch.reports).feelers
        for stop, filtered in enumerate(run_filter(config, session, reports, stops)):
            found.append(_score(job, session, (*variant, FILTERED), stop, filtered))
            for name, whole in ((RECKONED, session.odometry), (TRUE, session.truth)):
                path = whole[: stops[stop]]
                drawn = FilterResult(path, path, draw_map(config.grid, feelers, session.arena, path, marks))
                found.append(_score(job, session, (*variant, name), stop, drawn))
    return found


def _score(
    job: SessionJob, session: ArenaSession, key: tuple[str, str, str], stop: int, one: FilterResult
) -> ResultRow:
    count = len(one.path)
    truth, odometry = session.truth[:count], session.odometry[:count]
    score = score_grid(one.grid, true_grid(session.arena._replace(start=np.zeros(3)), one.grid), key[1])
    values = {
        "reports": count,
        "odometry_error": position_error(odometry, truth),
        **path_metrics(one.online, one.path, truth),
        **{error.convention.column: error.error for error in score.errors},
        **{name: score.quantities[name].value for name in MAP_METRICS},
    }
    result = MapResult(stop, score, one.grid, session.arena, truth, odometry, one.online)
    return ResultRow((job.world, *key), job.number, job.seed, values, result)


_run = partial(run_with_progress, run_job)
PAPER = Paper(PROTOCOLS, KEY, FIELDS, plan_jobs, _run, draw_reproduction, render_results)
