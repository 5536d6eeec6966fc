"""One session with all mappers and methods: the task of one process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from evaluation.metrics.grid_score import GridScore, score_grid
from evaluation.metrics.occupancy_grid import OccupancyGrid
from ratslam.config.run_config import RunConfig
from ratslam.experiments.fox2012.metrics import map_metrics, path_metrics, position_error
from ratslam.experiments.fox2012.protocols import FILTERED, RECKONED, TRUE
from ratslam.experiments.trials.arena_trial import (
    ArenaSession,
    FilterResult,
    arena_truth,
    collect_marks,
    draw_map,
    observe_session,
    run_filter,
    simulate_session,
)
from robot.touch_source import report_config_of
from robot.world.arena import Arena


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


class MapperResult(NamedTuple):
    """The result of a method and a mapper after a number of reports of a session.

    Attributes:
        along: the scored path, along which the map is drawn: one of `protocols.PATHS`. stop: index of the
            stop. values: by the names of `metrics.FIELDS`; None where undefined. score: of the map.
        truth, odometry, online: [T, 3] poses in the frame of the arena.
    """

    world: str
    method: str
    mapper: str
    along: str
    number: int
    seed: int
    stop: int
    reports: int
    values: dict[str, float | None]
    score: GridScore
    grid: OccupancyGrid
    arena: Arena
    truth: np.ndarray
    odometry: np.ndarray
    online: np.ndarray


def run_job(job: SessionJob) -> list[MapperResult]:
    """The results of all variants on a session, and of their marks along paths without a filter.

    Raises:
        InputError: the session cannot be simulated.
    """
    some = next(iter(job.variants.values()))
    assert some.create_simulation is not None
    session = simulate_session(some.create_simulation)
    count = len(session.truth)
    stops = tuple(min(stop, count) if stop else count for stop in job.stops)
    found: list[MapperResult] = []
    for (method, mapper), config in job.variants.items():
        reports = observe_session(config, session, job.training)
        marks = collect_marks(reports)
        feelers = report_config_of(session.source.info, config.touch.reports).feelers
        for stop, filtered in enumerate(run_filter(config, session, reports, stops)):
            found.append(_score(job, session, (method, mapper, FILTERED), stop, filtered))
            for name, whole in ((RECKONED, session.odometry), (TRUE, session.truth)):
                path = whole[: stops[stop]]
                drawn = FilterResult(path, path, draw_map(config.grid, feelers, session.arena, path, marks))
                found.append(_score(job, session, (method, mapper, name), stop, drawn))
    return found


def _score(
    job: SessionJob, session: ArenaSession, which: tuple[str, str, str], stop: int, one: FilterResult
) -> MapperResult:
    count = len(one.path)
    truth, odometry = session.truth[:count], session.odometry[:count]
    score = score_grid(one.grid, arena_truth(session.arena, one.grid), which[1])
    values = path_metrics(one.online, one.path, truth) | map_metrics(score)
    values["odometry_error"] = position_error(odometry, truth)
    return MapperResult(
        job.world, *which, job.number, job.seed, stop, count, values, score, one.grid, session.arena,
        truth, odometry, one.online,
    )  # fmt: skip
