"""Tasks in several processes: order, errors, kills and missing libraries."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from ratslam.experiments.studies.executor import Executor, run_tasks
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[4]


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


def process_of(value: int) -> tuple[int, int]:
    return value, os.getpid()


def test_one_worker_is_this_process():
    done: list[int] = []
    found = list(run_tasks(process_of, [3, 1, 2], workers=1, progress=done.append))
    assert found == [(value, os.getpid()) for value in (3, 1, 2)]
    assert done == [0, 1, 2]


def test_no_tasks_give_no_results():
    assert list(run_tasks(square, [], workers=2)) == []


def test_several_processes_keep_the_order_repeat_what_is_killed_and_listen_to_this_machine_only(tmp_path):
    addresses: set[str] = set()
    done: list[int] = []

    def look(index):
        done.append(index)
        for pid in [os.getpid(), *(each.pid for each in multiprocessing.active_children())]:
            with suppress(psutil.NoSuchProcess):  # the killed one
                sockets = psutil.Process(pid).net_connections()
                addresses.update(each.laddr.ip for each in sockets if each.status == psutil.CONN_LISTEN)

    tasks = [str(tmp_path / name) for name in "abcd"]
    Path(tasks[0]).touch()
    for name in tasks[2:]:
        Path(name).touch()
    found = list(run_tasks(die_once, tasks, workers=2, progress=look))
    assert len(found) == 4
    assert os.getpid() not in found
    assert sorted(done) == [0, 1, 2, 3]
    assert addresses == {"127.0.0.1"}
    assert not multiprocessing.active_children()


def test_errors_of_tasks_come_out_of_other_processes():
    with pytest.raises(InputError, match=r"a\.b: 5; expected another value"):
        list(run_tasks(fail, [5, 5], workers=2))


def test_a_fresh_executor_runs_each_task_in_a_new_process_and_survives_a_kill():
    with Executor(fresh=True) as executor:
        pids = [pid for _, (_, pid) in executor.completed(process_of, [1, 2])]
        assert len({*pids, os.getpid()}) == 3
        assert list(executor.completed(die, [7], lambda task: -task)) == [(0, -7)]
        with pytest.raises(InputError, match="killed"):
            list(executor.completed(die, [7]))
        with pytest.raises(InputError, match=r"a\.b: 5"):
            list(executor.completed(fail, [5]))


@pytest.mark.parametrize("options", [{"workers": 2}, {"scheduler": "tcp://127.0.0.1:1"}])
def test_a_missing_dask_is_reported(monkeypatch, options):
    for module in ("dask", "distributed"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"pip install 'ratslam\[sweep\]'"):
        list(run_tasks(square, [1, 2], **options))


def test_without_dask_one_process_is_the_default(monkeypatch):
    for module in ("dask", "distributed"):
        monkeypatch.setitem(sys.modules, module, None)
    assert list(run_tasks(process_of, [1, 2])) == [(1, os.getpid()), (2, os.getpid())]


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nonsense://x"])
def test_a_scheduler_that_does_not_answer_is_reported(monkeypatch, address):
    monkeypatch.setattr("ratslam.experiments.studies.executor.ANSWER_TIME", 0.3)
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
            with pytest.raises(InputError, match="the scheduler went away"):
                list(run_tasks(square, range(3000), scheduler=address, progress=lambda _: scheduler.kill()))
        else:
            assert list(run_tasks(square, range(30), scheduler=address)) == [k * k for k in range(30)]
    finally:
        for process in (scheduler, workers):
            process.terminate()
            process.wait()
