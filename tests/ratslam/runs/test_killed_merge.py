"""A process that is killed while it merges maps: both maps stay as they are, and what it leaves is hidden and
does not hinder the next merge."""

from __future__ import annotations

import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from ratslam.places.crop import keyframes_of_steps
from ratslam.runs import merge as merging
from ratslam.runs.map_care import crop_saved
from ratslam.runs.merge import merge_maps
from ratslam.runs.saved_map import read_map
from tests.ratslam.runs.test_map_formats import FILES

MERGE = """
import os, signal, sys
from pathlib import Path

from ratslam.runs import merge

moment, output, *maps = sys.argv[1:]
left = int(moment)

def stop(event, arguments):
    global left
    if event not in ("open", "os.rename", "os.mkdir") or isinstance(arguments[0], int):
        return
    if os.fsdecode(arguments[0]).startswith(os.path.dirname(output)):
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)

merge.join_all = lambda *_: []  # takes most of the time, and writes nothing
sys.addaudithook(stop)
merge.merge_maps([Path(one) for one in maps], Path(output))
"""
"""Merges maps, and kills itself before the given one of the moments at which it opens, creates or renames
something beside the output."""


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The halves of a map."""
    folder = tmp_path_factory.mktemp("maps")
    halves = [folder / "first.npz", folder / "second.npz"]
    for begin, half in zip((0, 180), halves, strict=True):
        crop_saved(read_map(FILES[-1]), partial(keyframes_of_steps, first=begin, last=begin + 180), half)
    return halves


def is_killed(moment: int, output: Path, maps: list[Path]) -> bool:
    command = [sys.executable, "-c", MERGE, str(moment), str(output), *map(str, maps)]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode in (0, -signal.SIGKILL), found.stderr
    return found.returncode != 0


def check_kill(moment: int, output: Path, maps: list[Path]) -> bool:
    """Kills a merge before a moment, if it has so many; returns whether it has."""
    output.parent.mkdir()
    before = [path.read_bytes() for path in maps]
    killed = is_killed(moment, output, maps)
    assert [path.read_bytes() for path in maps] == before
    if killed:
        assert not output.exists()
        assert all(path.name.startswith(".") for path in output.parent.iterdir())
    else:
        assert list(output.parent.iterdir()) == [output]
        assert read_map(output).steps == 360
    return killed


@pytest.mark.parametrize(
    ("name", "moment"), [("both.npz", 1), pytest.param("both", 5, marks=pytest.mark.soak)]
)
def test_a_killed_merge_leaves_the_maps_and_no_half_map(
    name: str, moment: int, maps: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed once its map file is whole but not in its place yet, and while it writes the other files."""
    output = tmp_path / "out" / name
    assert check_kill(moment, output, maps)
    left = {path.name for path in output.parent.iterdir()}
    assert left
    monkeypatch.setattr(merging, "join_all", lambda *_: [])
    merge_maps(maps, output)
    assert read_map(output).steps == 360
    assert {path.name for path in output.parent.iterdir()} == left | {name}


@pytest.mark.soak
@pytest.mark.parametrize("name", ["both.npz", "both"])
def test_a_merge_may_be_killed_at_every_moment(name: str, maps: list[Path], tmp_path: Path) -> None:
    moment = 0
    while check_kill(moment, tmp_path / str(moment) / name, maps):
        moment += 1
    assert moment >= 3
