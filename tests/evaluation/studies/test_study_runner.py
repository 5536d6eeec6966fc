"""Runs of a study or a search: none is lost or repeated, and the outcome does not depend on the process."""

import contextlib
import json
import os
import signal
import sys
import time
from dataclasses import replace

import numpy as np
import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics.statistics import pareto_optimal
from evaluation.studies.executor import Executor
from evaluation.studies.metrics import MEASURED
from evaluation.studies.parameter_search import search
from evaluation.studies.run_job import (
    FILE,
    KILLED,
    RunLog,
    RunRecord,
    measure_jobs,
    read_records,
    run_jobs,
)
from evaluation.studies.study import read_study
from evaluation.studies.study_report import make_report
from ratslam.cli import main
from tactile.base.errors import InputError
from tests.evaluation.studies.conftest import PATIENCE, kill, record, wait_until
from tests.helpers.commands import said, start

FULL = record("r", varied={"a.b": [1, {"c": None}]}, time=40.0, energy_all=0.1 + 0.2, exm_arr=None)


def lines(output):
    path = output / FILE
    return path.read_bytes().splitlines(keepends=True) if path.exists() else []


def start_study(study, output, *more, records):
    process = start("study", study, "-o", output, *more)
    wait_until(lambda: sum(line.endswith(b"\n") for line in lines(output)) >= records, process)
    return process


def wait_for_end(group):
    end = time.monotonic() + PATIENCE
    for process in psutil.process_iter(["status"]):
        with contextlib.suppress(ProcessLookupError, psutil.NoSuchProcess):
            while os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                assert time.monotonic() < end
                time.sleep(0.05)


def run(jobs, folder, workers=1, done=None):
    with Executor(workers) as executor:
        return list(run_jobs(jobs, RunLog(folder), executor, done))


def outcomes(records):
    return [(each.key, each.row, each.varied, each.steps, each.source, each.quantities) for each in records]


def test_records_read_back_equal_with_all_values_and_the_last_of_a_run_counts(tmp_path):
    copy, later = FULL.model_copy(update={"copy_number": 2}), FULL.model_copy(update={"steps": 7})
    log = RunLog(tmp_path / "new" / "folder")
    for each in (FULL, copy, later):
        log.append(each)
    assert RunLog(tmp_path / "new" / "folder").records == {FULL.key: later, copy.key: copy}
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot be made"):
        RunLog(tmp_path / "file" / "below")
    values = {"step_time": 40, "step_time_p99": 80, "compile_time": 1, "run_time": 120, "memory": 400}
    values |= {"energy_all": 0.1 + 0.2, "exm_arr": None, "map_auc": None}
    assert {name: FULL.value(name) for name in values} == values


@pytest.mark.parametrize("content", [b"", b'{"hash": "a", "se', b"{}", b"\xff\xfe", b"[1]", b"\n\n"])
def test_a_malformed_line_is_skipped_and_the_next_is_complete(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)
    log = RunLog(tmp_path)
    assert log.records == {}
    log.append(FULL)
    assert RunLog(tmp_path).records == {FULL.key: FULL}


def test_a_study_killed_by_sigkill_runs_only_what_is_missing(tiny, tmp_path, stubbed):
    """The killed program runs sessions; the one that continues only notes what it would run."""
    study, output = tiny(seeds=40), tmp_path / "out"
    kill(start_study(study, output, "--workers", "1", records=2), signal.SIGKILL)
    kept, before = RunLog(output).records, lines(output)
    assert 2 <= len(kept) < 40
    jobs = read_study(study).jobs
    done: list[str] = []
    found = run(jobs, output, done=lambda record: done.append(record.key))
    assert sorted(stubbed) == sorted({job.key for job in jobs} - set(kept))
    assert lines(output)[: len(kept)] == before[: len(kept)]
    assert sorted(done) == sorted(job.key for job in jobs)
    assert [each.key for each in found] == [job.key for job in jobs]
    stubbed.clear()
    assert outcomes(run(jobs, output)) == outcomes(found)
    assert not stubbed


