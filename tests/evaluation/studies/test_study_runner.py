"""Runs of a study: none is lost or repeated, and the outcome does not depend on the process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.studies.executor import Executor
from evaluation.studies.run_job import FILE, KILLED, RunLog, measure_jobs, run_jobs
from evaluation.studies.study import read_study
from ratslam.cli import main
from tests.evaluation.studies.conftest import record

ROOT = Path(__file__).parents[3]
PATIENCE = 240.0


def start(study, output, *more):
    """The program in a process group of its own."""
    command = [sys.executable, "-m", "ratslam", "study", str(study), "-o", str(output), *more]
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def lines(output):
    """Complete lines of the file of records."""
    path = output / FILE
    return path.read_bytes().splitlines(keepends=True) if path.exists() else []


def wait_for(count, output, process):
    """Waits until there are that many records."""
    end = time.monotonic() + PATIENCE
    while len(lines(output)) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


def wait_for_end(group):
    """Waits until all processes of a group have ended."""
    end = time.monotonic() + PATIENCE
    while members(group):
        assert time.monotonic() < end
        time.sleep(0.05)


def members(group):
    """Processes of a group that have not ended."""
    found = []
    for process in psutil.process_iter(["pid", "status"]):
        try:
            if os.getpgid(process.pid) == group and process.info["status"] != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
        except ProcessLookupError:
            continue
    return found


def run(jobs, folder, workers=1, done=None):
    with Executor(workers) as executor:
        return list(run_jobs(jobs, RunLog(folder), executor, done))


def outcomes(records):
    """The parts of records that do not depend on the machine."""
    return [(each.key, each.row, each.varied, each.steps, each.source, each.quantities) for each in records]


@pytest.mark.soak
def test_two_workers_give_what_one_process_gives(tiny, tmp_path):
    jobs = read_study(tiny(seeds=2)).jobs
    alone = run(jobs, tmp_path / "alone")
    shared = run(jobs, tmp_path / "shared", workers=2)
    assert outcomes(shared) == outcomes(alone)
    assert {each.machine.workers for each in shared} == {2}


def test_a_study_killed_by_sigkill_runs_only_what_is_missing(tiny, tmp_path, stubbed):
    """The killed program runs sessions; the one that continues only notes what it would run."""
    study, output = tiny(seeds=40), tmp_path / "out"
    process = start(study, output, "--workers", "1")
    wait_for(2, output, process)
    process.kill()
    process.communicate()
    kept = RunLog(output).records
    before = lines(output)
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
        content = [
            line[:cut] + b"\n" * (k < len(kept) - 1) if k in lost else line for k, line in enumerate(kept)
        ]
        (folder / FILE).write_bytes(b"".join(content))
        missing = set(calls) - set(RunLog(folder).records)
        assert len(missing) == len(lost)
        calls.clear()
        assert run(jobs, folder) == whole
        assert set(calls) == missing
        assert set(RunLog(folder).records) == {job.key for job in jobs}


def test_failed_runs_are_reported_and_the_others_continue(tiny, tmp_path, capsys, stubbed):
    study = tiny(vary={"keyframes.min_score": [5, 41, 6]}, seeds=2)
    for _ in range(2):  # the second time nothing runs, and the failure is reported again
        assert main(["study", str(study), "-o", str(tmp_path / "out"), "--workers", "1"]) == 2
        printed = capsys.readouterr()
        assert "min_score=41, seed 1: keyframes.min_score: too much" in printed.err
        assert "2 runs failed" in printed.err
        assert "min_score=6" in printed.out
        assert "0, 2 failed" in printed.out
        assert (tmp_path / "out" / "table.csv").exists()
    assert len(stubbed) == 6


def test_killed_runs_are_reported_and_tried_again(tiny, tmp_path, monkeypatch):
    jobs = read_study(tiny(seeds=2)).jobs
    monkeypatch.setattr(
        Executor,
        "completed",
        lambda self, function, tasks, killed: ((k, killed(t)) for k, t in enumerate(tasks)),
    )
    assert [each.error for each in run(jobs, tmp_path / "out")] == [KILLED, KILLED]
    assert not RunLog(tmp_path / "out").records


def test_records_of_other_code_are_remarked_on(tiny, tmp_path, capsys, stubbed):
    study, output = tiny(seeds=2), tmp_path / "out"
    assert main(["study", str(study), "-o", str(output), "--workers", "1"]) == 0
    assert "builds" not in capsys.readouterr().out
    (output / FILE).write_text((output / FILE).read_text().replace('"build":"', '"build":"0', 1))
    assert main(["study", str(study), "-o", str(output), "--workers", "1"]) == 0
    assert "2 builds of ratslam" in capsys.readouterr().out


@pytest.mark.soak
def test_speed_is_measured_in_fresh_processes_and_is_not_measured_again(tiny, tmp_path, capsys):
    study, output = tiny(seeds=2, report="pareto", pace="live"), tmp_path / "out"
    assert main(["study", str(study), "-o", str(output)]) == 0
    records = list(RunLog(output).records.values())
    assert [each.seed for each in records] == [0, 1]
    for each in records:
        assert each.error is None
        assert each.machine.workers == 1
    assert {each.name for each in output.iterdir()} == {
        FILE,
        "table.csv",
        "table.json",
        "table.md",
        "pareto.png",
    }
    kept = lines(output)
    first = capsys.readouterr().out
    assert main(["study", str(study), "-o", str(output)]) == 0
    assert capsys.readouterr().out == first
    assert main(["study", str(study), "-o", str(output), "--error", "ate"]) == 0
    assert "ATE, final" in capsys.readouterr().out
    assert lines(output) == kept


def test_speed_is_measured_seed_by_seed_with_kernels_apart(tiny, tmp_path, monkeypatch):
    requested = []

    def completed(self, function, tasks, killed):
        requested.extend(tasks)
        kernels.append(function.args)
        return ((k, killed(task)) for k, task in enumerate(tasks))

    kernels = []
    monkeypatch.setattr(Executor, "completed", completed)
    rows = {"a": {}, "b": {"session.precision": "float32"}, "twin": {}}
    jobs = read_study(tiny(rows=rows, seeds=2)).jobs
    found = measure_jobs(jobs, RunLog(tmp_path / "out"))
    assert [(job.row, job.seed) for job in requested] == [("a", 0), ("b", 0), ("a", 1), ("b", 1)]
    assert len(kernels) == 1
    assert [each.row for each in found] == ["a", "a", "b", "b", "twin", "twin"]


@pytest.mark.soak
def test_an_interrupt_keeps_finished_runs_and_ends_all_processes(tiny, tmp_path):
    study, output = tiny(seeds=300), tmp_path / "out"
    for count in (2, 6):
        process = start(study, output, "--workers", "2")
        wait_for(count, output, process)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        _, error = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130
        assert "Traceback" not in error
        assert "the same command continues" in error
        wait_for_end(process.pid)
    assert main(["study", str(study), "-o", str(output), "--workers", "2"]) == 0


@pytest.mark.soak
def test_studies_killed_at_any_moment_continue(tiny, tmp_path):
    study, output = tiny(seeds=30), tmp_path / "out"
    jobs = read_study(study).jobs
    expected = outcomes(run(jobs, tmp_path / "whole"))
    for count in (0, 1, 2, 5, 13, 21):
        process = start(study, output, "--workers", "2")
        if count:
            wait_for(count, output, process)
        process.kill()
        process.communicate()
        wait_for_end(process.pid)
    assert outcomes(run(jobs, output, workers=2)) == expected
