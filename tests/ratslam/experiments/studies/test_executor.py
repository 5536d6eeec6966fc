"""Jobs shared out: nothing is lost, nothing is run twice, and it is no matter who runs it."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.cli import main
from ratslam.experiments.studies.recorded_runs import FOLDER, results
from ratslam.experiments.studies.results import Result, read_result
from ratslam.experiments.studies.study import jobs, read_study
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[4]
PATIENCE = 120.0


def start(study, output, *more):
    """The program in a process group of its own."""
    command = [sys.executable, "-m", "ratslam", "sweep", str(study), "-o", str(output), *more]
    return subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )


def wait_for(count, output, process):
    """Until there are so many results."""
    end = time.monotonic() + PATIENCE
    while len(list((output / FOLDER).glob("[!.]*.json"))) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.02)


def figures(found):
    """What must not depend on who ran it."""
    return [(each.key, each.row, each.varied, each.steps, each.source, each.quantities) for each in found]


def members(group):
    """Processes that are left of a group; those that have ended and wait for a parent do not count."""
    found = []
    for process in psutil.process_iter(["pid", "status"]):
        try:
            if os.getpgid(process.pid) == group and process.info["status"] != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
        except ProcessLookupError:
            continue
    return found


def gone(group):
    """Waits for the end of a process group: workers notice that nobody is left to work for."""
    end = time.monotonic() + PATIENCE
    while members(group):
        assert time.monotonic() < end
        time.sleep(0.05)


def test_workers_give_what_one_process_gives_though_one_is_killed(tiny, tmp_path):
    asked = jobs(read_study(tiny(rows={"a": {}, "b": {"places.radius": 1.5}}, seeds=2)))
    alone = list(results(asked, tmp_path / "alone", workers=1))
    addresses: set[str] = set()
    killed: list[int] = []

    def kill_one(result):
        if killed:
            return
        workers = multiprocessing.active_children()
        for process in [psutil.Process(), *(psutil.Process(each.pid) for each in workers)]:
            addresses.update(c.laddr.ip for c in process.net_connections() if c.status == psutil.CONN_LISTEN)
        killed.append(workers[0].pid)
        os.kill(workers[0].pid, signal.SIGKILL)

    shared = list(results(asked, tmp_path / "shared", workers=2, done=kill_one))
    assert killed
    assert addresses == {"127.0.0.1"}
    assert figures(shared) == figures(alone)
    assert {each.machine.workers for each in shared} <= {1, 2}
    assert not multiprocessing.active_children()


def test_a_killed_sweep_runs_only_what_is_missing(tiny, tmp_path, played):
    """The killed one runs in full; what goes on with it only says what it would run."""
    study, output = tiny(seeds=40), tmp_path / "out"
    process = start(study, output, "--workers", "1")
    wait_for(2, output, process)
    process.kill()
    process.communicate()
    kept = {path: path.read_bytes() for path in (output / FOLDER).glob("[!.]*.json")}
    assert 2 <= len(kept) < 40
    asked = jobs(read_study(study))
    told: list[str] = []
    found = list(results(asked, output, workers=1, done=lambda result: told.append(result.key)))
    assert sorted(played) == sorted({job.key for job in asked} - {path.stem for path in kept})
    assert {path: path.read_bytes() for path in kept} == kept
    assert sorted(told) == sorted(job.key for job in asked)
    assert [each.key for each in found] == [job.key for job in asked]
    played.clear()
    assert figures(results(asked, output, workers=1)) == figures(found)
    assert not played


@settings(max_examples=20)
@given(data=st.data(), scores=st.lists(st.integers(1, 50), min_size=1, max_size=6, unique=True))
def test_whatever_is_lost_is_run_again_and_nothing_else(data, scores, tmp_path_factory):
    folder = tmp_path_factory.mktemp("lost")
    (folder / "base.yaml").write_text("simulation: {}\n")
    rows = {f"r{k}": {"keyframes.min_score": k} for k in scores} | {
        "twin": {"keyframes.min_score": scores[0]}
    }
    (folder / "study.yaml").write_text(json.dumps({"base": "base.yaml", "rows": rows, "seeds": 2}))
    asked = jobs(read_study(folder / "study.yaml"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ratslam.experiments.studies.recorded_runs.run_job", counting(calls := []))
        whole = list(results(asked, folder, workers=1))
        assert len(calls) == 2 * len(scores)  # twins are one
        assert [each.row for each in whole] == [job.row for job in asked]
        lost = data.draw(st.sets(st.sampled_from(sorted(set(calls)))))
        for key in lost:
            path = folder / FOLDER / f"{key}.json"
            content = path.read_bytes()
            path.write_bytes(content[: data.draw(st.integers(0, len(content) - 3))])
        calls.clear()
        assert list(results(asked, folder, workers=1)) == whole
        assert set(calls) == lost


def counting(calls):
    def run_job(job):
        calls.append(job.key)
        return Result(hash=job.hash, seed=job.seed, steps=int(job.config.keyframes.min_score))

    return run_job


def test_what_fails_is_told_and_the_rest_goes_on(tiny, tmp_path, capsys, played):
    study = tiny(vary={"keyframes.min_score": [5, 41, 6]}, seeds=2)
    for _ in range(2):  # the second time nothing is run, and it is said again
        assert main(["sweep", str(study), "-o", str(tmp_path / "out"), "--workers", "1"]) == 2
        told = capsys.readouterr()
        assert "score=41, seed 1: keyframes.min_score: too much" in told.err
        assert "2 runs failed" in told.err
        assert "score=6" in told.out
        assert "0, 2 failed" in told.out
        assert (tmp_path / "out" / "table.csv").exists()
    assert len(played) == 6


def test_results_of_other_code_are_remarked_on(tiny, tmp_path, capsys):
    study, output = tiny(seeds=2), tmp_path / "out"
    assert main(["sweep", str(study), "-o", str(output), "--workers", "1"]) == 0
    assert "builds" not in capsys.readouterr().out
    path = next((output / FOLDER).iterdir())
    path.write_text(path.read_text().replace('"build": "', '"build": "0'))
    assert main(["sweep", str(study), "-o", str(output), "--workers", "1"]) == 0
    assert "2 builds of ratslam" in capsys.readouterr().out


def test_a_missing_dask_is_told(tiny, tmp_path, monkeypatch):
    for module in ("dask", "distributed"):
        monkeypatch.setitem(sys.modules, module, None)
    asked = jobs(read_study(tiny(seeds=2)))
    for more in ({"workers": 2}, {"scheduler": "tcp://127.0.0.1:1"}):
        with pytest.raises(InputError, match=r"pip install 'ratslam\[sweep\]'"):
            list(results(asked, tmp_path / "out", **more))
    assert not any((tmp_path / "out" / FOLDER).iterdir())


def test_a_scheduler_that_is_not_there_is_told(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr("ratslam.experiments.studies.executor.ANSWER_TIME", 0.3)
    asked = jobs(read_study(tiny(seeds=2)))
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        with pytest.raises(InputError, match="--scheduler: no scheduler answers"):
            list(results(asked, tmp_path / "out", scheduler=address))


def test_a_folder_that_cannot_be_made_is_told(tiny, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot be made"):
        list(results(jobs(read_study(tiny())), tmp_path / "file", workers=1))


@pytest.mark.soak
def test_an_interrupt_keeps_what_is_done_and_leaves_nobody(tiny, tmp_path):
    study, output = tiny(seeds=60), tmp_path / "out"
    for count in (2, 6):
        process = start(study, output, "--workers", "2")
        wait_for(count, output, process)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        _, error = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130
        assert "Traceback" not in error
        assert "the same command goes on" in error
        gone(process.pid)
    assert main(["sweep", str(study), "-o", str(output), "--workers", "2"]) == 0
    assert not [path for path in (output / FOLDER).iterdir() if path.name.startswith(".")]


@pytest.mark.soak
def test_sweeps_killed_at_any_moment_go_on(tiny, tmp_path):
    study, output = tiny(seeds=40), tmp_path / "out"
    asked = jobs(read_study(study))
    expected = figures(results(asked, tmp_path / "whole", workers=1))
    for count in (0, 1, 2, 3, 5, 8, 13, 21):
        process = start(study, output, "--workers", "2")
        if count:
            wait_for(count, output, process)
        process.kill()
        process.communicate()
        gone(process.pid)
        for path in (output / FOLDER).glob("[!.]*.json"):
            assert read_result(output / FOLDER, path.stem) is not None
    assert figures(results(asked, output, workers=2)) == expected


@pytest.mark.soak
def test_a_scheduler_elsewhere_and_one_that_dies(tiny, tmp_path):
    asked = jobs(read_study(tiny(seeds=30)))
    expected = figures(results(asked, tmp_path / "alone", workers=1))
    dask = shutil.which("dask", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    there = os.environ | {"PYTHONPATH": str(ROOT)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path, "env": there}
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    port, address = "18786", "tcp://127.0.0.1:18786"
    worker = [dask, "worker", address, "--nworkers", "2", "--nthreads", "1", "--death-timeout", "20", *local]
    for deadly in (False, True):
        scheduler = subprocess.Popen([dask, "scheduler", "--port", port, *local], **quiet)
        workers = subprocess.Popen(worker, **quiet)
        try:
            output = tmp_path / f"out-{deadly}"
            if deadly:
                with pytest.raises(InputError, match="the scheduler went away"):
                    list(results(asked, output, scheduler=address, done=lambda _, it=scheduler: it.kill()))
                assert 0 < len(list((output / FOLDER).iterdir())) < 30
            else:
                assert figures(results(asked, output, scheduler=address)) == expected
        finally:
            for process in (scheduler, workers):
                process.terminate()
                process.wait()
