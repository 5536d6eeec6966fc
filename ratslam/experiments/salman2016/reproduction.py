"""Runs a protocol: all its conditions, methods and controls over the same sets.

A set is a maze, a path with its jitter and the errors of the odometry, all from one seed. All conditions and
methods of a reproduction run on the same sets, so their differences are paired.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.experience_metric import experience_metric
from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import override, parse, validate
from ratslam.experiments.salman2016.claims import Row, render_claims
from ratslam.experiments.salman2016.direction_metrics import DIRECTION_METRICS, direction_metrics
from ratslam.experiments.salman2016.plots import draw_reproduction
from ratslam.experiments.salman2016.protocols import (
    COMMON,
    METHODS,
    PROTOCOLS,
    SWEPT,
    THRESHOLDS,
    Condition,
    Protocol,
)
from ratslam.experiments.studies.executor import run_tasks
from ratslam.experiments.trials.csv_output import find_protocol, format_cells, progress_bar, write_rows
from ratslam.experiments.trials.threshold_sweep import sweep_thresholds
from ratslam.experiments.trials.touch_trial import (
    SessionResult,
    TouchMetrics,
    TrialTask,
    arcr_without_chain,
    collect_session,
    run_task,
    touch_metrics,
)
from tactile.base.random_streams import stream

FIELDS = (*TouchMetrics._fields, "em_ratio", *DIRECTION_METRICS, "across_share", "threshold")
"""Columns of metrics in NAME.csv."""
HEADING = ("condition", "method", "control", "set", "seed", *FIELDS)


class TrialJob(NamedTuple):
    """One session of a reproduction; `laps` holds the direction of each lap, C or A."""

    condition: Condition
    method: str
    control: str
    number: int
    task: TrialTask
    laps: str


def reproduce(
    name: str,
    directory: Path,
    *,
    sets: int = 3,
    workers: int = 0,
    seed: int = 0,
    assignments: Sequence[str] = (),
) -> tuple[str, bool]:
    """Runs a reproduction; writes NAME.csv, row by row, and NAME.png to a folder.

    Args:
        name: of a protocol. directory: created if missing. sets: per condition; the paper has 3 (III-C).
            workers: processes; 0: one per core. seed: of all sets. assignments: overrides as `a.b=value`.

    Returns:
        the table, and whether the user interrupted (the table is then of the finished sessions).

    Raises:
        InputError: no such reproduction, NAME.csv exists, or a session cannot be simulated.
    """
    protocol = find_protocol(name, PROTOCOLS)
    jobs = plan_jobs(protocol, sets, seed, assignments)
    rows: list[Row] = []
    sessions: dict[tuple[str, str], tuple[str, SessionResult]] = {}

    def batches() -> Iterator[list[list[object]]]:
        run = _run_sweeps if protocol.swept else _run_sessions
        for row, job, result in run(name, protocol, jobs, workers):
            rows.append(_with_across_share(row, rows))
            yield [[*rows[-1][:5], *format_cells(rows[-1].values, FIELDS)]]
            if result is not None and job.number == 0 and job.control == "none":
                sessions[job.condition.name, job.method] = job.laps, result

    interrupted = write_rows(directory / f"{name}.csv", HEADING, batches())
    if rows and not interrupted:
        draw_reproduction(name, protocol, rows, sessions).savefig(directory / f"{name}.png")
    return render_claims(protocol, rows, sets), interrupted


def plan_jobs(protocol: Protocol, sets: int, seed: int, assignments: Sequence[str] = ()) -> list[TrialJob]:
    """All sessions of a reproduction, set by set.

    Raises:
        InputError: an invalid assignment.
    """
    jobs = []
    for number in range(sets):
        set_seed = int(stream(seed, f"reproduce.set.{number}").integers(2**31))
        for method in ["classic"] if protocol.swept else METHODS:
            for condition in protocol.conditions:
                config = session_config(condition, method, set_seed, assignments)
                assert config.simulation is not None
                laps = config.simulation.path.circuits
                laps = laps[: condition.laps] if condition.laps else laps
                for control in _controls(protocol, method):
                    change = condition.control if control == "none" else control
                    task = TrialTask(config, change, set_seed, len(laps) if condition.laps else 0)
                    jobs.append(TrialJob(condition, method, control, number, task, laps))
    return jobs


def session_config(
    condition: Condition, method: str, seed: int, assignments: Sequence[str] = ()
) -> RunConfig:
    """The configuration of a condition's session with a method."""
    threshold = (f"templates.threshold={THRESHOLDS[condition.transform]}",) if method == "classic" else ()
    document = parse("simulation: {}\n", "the reproduction")
    settings = [f"simulation.seed={seed}", *COMMON, *METHODS[method], *threshold, *condition.sets]
    return validate(override(document, [*settings, *assignments]), RunConfig)


