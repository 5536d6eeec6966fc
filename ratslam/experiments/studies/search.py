"""Optuna searches over the settings of a study, for one or several objectives.

A parameter set is a configuration like any other, so its runs have records. A search that was killed repeats
its choices, which follow from the sampler's seed and the earlier outcomes, and finds their records.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ratslam.experiments.studies.executor import Executor
from ratslam.experiments.studies.records import RunLog, RunRecord
from ratslam.experiments.studies.report import align
from ratslam.experiments.studies.schema import Parameter, SearchPlan
from ratslam.experiments.studies.study import Job, Study, jobs_of, searched_variant
from ratslam.experiments.studies.study_runner import run_jobs
from tactile.base.atomic_write import write_text_atomically
from tactile.base.errors import InputError
from tactile.base.random_streams import stream


class Trial(NamedTuple):
    """A parameter set that was tried.

    Attributes:
        parameters: by key path. values: of the objectives; None if a run failed or lacks one.
        optimal: no other trial is at least as good in all objectives and better in one.
    """

    number: int
    parameters: dict[str, Any]
    values: dict[str, float] | None
    optimal: bool


def search(
    study: Study, log: RunLog, executor: Executor, done: Callable[[RunRecord], object] | None = None
) -> list[Trial]:
    """Tries the study's number of parameter sets.

    Args:
        log, done: see `run_jobs`.

    Raises:
        InputError: the study has no `tune` section, or Optuna is missing.
    """
    plan = study.plan.tune
    if plan is None:
        where = study.document.at_key(("tune",))
        raise InputError(where, "missing", "the parameters and objectives of the search")
    try:
        import optuna
    except ImportError:
        cure = "pip install 'ratslam[sweep]'"
        raise InputError("--search", "Optuna is not installed", "the extra 'sweep'", cure) from None
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        book = optuna.create_study(directions=list(plan.directions().values()))
        for first in range(0, plan.trials, plan.batch):
            asked = [
                _ask(book, plan, number) for number in range(first, min(first + plan.batch, plan.trials))
            ]
            jobs = [_jobs(study, dict(trial.params)) for trial in asked]
            records = run_jobs([job for each in jobs for job in each], log, executor, done)
            for trial, each in zip(asked, jobs, strict=True):
                values = _values(plan, [next(records) for _ in each])
                failed = {"state": optuna.trial.TrialState.FAIL} if values is None else {"values": values}
                book.tell(trial, **failed)
        return _trials(book, plan)
    finally:
        optuna.logging.set_verbosity(verbosity)


def render_trials(trials: Sequence[Trial]) -> str:
    """The Pareto-optimal trials as plain text, the best by the first objective on top."""
    best = [trial for trial in trials if trial.optimal and trial.values]
    failed = sum(trial.values is None for trial in trials)
    title = f"{len(trials)} trials, {len(best)} of them Pareto-optimal" + (
        f", {failed} failed" * bool(failed)
    )
    if not best:
        return title
    rows = [["trial", *(best[0].values or {}), *best[0].parameters]]
    for trial in sorted(best, key=lambda trial: list((trial.values or {}).values())):
        cells = [*(trial.values or {}).values(), *trial.parameters.values()]
        plain = [f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in cells]
        rows.append([f"{trial.number}", *plain])
    return "\n".join([title, align(rows, ">" * len(rows[0]))])


def save_trials(trials: Sequence[Trial], directory: Path) -> Path:
    """Writes trials.json."""
    path = directory / "trials.json"
    content = json.dumps([trial._asdict() for trial in trials], indent=1, allow_nan=False)
    write_text_atomically(path, content + "\n")
    return path


def _ask(book: Any, plan: SearchPlan, number: int) -> Any:
    """A trial with its parameters, each chosen with a random stream of its own."""
    book.sampler = _sampler(plan, f"tune.{number}")
    trial = book.ask()
    for key, parameter in plan.parameters.items():
        book.sampler = _sampler(plan, f"tune.{number}.{key}")
        _suggest(trial, key, parameter)
    return trial


def _sampler(plan: SearchPlan, name: str) -> Any:
    import optuna

    seed = int(stream(plan.seed, name).integers(2**31))
    if plan.sampler == "nsga2":
        return optuna.samplers.NSGAIISampler(seed=seed, population_size=plan.population)
    return optuna.samplers.TPESampler(seed=seed)


def _suggest(trial: Any, key: str, parameter: Parameter) -> None:
    if parameter.choices is not None:
        trial.suggest_categorical(key, parameter.choices)
        return
    integer = isinstance(parameter.low, int) and isinstance(parameter.high, int)
    suggest = trial.suggest_int if integer else trial.suggest_float
    suggest(key, parameter.low, parameter.high, log=parameter.log)


def _jobs(study: Study, parameters: dict[str, Any]) -> list[Job]:
    """The runs of a parameter set; none if its parameters contradict each other."""
    try:
        return jobs_of(searched_variant(study, parameters), study.plan)
    except InputError:
        return []


def _values(plan: SearchPlan, records: Sequence[RunRecord]) -> list[float] | None:
    """The objectives as means over runs; None if a run lacks one."""
    columns = [[record.value(name) for record in records] for name in plan.directions()]
    known = [[value for value in column if value is not None] for column in columns]
    if not records or any(len(column) < len(records) for column in known):
        return None
    return [statistics.fmean(column) for column in known]


def _trials(book: Any, plan: SearchPlan) -> list[Trial]:
    names, found = list(plan.directions()), book.get_trials(deepcopy=False)
    best = {trial.number for trial in book.best_trials} if any(each.values for each in found) else set()
    return [
        Trial(
            number=trial.number,
            parameters=dict(trial.params),
            values=dict(zip(names, trial.values, strict=True)) if trial.values else None,
            optimal=trial.number in best,
        )
        for trial in found
    ]