@settings(max_examples=15)
@given(data=st.data(), scores=st.lists(st.integers(1, 40), min_size=1, max_size=5, unique=True))
def test_lost_records_are_run_again_and_nothing_else(data, scores, tmp_path_factory):
    folder = tmp_path_factory.mktemp("lost")
    (folder / "base.yaml").write_text("simulation: {}\n")
    rows = {f"r{k}": {"keyframes.min_score": k} for k in scores}
    rows["twin"] = {"keyframes.min_score": scores[0]}
    (folder / "study.yaml").write_text(str({"base": "base.yaml", "rows": rows, "seeds": 2}))
    jobs = read_study(folder / "study.yaml").jobs
    with pytest.MonkeyPatch.context() as patch:
        calls: list[str] = []

        def run_job(job):
            calls.append(job.key)
            return record(seed=job.seed, hash=job.hash, energy_all=job.config.keyframes.min_score)

        patch.setattr("evaluation.studies.run_job.run_job", run_job)
        whole = run(jobs, folder)
        assert len(calls) == 2 * len(scores)  # equal configurations run once
        assert [each.row for each in whole] == [job.row for job in jobs]
        kept = lines(folder)
        lost = data.draw(st.sets(st.sampled_from(range(len(kept)))))
        cut = data.draw(st.integers(0, 300))
        ends = [b"\n"] * (len(kept) - 1) + [b""]
        content = [line[:cut] + ends[k] if k in lost else line for k, line in enumerate(kept)]
        (folder / FILE).write_bytes(b"".join(content))
        missing = set(calls) - set(RunLog(folder).records)
        assert len(missing) == len(lost)
        calls.clear()
        assert run(jobs, folder) == whole
        assert set(calls) == missing
        assert set(RunLog(folder).records) == {job.key for job in jobs}


def test_failed_runs_are_reported_and_the_others_continue(tiny, tmp_path, capsys, stubbed):
    study, output = tiny(vary={"keyframes.min_score": [5, 41, 6]}, seeds=2), tmp_path / "out"
    for _ in range(2):  # the second time nothing runs, and the failure is reported again
        assert main(["study", str(study), "-o", str(output), "--workers", "1"]) == 2
        printed = capsys.readouterr()
        assert "min_score=41, seed 1: keyframes.min_score: too much" in printed.err
        assert "2 runs failed" in printed.err
        assert "min_score=6" in printed.out
        assert "0, 2 failed" in printed.out
        assert (output / "table.csv").exists()
    assert len(stubbed) == 6
    (output / FILE).write_text((output / FILE).read_text().replace('"build":"', '"build":"0', 1))
    assert "2 builds" in said(capsys, "study", study, "-o", output, "--workers", "1", code=2)


def test_killed_runs_are_tried_again_and_speed_is_measured_seed_by_seed(tiny, tmp_path, monkeypatch):
    requested, functions = [], []

    def completed(self, function, tasks, killed):
        requested.extend(tasks)
        functions.append(function)
        return ((k, killed(task)) for k, task in enumerate(tasks))

    monkeypatch.setattr(Executor, "completed", completed)
    assert [each.error for each in run(read_study(tiny(seeds=2)).jobs, tmp_path)] == [KILLED, KILLED]
    assert not RunLog(tmp_path).records
    requested.clear()
    functions.clear()
    rows = {"a": {}, "b": {"session.precision": "float32"}, "twin": {}}
    found = measure_jobs(read_study(tiny(rows=rows, seeds=2)).jobs, RunLog(tmp_path))
    assert [(job.row, job.seed) for job in requested] == [("a", 0), ("b", 0), ("a", 1), ("b", 1)]
    assert [set(function.keywords) for function in functions] == [{"kernels"}]
    assert [each.row for each in found] == ["a", "a", "b", "b", "twin", "twin"]


@pytest.mark.soak
def test_an_interrupt_keeps_finished_runs_and_ends_all_processes(tiny, tmp_path):
    study, output = tiny(seeds=300), tmp_path / "out"
    for records in (2, 6):
        process = start_study(study, output, "--workers", "2", records=records)
        _, error = kill(process, signal.SIGINT)  # as a terminal does
        assert process.returncode == 130
        assert "Traceback" not in error
        assert "the same command continues" in error
        wait_for_end(process.pid)
    assert main(["study", str(study), "-o", str(output), "--workers", "2"]) == 0


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
    with Executor(1) as executor:
        records = search(study, RunLog(folder), executor, done)
    return make_report(study.name, study.plan, records, search=True).rows


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
def test_trials_are_within_bounds_and_the_optimal_ones_are_not_dominated(tiny, tmp_path, stubbed, sampler):
    plan = TUNE | {"sampler": sampler, "population": 4, "batch": 3}
    trials = tune(read_study(tiny(tune=plan, seeds=2)), tmp_path / "out")
    assert [trial.row for trial in trials] == [f"trial {number}" for number in range(14)]
    for trial in trials:
        score = trial.varied["keyframes.min_score"]
        assert 1 <= score <= 39
        assert trial.varied["recall.guard"] in range(1, 9)
        assert trial.spreads["energy_all"].mean == pytest.approx((score - 7) ** 2 + 0.5)
    # Low values of energy_all and high ones of exm_arr are better.
    costs = [[one.spreads["energy_all"].mean, -one.spreads["exm_arr"].mean] for one in trials]
    assert [trial.optimal for trial in trials] == pareto_optimal(np.array(costs)).tolist()
    different = {json.dumps(trial.varied) for trial in trials}
    assert len(different) > 8
    assert len(stubbed) == len(set(stubbed)) == 2 * len(different)


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
@pytest.mark.parametrize("kills", [[1], [2, 3, 5]])
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