def match_thresholds(rows: Sequence[Row], conditions: Sequence[str]) -> dict[str, Row]:
    """Chooses one threshold for each condition so that the conditions have matched strict ARCR.

    The level is the highest ARCR that all conditions reach; chosen is the threshold with the most
    re-localisations among those at or above it. Conditions without re-localisations are left out.

    Args:
        rows: of the sweeps of one set.
    """
    sweeps = {
        name: [row for row in rows if row.condition == name and np.isfinite(row.values["arcr"])]
        for name in conditions
    }
    sweeps = {name: found for name, found in sweeps.items() if found}
    if not sweeps:
        return {}
    level = min(max(row.values["arcr"] for row in found) for found in sweeps.values())
    return {
        name: max((row for row in found if row.values["arcr"] >= level), key=lambda row: row.values["arr"])
        for name, found in sweeps.items()
    }


Outcome = tuple[Row, TrialJob, SessionResult | None]


def _run_sessions(name: str, protocol: Protocol, jobs: Sequence[TrialJob], workers: int) -> Iterator[Outcome]:
    for job, result in _results(run_task, name, jobs, workers):
        yield _row(job, result), job, result


def _run_sweeps(name: str, protocol: Protocol, jobs: Sequence[TrialJob], workers: int) -> Iterator[Outcome]:
    """First the sweeps over all thresholds, then a session at the matched threshold of each condition."""
    swept: list[Row] = []
    for job, found in _results(_sweep, f"{name}, thresholds", jobs, workers):
        for values in found:
            row = Row(job.condition.name, job.method, "sweep", job.number, job.task.seed, values)
            swept.append(row)
            yield row, job, None
    chosen = []
    for job in jobs:
        rows = [row for row in swept if row.number == job.number]
        best = match_thresholds(rows, protocol.same_noise(job.condition)).get(job.condition.name)
        if best is not None:
            config = job.task.config
            templates = config.templates.model_copy(update={"threshold": best.values["threshold"]})
            task = job.task._replace(config=config.model_copy(update={"templates": templates}))
            chosen.append(job._replace(task=task))
    for job, result in _results(run_task, f"{name}, matched", chosen, workers):
        row = _row(job, result)
        values = {**row.values, "threshold": job.task.config.templates.threshold}
        yield row._replace(values=values), job, result


def _results(
    function: Callable[[TrialTask], Any], title: str, jobs: Sequence[TrialJob], workers: int
) -> Iterator[tuple[TrialJob, Any]]:
    """The function's result for the task of each job, in order, with a progress bar."""
    with progress_bar(title, len(jobs)) as bar:
        for job, result in zip(
            jobs, run_tasks(function, [job.task for job in jobs], workers=workers), strict=True
        ):
            yield job, result
            bar.update()


def _sweep(task: TrialTask) -> list[dict[str, float]]:
    """The Experience Metric of the classic method at all thresholds, without maps."""
    config, log = collect_session(task.config)
    batch = sweep_thresholds(config, log, np.array(SWEPT))
    truth, settings = np.asarray(log.truth), config.score.experience_metric
    metrics = [experience_metric(place, truth, settings) for place in batch.place]
    return [
        {
            "threshold": threshold,
            "arr": metric.arr,
            "arcr": metric.arcr,
            "arcr_chain_free": arcr_without_chain(metric),
            "relocalisations": metric.relocalisations,
        }
        for threshold, metric in zip(SWEPT, metrics, strict=True)
    ]


def _row(job: TrialJob, result: SessionResult) -> Row:
    metrics = touch_metrics(result, job.task.config.score.experience_metric)
    ratio = metrics.em / metrics.em_odometry if metrics.em_odometry else np.nan
    values = {**metrics._asdict(), "em_ratio": ratio, **direction_metrics(result, job.laps)}
    return Row(job.condition.name, job.method, job.control, job.number, job.task.seed, values)


def _with_across_share(row: Row, before: Sequence[Row]) -> Row:
    """The row with its closures across the change of mazes as a share of those of the set's plain session."""
    plain = [r for r in before if (r.condition, r.method, r.number) == ("unchanged", row.method, row.number)]
    if not plain or "across" not in row.values or not plain[0].values["across"]:
        return row
    share = row.values["across"] / plain[0].values["across"]
    return row._replace(values={**row.values, "across_share": share})


def _controls(protocol: Protocol, method: str) -> tuple[Any, ...]:
    if not protocol.controls:
        return ("none",)
    # Without images the classic method matches all steps; it is compared with its chance level only.
    return ("none", "shuffled", "blank") if method == "ours" else ("none", "shuffled")
