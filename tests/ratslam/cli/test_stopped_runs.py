"""Interrupted runs are scored and continue; killed ones are readable."""

from __future__ import annotations

import gc
import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from ratslam.cli import main
from ratslam.runs.build_session import open_observations
from ratslam.runs.run import catch_interrupt, process_source
from ratslam.runs.runner import open_runner
from ratslam.runs.settings.run_config import load_config
from tests.helpers.commands import ROOT


@pytest.fixture(scope="module")
def corridor(tmp_path_factory):
    """A config that runs for some seconds, and its uninterrupted run."""
    folder = tmp_path_factory.mktemp("corridor")
    config = folder / "long.yaml"
    golden = ROOT / "tests" / "golden" / "c_corridor_wrap.npz"
    config.write_text(
        f"recording: {{file: {golden}}}\npose_cells: {{cells_xy: 61, cells_heading: 9, cell_size: 0.3}}\n"
        "recall: {frame_distance: 0.05}\n"
    )
    with (
        open_observations(load_config(config)) as (completed, source),
        open_runner(completed, source, folder / "whole") as runner,
    ):
        assert not process_source(runner, source)
        runner.finish(interrupted=False)
    session = runner.session
    assert session.backend.rows(session.state) > 256, "fits into the smallest capacity"
    assert session.compilations() == 1, "its length is known"
    return config, folder / "whole"


def start(config, directory):
    """The program in a process of its own."""
    command = [sys.executable, "-m", "ratslam", "run", str(config), "-o", str(directory)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def wait_for_steps(process, directory, size=400):
    """Waits until the file of steps has so many bytes (by default some lines beside the first one, of names),
    or the process has ended."""
    steps = directory / "steps.csv"
    while process.poll() is None and not (steps.exists() and steps.stat().st_size > size):
        time.sleep(0.005)


def test_an_interrupted_run_is_scored_and_continues(corridor, tmp_path):
    """By SIGTERM, which does what Ctrl-C does but for the code."""
    config, whole = corridor
    process = start(config, tmp_path / "first")
    wait_for_steps(process, tmp_path / "first")
    process.send_signal(signal.SIGTERM)
    _, messages = process.communicate()
    first = tmp_path / "first"
    assert process.returncode == 143, messages
    assert json.loads((first / "manifest.json").read_text())["status"] == "interrupted"
    # No closure yet, and so no views of one.
    later = {"closure_views.npz", "calibration.yaml"}
    assert {path.name for path in first.iterdir()} == {path.name for path in whole.iterdir()} - later
    assert len((first / "closures.csv").read_text().splitlines()) == 1
    second = tmp_path / "second"
    assert main(["run", str(config), "--continue", str(first / "map.npz"), "-o", str(second)]) == 0
    added = (second / "steps.csv").read_text().split("\n", 1)[1]
    assert (first / "steps.csv").read_text() + added == (whole / "steps.csv").read_text()
    assert (whole / "trajectory.tum").read_text().endswith((second / "trajectory.tum").read_text())


def test_a_second_interrupt_is_not_lost_in_the_garbage_collector():
    """Python prints what callbacks of the collector raise (JAX has one) and goes on."""

    def interrupt(phase, info):
        signal.raise_signal(signal.SIGINT)

    def collect():
        gc.callbacks.append(interrupt)
        gc.collect(0)  # calls it twice
        gc.callbacks.remove(interrupt)
        time.sleep(10)

    with pytest.raises(KeyboardInterrupt), catch_interrupt("ending"):
        collect()


def check_killed_run(corridor, directory):
    """A killed run has a prefix of the lines, and can be scored from its first step on; how many."""
    _, whole = corridor
    for name in ("steps.csv", "online.tum", "odometry.tum", "truth.tum"):
        if (directory / name).exists():
            written = (directory / name).read_bytes()
            assert (whole / name).read_bytes().startswith(written)
            assert not written or written.endswith(b"\n")
    code = main(["score", str(directory)])
    rows = (directory / "steps.csv").read_text().count("\n") if (directory / "steps.csv").exists() else 0
    assert code == (0 if rows > 1 else 2)
    return rows


@pytest.mark.soak
def test_fifty_killed_runs_are_readable(corridor, tmp_path):
    began = time.monotonic()
    start(corridor[0], tmp_path / "timed").communicate()
    whole = time.monotonic() - began  # a busy machine takes longer
    rows = []
    for k, delay in enumerate(whole * np.random.default_rng(0).uniform(0.1, 1.0, 50)):
        process = start(corridor[0], tmp_path / str(k))
        try:
            process.communicate(timeout=delay)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
        rows.append(check_killed_run(corridor, tmp_path / str(k)))
    print("rows left by each kill:", rows)
    assert sum(count > 1 for count in rows) > 10


def kill_and_continue(config, whole, directory, moment):
    """Kills a run at a share of its steps, or so many s after its last step, and compares the continued one.

    Args:
        moment: share of the final size of steps.csv; above 1: one more than a time, s.
    """
    killed, rest = directory / "killed", directory / "rest"
    process = start(config, killed)
    size = (whole / "steps.csv").stat().st_size
    wait_for_steps(process, killed, min(moment, 1.0) * size - 1)
    if moment > 1:
        time.sleep(moment - 1)
    process.kill()
    process.communicate()
    check_killed_run((config, whole), killed)
    (killed / ".1.map.npz").write_text("cut")  # as of a kill while a checkpoint is written
    status = json.loads((killed / "manifest.json").read_text())["status"]
    code = main(["run", str(config), "--continue", str(killed), "-o", str(rest)])
    if status == "complete":  # the kill came too late
        assert code == 2
        rest = killed
    else:
        assert not list(killed.glob(".*.npz"))
    with np.load(whole / "map.npz") as expected, np.load(rest / "map.npz") as found:
        assert expected.files == found.files
        assert [name for name in found.files if expected[name].tobytes() != found[name].tobytes()] == []
    assert (whole / "trajectory.tum").read_text().endswith((rest / "trajectory.tum").read_text())
    return json.loads((rest / "manifest.json").read_text()).get("first_step", 0)


@pytest.mark.parametrize(("moment", "begins"), [(0.0, "anew"), (0.6, "amid"), (1.0, "amid")])
def test_a_killed_run_continues_to_the_same_bits(corridor, tmp_path, moment, begins, capsys):
    """Before its first checkpoint, amid its steps, and while its results are written."""
    first = kill_and_continue(*corridor, tmp_path, moment)
    assert ("killed before its first checkpoint" in capsys.readouterr().err) == (begins == "anew")
    assert (first > 0) == (begins == "amid")


@pytest.mark.soak
@pytest.mark.parametrize("number", range(30))
def test_thirty_killed_runs_of_the_maze_continue_to_the_same_bits(number, tmp_path, tmp_path_factory):
    whole = tmp_path_factory.getbasetemp() / "maze"
    if not whole.exists():
        assert main(["run", "whisker_maze", "-o", str(whole)]) == 0
    moment = 1.15 * np.random.default_rng(0).random(30)[number]  # with the writing of the results
    moment = moment if moment < 1 else 1 + 20 * (moment - 1)
    print("continued after step", kill_and_continue("whisker_maze", whole, tmp_path, moment))
