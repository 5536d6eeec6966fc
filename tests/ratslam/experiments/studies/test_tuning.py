"""Tuning: what is chosen follows from the study alone, whoever was killed meanwhile."""

from __future__ import annotations

import json
import os
import signal
import time

import pytest

from ratslam.cli import main
from ratslam.experiments.studies.optuna_storage import JOURNAL, Trial, opened
from ratslam.experiments.studies.recorded_runs import FOLDER
from ratslam.experiments.studies.study import read_study
from ratslam.experiments.studies.tuning import report, tune
from tactile.base.errors import InputError

TUNE = {
    "trials": 14,
    "parameters": {
        "keyframes.min_score": {"low": 1.0, "high": 39.0, "log": True},
        "recall.modes": {"low": 1, "high": 8},
        "session.precision": {"choices": ["float32", "float64"]},
    },
    "objectives": ["energy_all", "exm_arr"],
}


class Killed(Exception):
    """Stands for SIGKILL in this process."""


def dominates(a, b):
    """Of (energy_all, exm_arr): the one low, the other high."""
    better = (a["energy_all"] <= b["energy_all"], a["exm_arr"] >= b["exm_arr"])
    return all(better) and a != b


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
def test_trials_are_within_bounds_and_the_optimal_ones_are_not_dominated(tiny, tmp_path, played, sampler):
    plan = TUNE | {"sampler": sampler, "population": 4, "batch": 3}
    trials = tune(read_study(tiny(tune=plan, seeds=2)), tmp_path / "out", workers=1)
    assert [trial.number for trial in trials] == list(range(14))
    for trial in trials:
        assert 1 <= trial.parameters["keyframes.min_score"] <= 39
        assert trial.parameters["recall.modes"] in range(1, 9)
        assert trial.values["energy_all"] == pytest.approx(
            (trial.parameters["keyframes.min_score"] - 7) ** 2 + 0.5
        )
        others = [other.values for other in trials]
        assert trial.optimal == (not any(dominates(values, trial.values) for values in others))
    different = {json.dumps(trial.parameters) for trial in trials}
    assert len(different) > 8
    assert len(played) == len(set(played)) == 2 * len(different)


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
@pytest.mark.parametrize("kills", [[1], [2, 3, 5], [3, 3, 3], [7, 1, 1]])
def test_a_killed_tuning_goes_on_as_if_it_had_not_been(tiny, tmp_path, played, monkeypatch, sampler, kills):
    study = read_study(tiny(tune=TUNE | {"sampler": sampler, "population": 4}))
    whole = tune(study, tmp_path / "whole", workers=1)
    every = list(played)
    played.clear()
    for count in kills:
        left = [count]

        def done(result, left=left):
            left[0] -= result is not None
            if left[0] < 0:
                raise Killed

        with pytest.raises(Killed):
            tune(study, tmp_path / "out", workers=1, done=done)
    assert tune(study, tmp_path / "out", workers=1) == whole
    assert sorted(played) == sorted(every)  # and no run twice


def test_a_tuning_killed_while_it_chooses_goes_on_too(tiny, tmp_path, played, monkeypatch):
    study = read_study(tiny(tune=TUNE))
    whole = tune(study, tmp_path / "whole", workers=1)
    lines = (tmp_path / "whole" / JOURNAL).read_bytes().splitlines(keepends=True)
    for count in range(1, len(lines), 11):
        folder = tmp_path / f"out-{count}"
        folder.mkdir()
        (folder / JOURNAL).write_bytes(b"".join(lines[:count]) + lines[count][: len(lines[count]) // 2])
        assert tune(study, folder, workers=1) == whole


def test_more_trials_go_on_from_those_there_are(tiny, tmp_path, played):
    few = tune(read_study(tiny(tune=TUNE | {"trials": 8})), tmp_path / "out", workers=1)
    more = tune(read_study(tiny(tune=TUNE | {"trials": 12})), tmp_path / "out", workers=1)
    assert [trial[:3] for trial in more[:8]] == [trial[:3] for trial in few]
    assert len(more) == 12
    other = tune(read_study(tiny(tune=TUNE | {"trials": 4, "seed": 1})), tmp_path / "out", workers=1)
    assert len(other) == 4  # another tuning in the same folder begins anew
    assert other[0].parameters != more[0].parameters


def test_a_failed_run_fails_its_trial_alone(tiny, tmp_path, played):
    plan = TUNE | {"parameters": {"keyframes.min_score": {"low": 20.0, "high": 60.0}}}
    trials = tune(read_study(tiny(tune=plan)), tmp_path / "out", workers=1)
    assert {trial.values is None for trial in trials} == {True, False}
    for trial in trials:
        assert (trial.values is None) == (trial.parameters["keyframes.min_score"] > 40)
    assert "failed" in report(trials)


def test_two_tunings_in_one_folder_are_refused(tiny, tmp_path, played):
    study = read_study(tiny(tune=TUNE))
    with opened(tmp_path, "first", study.plan.tune), pytest.raises(InputError, match="another tuning"):
        tune(study, tmp_path, workers=1)
    assert len(tune(study, tmp_path, workers=1)) == 14


def test_a_missing_optuna_is_told(tiny, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[sweep\]'"):
        tune(read_study(tiny(tune=TUNE)), tmp_path / "out", workers=1)


def test_the_program_tells_what_is_optimal(tiny, tmp_path, capsys, played):
    output = tmp_path / "out"
    study = tiny(tune=TUNE | {"minimise": ["steps"]})
    assert main(["sweep", str(study), "-o", str(output), "--workers", "1", "--tune"]) == 2
    assert "14 trials, 0 of them Pareto-optimal, 14 failed" in capsys.readouterr().out  # none tells its steps
    study = tiny(tune=TUNE)
    assert main(["sweep", str(study), "-o", str(output), "--workers", "1", "--tune"]) == 0
    lines = capsys.readouterr().out.splitlines()
    trials = [Trial(**trial) for trial in json.loads((output / "trials.json").read_text())]
    best = {trial.number for trial in trials if trial.optimal}
    assert f"14 trials, {len(best)} of them Pareto-optimal" in lines
    assert {int(line.split()[0]) for line in lines[2 : 2 + len(best)]} == best


@pytest.mark.soak
def test_a_tuning_that_is_killed_again_and_again_ends_the_same(tiny, tmp_path):
    from tests.ratslam.experiments.studies.test_executor import start, wait_for

    plan = TUNE | {"trials": 10, "parameters": {"keyframes.min_score": {"low": 2.0, "high": 30.0}}}
    study = tiny(tune=plan, set={"backend": "recall"})
    whole = tune(read_study(study), tmp_path / "whole", workers=1)
    output = tmp_path / "out"
    for count in (0, 1, 3, 6):
        process = start(study, output, "--tune", "--workers", "2")
        wait_for(count, output, process) if count else time.sleep(2)
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
    assert tune(read_study(study), output, workers=1) == whole
    assert len(list((output / FOLDER).glob("[!.]*.json"))) == 10
