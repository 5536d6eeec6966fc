"""Tasks in several processes: order, errors, kills and missing libraries."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import psutil
import pytest

from evaluation.studies.executor import Executor, run_tasks
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[3]


def square(value: int) -> int:
    return value * value


def fail(value: int) -> int:
    raise InputError("a.b", str(value), "another value")


def die_once(path: str) -> int:
    """Kills its process the first time."""
    if not Path(path).exists():
        Path(path).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


def die(value: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return value


def wait(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def process_of(value: int) -> tuple[int, int]:
    return value, os.getpid()


def test_one_worker_is_this_process():
    found = list(run_tasks(process_of, [3, 1, 2], workers=1))
    assert found == [(value, os.getpid()) for value in (3, 1, 2)]


def test_several_processes_keep_the_order_repeat_what_is_killed_and_end(tmp_path):
    tasks = [str(tmp_path / name) for name in "abcd"]
    for name in (tasks[0], *tasks[2:]):
        Path(name).touch()
    found = list(run_tasks(die_once, tasks, workers=2))
    assert len(found) == 4
    assert os.getpid() not in found
    assert list(run_tasks(square, [], workers=2)) == []
    with closing(run_tasks(wait, [0.5, 0.0, 600.0], workers=2)) as results:
        assert [next(results), next(results)] == [0.5, 0.0]
    with pytest.raises(InputError, match=r"a\.b: 5; expected another value"):
        list(run_tasks(fail, [5, 5], workers=2))
    assert not multiprocessing.active_children()


def test_a_fresh_executor_runs_each_task_in_a_new_process_and_survives_a_kill():
    with Executor(fresh=True) as executor:
        pids = [pid for _, (_, pid) in executor.completed(process_of, [1, 2])]
        assert len({*pids, os.getpid()}) == 3
        assert list(executor.completed(die, [7], lambda task: -task)) == [(0, -7)]
        with pytest.raises(InputError, match="killed"):
            list(executor.completed(die, [7]))
        with pytest.raises(InputError, match=r"a\.b: 5"):
            list(executor.completed(fail, [5]))


@pytest.mark.parametrize("asked", [{"scheduler": "tcp://127.0.0.1:1"}, {"workers": 2}])
def test_a_missing_dask_is_reported_to_those_who_need_it(monkeypatch, asked):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=rf"--{next(iter(asked))}: .*pip install 'ratslam\[sweep\]'"):
        list(run_tasks(square, [1, 2], **asked))


def test_without_dask_the_default_is_one_process(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    assert [pid for _, pid in run_tasks(process_of, [1, 2])] == [os.getpid()] * 2
    assert capsys.readouterr().err.count("pip install 'ratslam[sweep]'") == 1


def test_two_local_executors_answer_only_this_machine():
    with Executor(2) as first, Executor(2) as second:
        for executor in (first, second):
            assert len(list(executor.completed(square, [1, 2]))) == 2
        own = psutil.Process()
        sockets = [each for one in (own, *own.children(recursive=True)) for each in one.net_connections()]
        listening = {each.laddr.ip for each in sockets if each.status == psutil.CONN_LISTEN}
    assert listening == {"127.0.0.1"}


def test_processes_of_this_machine_share_its_environment_and_leave_no_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "kernels")
    name = "JAX_COMPILATION_CACHE_DIR"
    assert list(run_tasks(os.getenv, [name] * 2, workers=2)) == ["kernels"] * 2
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://x"])
def test_a_scheduler_that_does_not_answer_is_reported(monkeypatch, address):
    monkeypatch.setattr("evaluation.studies.executor.ANSWER_TIME", 0.3)
    with pytest.raises(InputError, match="--scheduler: no scheduler answers"):
        list(run_tasks(square, [1, 2], scheduler=address))


@pytest.mark.soak
@pytest.mark.parametrize("deadly", [False, True])
def test_a_scheduler_elsewhere_and_one_that_dies(tmp_path, deadly):
    dask = shutil.which("dask", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    there = os.environ | {"PYTHONPATH": str(ROOT)}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "cwd": tmp_path, "env": there}
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    port, address = "18786", "tcp://127.0.0.1:18786"
    worker = [dask, "worker", address, "--nworkers", "2", "--nthreads", "1", "--death-timeout", "20", *local]
    scheduler = subprocess.Popen([dask, "scheduler", "--port", port, *local], **quiet)
    workers = subprocess.Popen(worker, **quiet)
    try:
        if deadly:
            results = run_tasks(square, range(3000), scheduler=address)
            next(results)
            scheduler.kill()
            with pytest.raises(InputError, match="the scheduler went away"):
                list(results)
        else:
            assert list(run_tasks(square, range(30), scheduler=address)) == [k * k for k in range(30)]
    finally:
        for process in (scheduler, workers):
            process.terminate()
            process.wait()
