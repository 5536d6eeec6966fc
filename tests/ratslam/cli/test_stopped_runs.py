"""Stopped runs are scored or readable, and continue; a stopped undo is none, or can be completed."""

import errno
import gc
import json
import os
import signal
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ratslam.cli import Program, main
from ratslam.runs.build_session import open_observations
from ratslam.runs.map_care import map_info, undo_sequence
from ratslam.runs.run import catch_interrupt, process_source
from ratslam.runs.runner import open_runner
from ratslam.runs.saved_map import read_map
from ratslam.runs.settings.run_config import load_config
from tactile.base import files
from tactile.base.errors import InputError
from tests.helpers.commands import ROOT, contents, copy_square_run, refused, said, start


@pytest.fixture(scope="module")
def corridor(tmp_path_factory):
    """A config that runs for some seconds, and its uninterrupted run."""
    folder = tmp_path_factory.mktemp("corridor")
    config, golden = folder / "long.yaml", ROOT / "tests" / "golden" / "c_corridor_wrap.npz"
    config.write_text(
        f"recording: {{file: {golden}}}\npose_cells: {{cells_xy: 61, cells_heading: 9, cell_size: 0.3}}\n"
        "recall: {frame_distance: 0.05}\n"
    )

    with open_observations(load_config(config)) as opened, open_runner(*opened, folder / "whole") as runner:
        assert not process_source(runner, opened[1])
        runner.finish(interrupted=False)
    session = runner.session
    assert session.backend.rows(session.state) > 256, "fits into the smallest capacity"
    assert session.compilations() == 1, "its length is known"
    return config, folder / "whole"


def wait_for_steps(process, directory, size=400):
    """Until the file of steps has so many bytes, by default some lines, or the process has ended."""
    steps = directory / "steps.csv"
    while process.poll() is None and not (steps.exists() and steps.stat().st_size > size):
        time.sleep(0.005)


def test_an_interrupted_run_is_scored_and_continues(corridor, tmp_path):
    """By SIGTERM, which does what Ctrl-C does but for the code."""
    config, whole = corridor
    first, second = tmp_path / "first", tmp_path / "second"
    process = start("run", config, "-o", first)
    wait_for_steps(process, first)
    process.send_signal(signal.SIGTERM)
    _, messages = process.communicate()
    assert process.returncode == 143, messages
    assert json.loads((first / "manifest.json").read_text())["status"] == "interrupted"
    # No closure yet, and so no views of one.
    later = {"closure_views.npz", "calibration.yaml"}
    assert {path.name for path in first.iterdir()} == {path.name for path in whole.iterdir()} - later
    assert len((first / "closures.csv").read_text().splitlines()) == 1
    assert main(["run", str(config), "--continue", str(first / "map.npz"), "-o", str(second)]) == 0
    added = (second / "steps.csv").read_text().split("\n", 1)[1]
    assert (first / "steps.csv").read_text() + added == (whole / "steps.csv").read_text()
    assert (whole / "trajectory.tum").read_text().endswith((second / "trajectory.tum").read_text())


def test_an_interrupt_is_not_lost_in_the_garbage_collector(monkeypatch):
    """Python prints what callbacks of the collector raise (JAX has one) and goes on."""

    def collect(times):
        presses = iter(range(times))

        def interrupt(*_):
            if next(presses, None) is not None:
                signal.raise_signal(signal.SIGINT)

        gc.callbacks.append(interrupt)
        gc.collect(0)  # calls it twice
        gc.callbacks.remove(interrupt)
        time.sleep(10)

    with pytest.raises(KeyboardInterrupt), catch_interrupt("ending"):
        collect(2)
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)  # programs in the background ignore it
    monkeypatch.setattr(Program, "parse_args", lambda *_: Namespace(command=lambda _: collect(1)))
    try:
        assert main(["run"]) == 130
    finally:
        signal.signal(signal.SIGINT, usual)


def check_killed_run(whole, directory):
    """A killed run has a prefix of the lines, and can be scored from its first step on."""
    for name in ("steps.csv", "online.tum", "odometry.tum", "truth.tum"):
        if (directory / name).exists():
            written = (directory / name).read_bytes()
            assert (whole / name).read_bytes().startswith(written)
            assert not written or written.endswith(b"\n")
    code = main(["score", str(directory)])
    rows = (directory / "steps.csv").read_text().count("\n") if (directory / "steps.csv").exists() else 0
    assert code == (0 if rows > 1 else 2)


def kill_and_continue(config, whole, directory, moment):
    """Kills a run at a share of its steps (above 1: that much less 1, s, after the last) and continues it."""
    killed, rest = directory / "killed", directory / "rest"
    process, size = start("run", config, "-o", killed), (whole / "steps.csv").stat().st_size
    wait_for_steps(process, killed, min(moment, 1.0) * size - 1)
    if moment > 1:
        time.sleep(moment - 1)
    process.kill()
    process.communicate()
    check_killed_run(whole, killed)
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


