"""The figures of Salman & Pearson 2016 made again on simulated sessions, with controls beside them.

A set is a maze, a path with its jitter and the odometry's errors, all from one seed; every condition and
method of a reproduction sees the same sets, so their differences are paired.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.experience_metric import experience_metric
from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import override, parse, validate
from ratslam.experiments.salman2016.claims import Row, table
from ratslam.experiments.salman2016.direction_metrics import extras
from ratslam.experiments.salman2016.plots import picture
from ratslam.experiments.salman2016.protocols import (
    COMMON,
    METHODS,
    PROTOCOLS,
    SWEPT,
    THRESHOLDS,
    Condition,
    Protocol,
)
from ratslam.experiments.trials.controls import Control
from ratslam.experiments.trials.csv_output import cells, filled, named, progress
from ratslam.experiments.trials.process_pool import shared_out
from ratslam.experiments.trials.threshold_sweep import classics
from ratslam.experiments.trials.touch_trial import (
    Played,
    Task,
    TouchTrial,
    chain_free,
    figures,
    played,
    session_log,
)
from tactile.base.random_streams import stream

KEPT = 3
"""Sets of a condition, as in the paper (III-C)."""
FIELDS = (
    *TouchTrial._fields,
    "ratio",
    "counterparts",
    "first_anticlockwise",
    "last_anticlockwise",
    "rightly",
    "apart",
    "across",
    "across_share",
    "threshold",
)
"""Columns of figures in NAME.csv."""
HEADING = ("condition", "method", "control", "set", "seed", *FIELDS)
"""Of NAME.csv."""


class Job(NamedTuple):
    """One session of a reproduction, and where it belongs."""

    condition: Condition
    method: str
    control: str
    number: int
    task: Task
    word: str


def reproduce(
    name: str,
    directory: Path,
    *,
    sets: int = KEPT,
    workers: int = 0,
    seed: int = 0,
    assignments: Sequence[str] = (),
) -> tuple[str, bool]:
    """Runs a reproduction; leaves NAME.csv (each row as soon as it is known) and NAME.png in a folder.

    Args:
        name: of a protocol. directory: made where there is none. sets: of each condition. workers: processes;
            0: as many as there are cores. seed: of all sets. assignments: overrides for all, as `a.b=value`.

    Returns:
        the table, and whether the user interrupted (it then tells of what was finished).

    Raises:
        InputError: no such reproduction, it is there already, or a session cannot be simulated.
    """
    protocol = named(name, PROTOCOLS)
    jobs = jobs_of(protocol, sets, seed, assignments)
    rows: list[Row] = []
    sessions: dict[tuple[str, str], tuple[str, Played]] = {}

    def lines() -> Iterator[list[list[object]]]:
        for row, job, result in _run(name, protocol, jobs, workers):
            rows.append(_completed(row, rows))
            yield [[*rows[-1][:5], *cells(rows[-1].values, FIELDS)]]
            if result is not None and job.number == 0 and job.control == "as felt":
                sessions[job.condition.name, job.method] = job.word, result

    interrupted = filled(directory / f"{name}.csv", HEADING, lines())
    if rows and not interrupted:
        picture(name, protocol, rows, sessions).savefig(directory / f"{name}.png")
    return table(protocol, rows, sets), interrupted


def jobs_of(protocol: Protocol, sets: int, seed: int, assignments: Sequence[str] = ()) -> list[Job]:
    """All sessions of a reproduction, a set after the other.

    Raises:
        InputError: an assignment that cannot be.
    """
    jobs = []
    for number in range(sets):
        own = set_seed(seed, number)
        methods = ["classic"] if protocol.swept else list(METHODS)
        for method in methods:
            for condition in protocol.conditions:
                config = configured(condition, method, own, assignments)
                assert config.simulation is not None
                laps = config.simulation.path.circuits
                word = laps[: condition.laps] if condition.laps else laps
                for control in _controls(protocol, condition, method):
                    does = condition.control if control == "as felt" else control
                    task = Task(config, does, own, min(condition.laps, len(laps)))
                    jobs.append(Job(condition, method, control, number, task, word))
    return jobs


def configured(condition: Condition, method: str, seed: int, assignments: Sequence[str] = ()) -> RunConfig:
    """The configuration of a condition's session through a method."""
    transform = next(
        value for key, _, value in map(_parted, condition.sets) if key == "touch.image.transform"
    )
    own = (f"templates.threshold={THRESHOLDS[transform]}",) if method == "classic" else ()
    document = parse("simulation: {}\n", "the reproduction")
    every = [f"simulation.seed={seed}", *COMMON, *METHODS[method], *own, *condition.sets, *assignments]
    return validate(override(document, every), RunConfig)


