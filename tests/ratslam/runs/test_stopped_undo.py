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
from ratslam.runs.map_care import map_info, undo_sequence
from ratslam.runs.saved_map import read_map
from tactile.base import files
from tactile.base.errors import InputError
from tests.helpers.square_run import copy_square_run

MAKE = """
import os, signal, sys
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
        unfinished = files.unfinished_change(folder)
        completed.append(unfinished is not None)
        if unfinished is not None:
            assert unfinished == "change"
            files.finish_change(folder)
        assert seen(folder) in ((NEW,) if unfinished else (OLD, NEW))
        assert files.unfinished_change(folder) is None
    assert seen(folder) == NEW
    assert list(folder.glob(".*")) == []
    assert completed.count(True) >= 4


def renew(folder: Path) -> None:
    (folder / "b").write_text("new")
    (folder / "b").replace(folder / "a")


def test_a_folder_whose_files_cannot_be_replaced_asks_for_a_repeat(tmp_path: Path, monkeypatch) -> None:
    (tmp_path / "a").write_text("old")
    replace = Path.replace

    def refuse(old: Path, new: Path) -> None:
        if new == tmp_path / "a":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "hidden")
        replace(old, new)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", refuse)
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
    """A run, and an accepted sequence of it."""
    path = copy_square_run(tmp_path / "run")
    return path, map_info(read_map(path))["accepted_sequences"][-1]["sequence"]


def test_a_fault_before_the_last_file_is_made_changes_nothing(run, capsys, monkeypatch) -> None:
    """A file that is lost or spoilt is one error; Ctrl-C is none."""
    path, sequence = run
    whole = content(path)
    for name, spoilt in (
        ("steps.csv", None),
        ("online.tum", b"1 2 damaged\n3 4\n"),
        ("walls.csv", b"west\nx\n"),
    ):
        (path / name).unlink(missing_ok=True)
        if spoilt is not None:
            (path / name).write_bytes(spoilt)
        before = content(path)
        assert main(["map", "undo", str(path), str(sequence)]) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"ratslam: error: {path / name}")
        assert said.count("\n") == 1
        assert content(path) == before
        (path / name).unlink(missing_ok=True)
        if name in whole:
            (path / name).write_bytes(whole[name])

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ratslam.runs.map_results.plot_writers", interrupt)
    with pytest.raises(KeyboardInterrupt):
        undo_sequence(read_map(path), sequence, path / "map.npz")
    assert content(path) == whole


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