MAKE = """
import os, signal, sys
from collections.abc import Callable
from pathlib import Path
from tactile.base import files

left = int(sys.argv[2])

def stop(event, arguments):
    global left
    if event in ("os.rename", "os.remove"):
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

def change(folder):
    for file in list(folder.iterdir()):
        file.unlink()
        if file.name != "gone":
            file.write_text("new")
    (folder / "more").write_text("new")

sys.addaudithook(stop)
files.change_folder(Path(sys.argv[1]), "change", "a", change)
"""
"""Changes a folder, and kills itself before the given one of the moments at which it renames or removes
something."""
OLD, NEW = dict.fromkeys(("a", "b", "gone"), "old"), dict.fromkeys(("a", "b", "more"), "new")


def seen(folder: Path) -> dict[str, str]:
    return {file.name: file.read_text() for file in folder.iterdir() if file.is_file()}


def test_a_change_that_is_killed_at_any_moment_is_none_or_can_be_completed(tmp_path: Path) -> None:
    completed = []
    for moment in range(30):
        folder = tmp_path / str(moment)
        folder.mkdir()
        for name, text in OLD.items():
            (folder / name).write_text(text)
        code = subprocess.run([sys.executable, "-c", MAKE, str(folder), str(moment)]).returncode
        if code == 0:
            break
        assert code == -signal.SIGKILL
        unfinished = files.unfinished_change(folder)
        completed.append(unfinished is not None)
        if unfinished is not None:
            assert unfinished == "change"
            files.finish_change(folder)
        assert seen(folder) in ((NEW,) if unfinished else (OLD, NEW))
        assert files.unfinished_change(folder) is None
    assert (seen(folder), list(folder.glob(".*"))) == (NEW, [])
    assert completed.count(True) >= 4


def renew(folder: Path) -> None:
    (folder / "b").write_text("new")
    (folder / "b").replace(folder / "a")


def failing_at(file: Path, error: BaseException) -> Callable[[Path, Path], None]:
    """`Path.replace` that fails if this file is to be replaced."""

    def replace(old: Path, new: Path) -> None:
        if new == file:
            raise error
        os.replace(old, new)

    return replace


def test_a_folder_whose_files_cannot_be_replaced_asks_for_a_repeat(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "a").write_text("old")
    denied = PermissionError(errno.EACCES, os.strerror(errno.EACCES), "hidden")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", failing_at(tmp_path / "a", denied))
        with pytest.raises(InputError, match=f"^{tmp_path}: .*Permission denied.*repeat the command"):
            files.change_folder(tmp_path, "change", "a", renew)
    assert seen(tmp_path) == {"a": "old"}
    files.finish_change(tmp_path)
    assert seen(tmp_path) == {"a": "new"}


def test_two_changes_of_a_folder_at_once_are_refused(tmp_path: Path) -> None:
    def change(shown: Path) -> None:
        with pytest.raises(InputError, match="another process changes this folder"):
            files.change_folder(tmp_path, "second", "a", renew)
        renew(shown)

    files.change_folder(tmp_path, "first", "a", change)
    assert seen(tmp_path) == {"a": "new"}


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, int]:
    path = copy_square_run(tmp_path / "run")
    return path, map_info(read_map(path))["accepted_sequences"][-1]["sequence"]


def test_a_fault_before_the_last_file_is_made_changes_nothing(run, capsys, monkeypatch) -> None:
    """A file that is lost or spoilt is one error; Ctrl-C is none."""
    path, sequence = run
    whole = contents(path)
    faults = {"steps.csv": None, "online.tum": b"1 2 damaged\n3 4\n", "walls.csv": b"west\nx\n"}
    for name, spoilt in faults.items():
        (path / name).unlink(missing_ok=True)
        if spoilt is not None:
            (path / name).write_bytes(spoilt)
        before = contents(path)
        assert refused(capsys, "map", "undo", path, sequence).startswith(str(path / name))
        assert contents(path) == before
        (path / name).unlink(missing_ok=True)
        if name in whole:
            (path / name).write_bytes(whole[name])

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ratslam.runs.map_results.plot_writers", interrupt)
    with pytest.raises(KeyboardInterrupt):
        undo_sequence(read_map(path), sequence, path / "map.npz")
    assert contents(path) == whole


def test_an_undo_that_was_killed_amid_its_files_is_completed_by_a_repeat(run, tmp_path, capsys, monkeypatch):
    (path, sequence), whole = run, copy_square_run(tmp_path / "whole" / "run")
    assert main(["map", "undo", str(whole), str(sequence)]) == 0
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", failing_at(path / "map.npz", GeneratorExit()))  # no error of a command
        with pytest.raises(GeneratorExit):
            main(["map", "undo", str(path), str(sequence)])
    assert main(["map", "info", str(path)]) == 0
    assert f"repeat `ratslam map undo {path} {sequence}`" in capsys.readouterr().err
    assert "is complete" in said(capsys, "map", "undo", path, sequence)
    assert contents(path) == contents(whole)