def test_more_trials_continue_a_search_and_another_seed_makes_another(tiny, tmp_path, stubbed):
    few, more, other = (
        [replace(one, optimal=False) for one in tune(read_study(tiny(tune=TUNE | plan)), tmp_path / "out")]
        for plan in ({"trials": 8}, {"trials": 12}, {"trials": 4, "seed": 1})
    )
    assert more[:8] == few
    assert len(more) == 12
    assert len(stubbed) <= 12 + 4
    assert other[0].varied != more[0].varied


def test_a_failed_run_fails_its_trial_and_a_missing_optuna_is_reported(tiny, tmp_path, stubbed, monkeypatch):
    plan = TUNE | {"parameters": {"keyframes.min_score": {"low": 20.0, "high": 60.0}}}
    trials = tune(read_study(tiny(tune=plan)), tmp_path / "out")
    assert {trial.failed for trial in trials} == {0, 1}
    for trial in trials:
        assert trial.failed == (trial.varied["keyframes.min_score"] > 40)
        assert not (trial.failed and trial.optimal)
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"ratslam\[sweep\]"):
        tune(read_study(tiny(tune=TUNE)), tmp_path / "out")


def test_the_program_lists_the_optimal_trials(tiny, tmp_path, capsys, stubbed):
    output = tmp_path / "out"
    study = tiny(tune=TUNE | {"minimise": ["steps"]})
    command = ["study", study, "-o", output, "--workers", "1", "--search"]
    assert "14 trials, 0 of them Pareto-optimal" in said(capsys, *command, code=2)  # no `steps` in stubs
    tiny(tune=TUNE)
    lines = said(capsys, *command).splitlines()
    trials = json.loads((output / "table.json").read_text())["rows"]
    best = [trial["row"] for trial in trials if trial["optimal"]]
    assert any(f"14 trials, {len(best)} of them Pareto-optimal" in line for line in lines)
    assert [line.strip("| *").partition(" min_score")[0] for line in lines[2 : 2 + len(best)]] == best


@pytest.mark.soak
def test_studies_killed_at_any_moment_continue(tiny, tmp_path):
    """Workers end without the program, and two of them give what one process gives."""
    study, output = tiny(seeds=30), tmp_path / "out"
    jobs = read_study(study).jobs
    expected = outcomes(run(jobs, tmp_path / "whole"))
    for records in (0, 1, 2, 5, 13, 21):
        process = start_study(study, output, "--workers", "2", records=records)
        process.kill()
        process.communicate()
        wait_for_end(process.pid)
    assert outcomes(run(jobs, output, workers=2)) == expected


@pytest.mark.soak
def test_a_search_killed_repeatedly_has_the_same_result(tiny, tmp_path):
    plan = TUNE | {"trials": 10, "parameters": {"keyframes.min_score": {"low": 2.0, "high": 30.0}}}
    study, output = tiny(tune=plan, set={"backend": "recall"}), tmp_path / "out"
    timed = {metric.name for metric in MEASURED}

    def unmeasured(folder):
        trials = tune(read_study(study), folder)
        return [
            (one.row, one.varied, {k: v for k, v in one.spreads.items() if k not in timed}) for one in trials
        ]

    for records in (1, 3, 6):
        kill(start_study(study, output, "--search", "--workers", "2", records=records), signal.SIGKILL)
    assert unmeasured(output) == unmeasured(tmp_path / "whole")
    # A kill may tear a line, or end a worker before the process that notes its end.
    assert len([one for one in read_records(output / FILE, RunRecord) if one.error is None]) == 10
