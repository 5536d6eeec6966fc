"""One session through every mapper and method, as one piece of work for a process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from evaluation.metrics.grid_score import GridScore, score_grid
from evaluation.metrics.occupancy_grid import OccupancyGrid
from ratslam.config.run_config import RunConfig
from ratslam.experiments.fox2012.metrics import measured, off, scored
from ratslam.experiments.fox2012.protocols import FILTERED, RECKONED, TRUE
from ratslam.experiments.fox2012.session import (
    Mapped,
    Outing,
    chart,
    felt,
    felt_marks,
    mapped,
    outing,
    truth_of,
)
from robot.touch_source import report_config_of
from robot.world.arena import Arena


class Job(NamedTuple):
    """A session.

    Attributes:
        seed: of the session. training: of the strain templates. stops: numbers of reports after which is
            judged; 0: all. variants: by method and mapper; all of one session.
    """

    world: str
    number: int
    seed: int
    training: int
    stops: tuple[int, ...]
    variants: Mapping[tuple[str, str], RunConfig]


class Result(NamedTuple):
    """What came of a method and a mapper after so many reports of a session.

    Attributes:
        along: the path its marks are drawn along and that is judged: one of `protocols.PATHS`. stop: the
        number of the stop. values: by the names of `figures.FIELDS`; None where there is none. score: of the
        map. truth, odometry, told: [T, 3] poses in the frame of the arena.
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
    told: np.ndarray


def run_job(job: Job) -> list[Result]:
    """All of a session's: what each variant's filter found, and its marks along paths that no filter found.

    Raises:
        InputError: it cannot be simulated.
    """
    some = next(iter(job.variants.values()))
    assert some.create_simulation is not None
    out = outing(some.create_simulation)
    count = len(out.truth)
    stops = tuple(min(stop, count) if stop else count for stop in job.stops)
    found: list[Result] = []
    for (method, mapper), config in job.variants.items():
        reports = felt(config, out, job.training)
        marks, feelers = felt_marks(reports), report_config_of(out.source.info, config.touch.reports).feelers
        for stop, filtered in enumerate(mapped(config, out, reports, stops)):
            found.append(_judged(job, out, (method, mapper, FILTERED), stop, filtered))
            for name, whole in ((RECKONED, out.odometry), (TRUE, out.truth)):
                path = whole[: stops[stop]]
                drawn = Mapped(path, path, chart(config.grid, feelers, out.arena, path, marks))
                found.append(_judged(job, out, (method, mapper, name), stop, drawn))
    return found


def _judged(job: Job, out: Outing, which: tuple[str, str, str], stop: int, one: Mapped) -> Result:
    count = len(one.path)
    truth, odometry = out.truth[:count], out.odometry[:count]
    score = score_grid(one.grid, truth_of(out.arena, one.grid), which[1])
    values = measured(one.told, one.path, truth) | {"reckoned": off(odometry, truth)} | scored(score)
    return Result(
        job.world, *which, job.number, job.seed, stop, count, values, score, one.grid, out.arena,
        truth, odometry, one.told,
    )  # fmt: skip
