"""An undo in a run directory that fails or is stopped: it has not happened, or can be completed."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ratslam.cli import main
from ratslam.runs import folder_change
from ratslam.runs.map_care import map_info, undo_sequence
from ratslam.runs.saved_map import read_map
from tactile.base.errors import InputError
from tests.helpers.square_run import copy_square_run

MAKE = """
import os, signal, sys
from pathlib import Path
from ratslam.runs import folder_change

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
folder_change.change_folder(Path(sys.argv[1]), "change", "a", change)
"""
"""Changes a folder, and kills itself before the given one of the moments at which it renames or removes
something."""
OLD, NEW = dict.fromkeys(("a", "b", "gone"), "old"), dict.fromkeys(("a", "b", "more"), "new")


def seen(folder: Path) -> dict[str, str]:
    return {file.name: file.read_text() for file in folder.iterdir() if file.is_file()}


def content(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


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
        unfinished = folder_change.unfinished_change(folder)
        completed.append(unfinished is not None)
        if unfinished is not None:
            assert unfinished == "change"
            folder_change.finish_change(folder)
        assert seen(folder) in ((NEW,) if unfinished else (OLD, NEW))
        assert folder_change.unfinished_change(folder) is None
    assert seen(folder) == NEW
    assert list(folder.glob(".*")) == []
    assert completed.count(True) >= 4


def test_a_folder_whose_files_cannot_be_replaced_asks_for_a_repeat(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "a").write_text("old")

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "hidden")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", refuse)
        with pytest.raises(
            InputError, match=r"put in place \(Permission denied\).*repeat the command"
        ) as caught:
            folder_change.change_folder(
                tmp_path, "change", "a", lambda shown: os.replace(_written(shown / "b"), shown / "a")
            )
    assert str(caught.value).startswith(f"{tmp_path}: ")
    assert seen(tmp_path) == {"a": "old"}
    folder_change.finish_change(tmp_path)
    assert seen(tmp_path) == {"a": "new"}


def test_two_changes_of_a_folder_at_once_are_refused(tmp_path: Path) -> None:
    def change(shown: Path) -> None:
        with pytest.raises(InputError, match="another process changes this folder"):
            folder_change.change_folder(tmp_path, "second", "a", lambda _: None)
        _written(shown / "a")

    folder_change.change_folder(tmp_path, "first", "a", change)
    assert seen(tmp_path) == {"a": "new"}


def _written(path: Path) -> Path:
    path.write_text("new")
    return path


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, int]:
    """A run, and an accepted sequence of it."""
    path = copy_square_run(tmp_path / "run")
    return path, map_info(read_map(path))["accepted_sequences"][-1]["sequence"]


@pytest.mark.parametrize(
    ("name", "spoilt"),
    [
        ("steps.csv", None),
        ("online.tum", "1 2 damaged\n3 4\n"),
        ("walls.csv", "west\nx\n"),
        ("odometry.tum", None),
    ],
)
def test_a_spoilt_file_is_one_error_and_changes_nothing(name: str, spoilt: str | None, run, capsys) -> None:
    path, sequence = run
    (path / name).unlink(missing_ok=True)
    if spoilt is not None:
        (path / name).write_text(spoilt)
    before = content(path)
    capsys.readouterr()
    assert main(["map", "undo", str(path), str(sequence)]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"ratslam: error: {path / name}")
    assert said.count("\n") == 1
    assert content(path) == before


def test_an_error_while_the_last_file_is_made_changes_nothing(run, monkeypatch) -> None:
    path, sequence = run
    before = content(path)

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ratslam.runs.map_results.plot_writers", fail)
    with pytest.raises(KeyboardInterrupt):
        undo_sequence(read_map(path), sequence, path / "map.npz")
    assert content(path) == before


def test_an_undo_that_was_killed_between_its_files_is_completed_by_repeating_it(
    run, tmp_path, capsys, monkeypatch
) -> None:
    path, sequence = run
    whole = copy_square_run(tmp_path / "whole" / "run")
    assert main(["map", "undo", str(whole), str(sequence)]) == 0

    class Killed(BaseException):
        pass

    def replace(old: Path, new: Path) -> None:
        if new == path / "map.npz":
            raise Killed
        os.replace(old, new)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replace)
        with pytest.raises(Killed):
            main(["map", "undo", str(path), str(sequence)])
    assert main(["map", "info", str(path)]) == 0
    assert f"repeat `ratslam map undo {path} {sequence}`" in capsys.readouterr().err
    assert main(["map", "undo", str(path), str(sequence)]) == 0
    assert "is complete" in capsys.readouterr().out
    assert content(path) == content(whole)
