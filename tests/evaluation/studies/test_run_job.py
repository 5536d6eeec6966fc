"""One job: the quantities of a run; time and memory. Tasks in several processes: order, errors, kills."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import jax
import psutil
import pytest

from evaluation.artifacts.run_reader import read_scorecard
from evaluation.metrics.occupancy_score import GRID_METRICS
from evaluation.studies.executor import Executor, run_tasks
from evaluation.studies.machine import COMPILED, Stopwatch
from evaluation.studies.metrics import MEASURED, METRICS
from evaluation.studies.run_job import run_job
from evaluation.studies.study import read_study
from ratslam.mapping.config import FULL
from ratslam.runs.run import run
from robot.recordings.mcap_writer import record_source
from robot.recordings.npz_trace import read_trace
from tactile.base.errors import InputError
from tests.helpers.commands import ROOT

SMALL = {"simulation.path": {"circuits": "CC"}}


@pytest.mark.parametrize("backend", ["classic", pytest.param("recall", marks=pytest.mark.soak)])
def test_a_job_has_the_quantities_of_a_run(tiny, tmp_path, backend):
    (job,) = read_study(tiny(set=SMALL | {"backend": backend}, seeds=[3])).jobs
    result = run_job(job)
    run(job.config, tmp_path / "run")
    card = read_scorecard(tmp_path / "run")
    assert list(result.quantities)[: len(card.quantities)] == list(card.quantities)
    for name, quantity in card.quantities.items():
        ours = result.quantities[name]
        assert (ours.label, ours.unit) == (quantity.label, quantity.unit)
        # Quaternions in files round headings.
        assert ours.value == (quantity.value and pytest.approx(quantity.value, rel=1e-6, abs=1e-9))
    assert result.steps == result.quantities["steps"].value
    assert (result.row, result.seed, result.error) == ("", 3, None)


def test_pace_and_earlier_jobs_change_no_quantity_and_a_perturbed_copy_is_another_session(tiny):
    vary, before = {"session.precision": ["float32", "float64"]}, jax.config.jax_enable_x64
    single, double = read_study(tiny(set=SMALL, vary=vary)).jobs
    (live, _) = read_study(tiny(set=SMALL, vary=vary, pace="live")).jobs
    (copy, _) = read_study(tiny(set=SMALL, vary=vary, copies=1)).jobs
    first, wide, stepwise, perturbed = map(run_job, (single, double, live, copy))
    assert first.quantities == stepwise.quantities
    assert first.quantities != wide.quantities or first.source == wide.source
    assert jax.config.jax_enable_x64 == before
    assert perturbed.source == f"{first.source}+1"
    assert perturbed.quantities["ate_final"].odometry != first.quantities["ate_final"].odometry
    step, compiling = first.value("step_time"), first.value("compile_time")
    assert 0 < step <= first.value("step_time_p99")
    assert step < 1.2 * first.value("run_time")
    assert compiling > 100e-6 * step  # not hidden among the steps
    assert first.value("memory") > 100
    assert first.machine.versions["jax"] == jax.__version__
    assert all(first.value(metric.name) > 0 for metric in MEASURED)


@pytest.mark.soak
def test_the_grid_filter_is_judged_by_its_map(tmp_path):
    base = f"base: {ROOT}/configs/create_arena.yaml\n"
    (tmp_path / "study.yaml").write_text(base + "set: {create_simulation.reports: 30}\n")
    (job,) = read_study(tmp_path / "study.yaml").jobs
    result = run_job(job)
    assert 0 < result.value("map_error") < 1
    assert 0 <= result.value("map_auc") <= 1
    assert set(result.quantities) <= set(METRICS)


def test_every_quantity_of_the_scorecards_is_known(tiny, tmp_path):
    """A search needs the direction of each quantity, and a table its worst value."""
    (job,) = read_study(tiny()).jobs
    (tmp_path / "relations").write_text("2.5,4.5,0,0,0,0,0,0\n2.5,6.5,0,0,0,0,0,0\n")
    score = job.config.score.model_copy(update={"relations": tmp_path / "relations"})
    config = job.config.model_copy(update={"score": score})
    result = run_job(job._replace(config=config, reference_tier="kinematic"))
    assert result.error is None
    maps = {name for name in METRICS if name.startswith("map_")}
    pieces = {metric.name for metric in METRICS.values() if metric.section == "Pieces"}
    assert set(result.quantities) | maps | pieces | {metric.name for metric in MEASURED} == set(METRICS)
    assert maps - {"map_error", "map_doubt"} == {metric.name for metric in GRID_METRICS}


def test_input_errors_are_results_and_other_errors_are_raised(tiny, tmp_path, monkeypatch):
    (job,) = read_study(tiny(set={"simulation.maze": {"file": "nowhere.txt"}})).jobs
    result = run_job(job)
    assert "nowhere.txt" in result.error
    assert (result.quantities, result.value("energy_all")) == ({}, None)
    record_source(read_trace(ROOT / "tests" / "golden" / "a_square3.npz"), tmp_path / "a.mcap")
    (tmp_path / "base.yaml").write_text("recording: {file: a.mcap}\n")
    (tmp_path / "study.yaml").write_text("base: base.yaml\ncopies: 1\n")
    (job,) = read_study(tmp_path / "study.yaml").jobs
    assert "streamed" in run_job(job).error
    given = []

    def build_session(config, source, ablation):
        given.append(ablation)
        raise ZeroDivisionError

    monkeypatch.setattr("evaluation.studies.run_job.build_session", build_session)
    for job in read_study(tiny(rows={"plain": {}, "off": {"ablation": {"verify": False}}})).jobs:
        with pytest.raises(ZeroDivisionError):
            run_job(job)
    assert given == [FULL, FULL.model_copy(update={"verify": False})]


def test_a_stopwatch_separates_compilation_from_steps(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("evaluation.studies.machine.perf_counter", lambda: now[0])
    watch = Stopwatch()
    with watch.taking(0):
        now[0] += 3.0
    for seconds, compiles in ((10.016, True), (0.016, False), (0.016, False), (0.032, False), (5.016, True)):
        with watch.taking(16):
            now[0] += seconds
            if compiles:
                jax.monitoring.record_event_duration_secs(COMPILED, seconds)
    result = watch.times()
    assert result["step_time_p99"] == pytest.approx(2000, rel=0.02)
    found = [result[name] for name in ("step_time", "compile_time", "run_time")]
    assert found == pytest.approx([1000, 18.0, (now[0] - 18.0) * 1e6 / 80])


def test_closures_true_and_false_are_counted(tmp_path):
    (tmp_path / "study.yaml").write_text(f"base: {ROOT}/configs/square.yaml\n")
    (job,) = read_study(tmp_path / "study.yaml").jobs
    found = run_job(job)
    assert found.value("ate_final") < 0.02 < found.quantities["ate_final"].odometry
    assert found.value("anytime_median") < found.quantities["ate_final"].odometry
    assert found.value("closures") > 150 > found.value("false_closures") == 0
    assert found.value("lost_share") < 0.5


def square(value: int) -> int:
    return value * value


def fail(value: int) -> int:
    raise InputError("a.b", str(value), "another value")


def die_once(path: str) -> int:
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


def test_one_worker_is_this_process_which_is_the_default_without_dask(monkeypatch, capsys):
    found = list(run_tasks(process_of, [3, 1, 2], workers=1))
    assert found == [(value, os.getpid()) for value in (3, 1, 2)]
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    assert [pid for _, pid in run_tasks(process_of, [1, 2])] == [os.getpid()] * 2
    assert capsys.readouterr().err.count("pip install 'ratslam[sweep]'") == 1
    for asked in ({"scheduler": "tcp://127.0.0.1:1"}, {"workers": 2}):
        with pytest.raises(InputError, match=rf"--{next(iter(asked))}: .*pip install 'ratslam\[sweep\]'"):
            list(run_tasks(square, [1, 2], **asked))


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


def test_a_fresh_executor_survives_a_kill_and_a_scheduler_that_does_not_answer_is_reported(monkeypatch):
    with Executor(fresh=True) as executor:
        pids = [pid for _, (_, pid) in executor.completed(process_of, [1, 2])]
        assert len({*pids, os.getpid()}) == 3
        assert list(executor.completed(die, [7], lambda task: -task)) == [(0, -7)]
        with pytest.raises(InputError, match="killed"):
            list(executor.completed(die, [7]))
        with pytest.raises(InputError, match=r"a\.b: 5"):
            list(executor.completed(fail, [5]))
    monkeypatch.setattr("evaluation.studies.executor.ANSWER_TIME", 0.3)
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        with pytest.raises(InputError, match="--scheduler: no scheduler answers"):
            list(run_tasks(square, [1, 2], scheduler=address))


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
    name = "JAX_COMPILATION_CACHE_DIR"
    monkeypatch.setenv(name, "kernels")
    assert list(run_tasks(os.getenv, [name] * 2, workers=2)) == ["kernels"] * 2
    assert not list(tmp_path.iterdir())


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
