"""Optuna searches over the settings of a study, for one or several objectives.

A parameter set is a configuration like any other, so its runs have records. A search that was killed repeats
its choices, which follow from the sampler's seed and the earlier outcomes, and finds their records.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from itertools import chain, islice
from typing import Any

from evaluation.studies.executor import Executor
from evaluation.studies.run_job import RunLog, RunRecord, run_jobs
from evaluation.studies.study import Job, SearchPlan, Study, searched_jobs
from tactile.base.errors import InputError
from tactile.base.random_streams import stream


def search_plan(study: Study) -> SearchPlan:
    """The study's `tune` section; raises an `InputError` if it has none."""
    if study.plan.tune is None:
        where = study.document.at_key(("tune",))
        raise InputError(where, "missing", "the parameters and objectives of the search")
    return study.plan.tune


def search(
    study: Study, log: RunLog, executor: Executor, done: Callable[[RunRecord], object] | None = None
) -> list[RunRecord]:
    """Tries the study's number of parameter sets; returns their records, with the trial's number as row.

    `log` and `done` are those of `run_jobs`. An `InputError` says that the study has no `tune` section, or
    that Optuna is missing.
    """
    plan, found = search_plan(study), list[RunRecord]()
    try:
        import optuna
    except ImportError:
        cure = "pip install 'ratslam[sweep]'"
        raise InputError("--search", "Optuna is not installed", "the extra 'sweep'", cure) from None
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        high = [direction == "high" for direction in plan.directions().values()]
        book = optuna.create_study(directions=["maximize" if each else "minimize" for each in high])
        for first in range(0, plan.trials, plan.batch):
            numbers = range(first, min(first + plan.batch, plan.trials))
            asked = [_ask(book, plan, number) for number in numbers]
            jobs: list[list[Job]] = []
            for number, trial in zip(numbers, asked, strict=True):
                try:
                    own = searched_jobs(study, dict(trial.params))
                    jobs.append([job._replace(row=f"trial {number}") for job in own])
                except InputError:  # parameters that contradict each other
                    jobs.append([])
            records = run_jobs(list(chain.from_iterable(jobs)), log, executor, done)
            for trial, each in zip(asked, jobs, strict=True):
                ran = list(islice(records, len(each)))
                columns: list[list[Any]] = [[run.value(name) for run in ran] for name in plan.directions()]
                if not ran or any(None in column for column in columns):
                    book.tell(trial, state=optuna.trial.TrialState.FAIL)
                else:
                    book.tell(trial, values=[statistics.fmean(map(float, column)) for column in columns])
                found += ran
        return found
    finally:
        optuna.logging.set_verbosity(verbosity)


def _ask(book: Any, plan: SearchPlan, number: int) -> Any:
    """A trial with its parameters, each chosen with a random stream of its own."""
    book.sampler = _sampler(plan, f"tune.{number}")
    trial = book.ask()
    for key, parameter in plan.parameters.items():
        book.sampler = _sampler(plan, f"tune.{number}.{key}")
        if parameter.choices is not None:
            trial.suggest_categorical(key, parameter.choices)
            continue
        integer = isinstance(parameter.low, int) and isinstance(parameter.high, int)
        suggest = trial.suggest_int if integer else trial.suggest_float
        suggest(key, parameter.low, parameter.high, log=parameter.log)
    return trial


def _sampler(plan: SearchPlan, name: str) -> Any:
    import optuna

    seed = int(stream(plan.seed, name).integers(2**31))
    if plan.sampler == "nsga2":
        return optuna.samplers.NSGAIISampler(seed=seed, population_size=plan.population)
    return optuna.samplers.TPESampler(seed=seed)