def set_seed(seed: int, number: int) -> int:
    """The seed of a set."""
    return int(stream(seed, f"reproduce.set.{number}").integers(2**31))


def matched(rows: Sequence[Row], conditions: Sequence[str]) -> dict[str, Row]:
    """Of each condition the threshold with the most re-localisations that reaches the highest strict ARCR
    which all of them reach; conditions without any re-localisation are left out.

    Args:
        rows: of the sweeps of one set.
    """
    of = {
        name: [row for row in rows if row.condition == name and np.isfinite(row.values["arcr"])]
        for name in conditions
    }
    of = {name: found for name, found in of.items() if found}
    if not of:
        return {}
    level = min(max(row.values["arcr"] for row in found) for found in of.values())
    return {
        name: max((row for row in found if row.values["arcr"] >= level), key=lambda row: row.values["arr"])
        for name, found in of.items()
    }


def _run(
    name: str, protocol: Protocol, jobs: list[Job], workers: int
) -> Iterator[tuple[Row, Job, Played | None]]:
    """The rows in the order of the jobs; of sweeps, first all thresholds and then the matched ones."""
    if not protocol.swept:
        with progress(name, len(jobs)) as bar:
            for job, result in zip(
                jobs, shared_out(_played, [job.task for job in jobs], workers), strict=True
            ):
                yield _row(job, result, job.word), job, result
                bar.update()
        return
    swept: list[Row] = []
    with progress(f"{name}, thresholds", len(jobs)) as bar:
        for job, found in zip(jobs, shared_out(_swept, [job.task for job in jobs], workers), strict=True):
            for values in found:
                row = Row(job.condition.name, job.method, "sweep", job.number, job.task.seed, values)
                swept.append(row)
                yield row, job, None
            bar.update()
    chosen = []
    for job in jobs:
        like = [
            c.name
            for c in protocol.conditions
            if c.name.split(", ")[1:] == job.condition.name.split(", ")[1:]
        ]
        best = matched([row for row in swept if row.number == job.number], like).get(job.condition.name)
        if best is not None:
            templates = job.task.config.templates.model_copy(update={"threshold": best.values["threshold"]})
            task = job.task._replace(config=job.task.config.model_copy(update={"templates": templates}))
            chosen.append((job._replace(task=task), best.values["threshold"]))
    with progress(f"{name}, matched", len(chosen)) as bar:
        results = shared_out(_played, [job.task for job, _ in chosen], workers)
        for (job, threshold), result in zip(chosen, results, strict=True):
            row = _row(job, result, job.word)
            yield row._replace(values={**row.values, "threshold": threshold}), job, result
            bar.update()


def _played(task: Task) -> Played:
    return played(task)


def _swept(task: Task) -> list[dict[str, float]]:
    """The classic matcher's figures at every threshold, without maps."""
    config, log = session_log(task.config)
    batch = classics(config, log, np.array(SWEPT))
    found = []
    for threshold, place in zip(SWEPT, batch.place, strict=True):
        metric = experience_metric(place, np.asarray(log.truth), config.score.experience_metric)
        found.append(
            {
                "threshold": threshold,
                "arr": metric.arr,
                "arcr": metric.arcr,
                "near": chain_free(metric),
                "relocalisations": metric.relocalisations,
            }
        )
    return found


def _row(job: Job, result: Played, word: str) -> Row:
    trial = figures(result, job.task.config.score.experience_metric)
    values: dict[str, float] = trial._asdict() | {
        "ratio": trial.em / trial.em_odometry if trial.em_odometry else np.nan
    }
    return Row(
        job.condition.name, job.method, job.control, job.number, job.task.seed, values | extras(result, word)
    )


def _completed(row: Row, before: Sequence[Row]) -> Row:
    """The row with what only the others of its set tell."""
    plain = [r for r in before if (r.condition, r.method, r.number) == ("as felt", row.method, row.number)]
    if not plain or "across" not in row.values or not plain[0].values["across"]:
        return row
    share = row.values["across"] / plain[0].values["across"]
    return row._replace(values={**row.values, "across_share": share})


def _controls(protocol: Protocol, condition: Condition, method: str) -> tuple[Control, ...]:
    if not protocol.controls:
        return ("as felt",)
    # Without images the classic matcher matches everything with everything: only its chance level is told.
    return ("as felt", "shuffled", "blank") if method == "ours" else ("as felt", "shuffled")


def _parted(assignment: str) -> tuple[str, str, str]:
    return assignment.partition("=")
