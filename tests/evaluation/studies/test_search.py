"""Searches: the choices follow from the study alone, also after kills."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace

import pytest

from evaluation.studies.executor import Executor
from evaluation.studies.metrics import MEASURED
from evaluation.studies.parameter_search import search
from evaluation.studies.run_job import FILE, RunLog
from evaluation.studies.study import read_study
from evaluation.studies.study_report import make_report
from ratslam.cli import main
from tactile.base.errors import InputError
from tests.evaluation.studies.test_study_runner import start, wait_for

TUNE = {
    "trials": 14,
    "parameters": {
        "keyframes.min_score": {"low": 1.0, "high": 39.0, "log": True},
        "recall.guard": {"low": 1, "high": 8},
        "session.precision": {"choices": ["float32", "float64"]},
    },
    "objectives": ["energy_all", "exm_arr"],
}


class Killed(Exception):
    """Stands for SIGKILL in this process."""


def tune(study, folder, done=None):
    """The trials: rows of the report of a search."""
    with Executor(1) as executor:
        records = search(study, RunLog(folder), executor, done)
    return make_report(study.name, study.plan, records, search=True).rows


def unmeasured(trials):
    """Trials without the quantities that depend on the machine."""
    timed = {metric.name for metric in MEASURED}
    return [
        replace(trial, spreads={name: found for name, found in trial.spreads.items() if name not in timed})
        for trial in trials
    ]


def mean(trial, name="energy_all"):
    return trial.spreads[name].mean


def dominates(a, b):
    """Low values of energy_all and high ones of exm_arr are better."""
    values = [(mean(trial), -mean(trial, "exm_arr")) for trial in (a, b)]
    return all(x <= y for x, y in zip(*values, strict=True)) and values[0] != values[1]


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
def test_trials_are_within_bounds_and_the_optimal_ones_are_not_dominated(tiny, tmp_path, stubbed, sampler):
    plan = TUNE | {"sampler": sampler, "population": 4, "batch": 3}
    trials = tune(read_study(tiny(tune=plan, seeds=2)), tmp_path / "out")
    assert [trial.row for trial in trials] == [f"trial {number}" for number in range(14)]
    for trial in trials:
        score = trial.varied["keyframes.min_score"]
        assert 1 <= score <= 39
        assert trial.varied["recall.guard"] in range(1, 9)
        assert mean(trial) == pytest.approx((score - 7) ** 2 + 0.5)
        assert trial.optimal == (not any(dominates(other, trial) for other in trials))
    different = {json.dumps(trial.varied) for trial in trials}
    assert len(different) > 8
    assert len(stubbed) == len(set(stubbed)) == 2 * len(different)


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
@pytest.mark.parametrize("kills", [[1], [2, 3, 5], [7, 1, 1]])
def test_a_killed_search_continues_as_if_uninterrupted(tiny, tmp_path, stubbed, sampler, kills):
    study = read_study(tiny(tune=TUNE | {"sampler": sampler, "population": 4}))
    whole = tune(study, tmp_path / "whole")
    every = list(stubbed)
    stubbed.clear()
    for count in kills:
        limit = len(stubbed) + count

        def done(record, limit=limit):
            if len(stubbed) >= limit:
                raise Killed

        with pytest.raises(Killed):
            tune(study, tmp_path / "out", done)
    assert tune(study, tmp_path / "out") == whole
    assert sorted(stubbed) == sorted(every)  # no run twice


def test_more_trials_continue_a_search(tiny, tmp_path, stubbed):
    few = tune(read_study(tiny(tune=TUNE | {"trials": 8})), tmp_path / "out")
    runs = len(stubbed)
    more = tune(read_study(tiny(tune=TUNE | {"trials": 12})), tmp_path / "out")
    assert [replace(trial, optimal=False) for trial in more[:8]] == [
        replace(trial, optimal=False) for trial in few
    ]
    assert len(more) == 12
    assert len(stubbed) - runs <= 4
    other = tune(read_study(tiny(tune=TUNE | {"trials": 4, "seed": 1})), tmp_path / "out")
    assert other[0].varied != more[0].varied


def test_a_failed_run_fails_its_trial_alone(tiny, tmp_path, stubbed):
    plan = TUNE | {"parameters": {"keyframes.min_score": {"low": 20.0, "high": 60.0}}}
    trials = tune(read_study(tiny(tune=plan)), tmp_path / "out")
    assert {trial.failed for trial in trials} == {0, 1}
    for trial in trials:
        assert trial.failed == (trial.varied["keyframes.min_score"] > 40)
        assert not (trial.failed and trial.optimal)


def test_a_missing_optuna_is_reported(tiny, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[sweep\]'"):
        tune(read_study(tiny(tune=TUNE)), tmp_path / "out")


def test_the_program_lists_the_optimal_trials(tiny, tmp_path, capsys, stubbed):
    output = tmp_path / "out"
    command = [
        str(tiny(tune=TUNE | {"minimise": ["steps"]})),
        "-o",
        str(output),
        "--workers",
        "1",
        "--search",
    ]
    assert main(["study", *command]) == 2
    assert "14 trials, 0 of them Pareto-optimal" in capsys.readouterr().out  # no `steps` in stubs
    tiny(tune=TUNE)
    assert main(["study", *command]) == 0
    lines = capsys.readouterr().out.splitlines()
    trials = json.loads((output / "table.json").read_text())["rows"]
    best = [trial["row"] for trial in trials if trial["optimal"]]
    assert any(f"14 trials, {len(best)} of them Pareto-optimal" in line for line in lines)
    assert [line.strip("| *").partition(" min_score")[0] for line in lines[2 : 2 + len(best)]] == best


@pytest.mark.soak
def test_a_search_killed_repeatedly_has_the_same_result(tiny, tmp_path):
    plan = TUNE | {"trials": 10, "parameters": {"keyframes.min_score": {"low": 2.0, "high": 30.0}}}
    study = tiny(tune=plan, set={"backend": "recall"})
    whole = tune(read_study(study), tmp_path / "whole")
    output = tmp_path / "out"
    for count in (1, 3, 6):
        process = start(study, output, "--search", "--workers", "2")
        wait_for(count, output, process)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    assert unmeasured(tune(read_study(study), output)) == unmeasured(whole)
    assert len((output / FILE).read_text().splitlines()) == 10
