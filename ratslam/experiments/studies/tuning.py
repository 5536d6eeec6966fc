"""Tuning on several objectives at once, by Optuna, on the jobs of a study.

A set of parameters is a configuration like any other: its runs leave the same files, and none is run twice.
"""

from __future__ import annotations

import hashlib
import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ratslam.experiments.studies.config_hash import digest_of
from ratslam.experiments.studies.optuna_storage import Trial, opened
from ratslam.experiments.studies.recorded_runs import Pool
from ratslam.experiments.studies.results import Result
from ratslam.experiments.studies.schema import TunePlan
from ratslam.experiments.studies.study import Job, Study, made, seeded, tuned, variant_of
from tactile.base.atomic_write import write_text_atomically
from tactile.base.errors import InputError

Done = Callable[[Result | None], None]


def tune(
    study: Study, directory: Path, workers: int = 0, scheduler: str | None = None, done: Done | None = None
) -> list[Trial]:
    """Tries as many sets of parameters as the study asks for, with those of earlier calls in this directory.

    Args:
        directory, workers, scheduler: see `ratslam.experiments.studies.recorded_runs.results`. done: told of
        each run; None if it
            is of a trial that was known before.

    Raises:
        InputError: the study has nothing to tune, Optuna is missing, or another tuning is at work in the
            directory.
    """
    plan = study.plan.tune
    if plan is None:
        raise InputError(
            study.document.at_key(("tune",)), "missing", "what to tune", "parameters and objectives"
        )
    made(directory)
    seeds = len(study.plan.every_seed())
    name = _name(study, plan)
    with opened(directory, name, plan) as journal, Pool(workers, scheduler, plan.batch * seeds) as pool:
        for first in range(0, plan.trials, plan.batch):
            numbers = range(first, min(first + plan.batch, plan.trials))
            asked = journal.ask(numbers)
            for _ in range((len(numbers) - len(asked)) * seeds):
                if done:
                    done(None)
            jobs = {number: _jobs(study, parameters) for number, parameters in asked.items()}
            answers = pool.results([job for each in jobs.values() for job in each], directory, done)
            found = {number: [next(answers) for _ in each] for number, each in jobs.items()}
            for number, each in found.items():
                journal.tell(number, _values(plan, each))
        return journal.trials()


def report(trials: Sequence[Trial]) -> str:
    """The Pareto-optimal trials as plain text, the best by the first objective on top."""
    best = [trial for trial in trials if trial.optimal and trial.values]
    failed = sum(trial.values is None for trial in trials)
    beside = f", {failed} failed" if failed else ""
    title = f"{len(trials)} trials, {len(best)} of them Pareto-optimal{beside}"
    if not best:
        return title
    body = [
        [
            f"{trial.number}",
            *map(_plain, (trial.values or {}).values()),
            *map(_plain, trial.parameters.values()),
        ]
        for trial in sorted(best, key=lambda trial: list((trial.values or {}).values()))
    ]
    lines = [["trial", *(best[0].values or {}), *best[0].parameters], *body]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        [title, *("  ".join(f"{cell:>{w}}" for cell, w in zip(row, widths, strict=True)) for row in lines)]
    )


def save(trials: Sequence[Trial], directory: Path) -> Path:
    """trials.json: all of them."""
    path = directory / "trials.json"
    write_text_atomically(
        path, json.dumps([trial._asdict() for trial in trials], indent=1, allow_nan=False) + "\n"
    )
    return path


def _name(study: Study, plan: TunePlan) -> str:
    """One name for all whose trials can be compared: of another base, say, they cannot."""
    asked = plan.model_dump(mode="json", exclude={"trials"})
    base = digest_of(variant_of(study, []).config, study.plan.pace)
    text = json.dumps([asked, base, study.plan.every_seed()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _jobs(study: Study, parameters: dict[str, Any]) -> list[Job]:
    """The runs of a set of parameters; none where they cannot be together."""
    try:
        return seeded(tuned(study, parameters), study.plan)
    except InputError:
        return []


def _values(plan: TunePlan, found: Sequence[Result]) -> list[float] | None:
    """The objectives, as means over seeds; None where any run lacks one."""
    columns = [[result.value(name) for result in found] for name in plan.directions()]
    known = [[value for value in column if value is not None] for column in columns]
    if not found or any(len(column) < len(found) for column in known):
        return None
    return [statistics.fmean(column) for column in known]


def _plain(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
