"""Paths that are no readable map say what they are: damaged, empty, unreadable, moved, or no recording."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

import ratslam
from ratslam.core.backend import PathMap
from ratslam.methods.config import LocaliseConfig
from ratslam.methods.finished_map import restore_map
from ratslam.runs.localise import recorded_alike
from ratslam.runs.map_care import map_info, undo_sequence
from ratslam.runs.saved_map import read_map
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tactile.base.errors import InputError

FILE = Path(__file__).parents[2] / "data" / "maps" / "ratslam-map-1.npz"
READINGS = Path(__file__).parents[2] / "golden" / "touch_circuits.mcap"


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_map(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    return said.removeprefix(f"{path}: ")


def test_a_damaged_map_is_told_from_another_file(tmp_path: Path) -> None:
    path, whole = tmp_path / "map.npz", FILE.read_bytes()
    middle = len(whole) // 2
    for content in (whole[:middle], whole[:-1], whole[:middle] + bytes(8) + whole[middle + 8 :]):
        path.write_bytes(content)
        said = refusal(path)
        assert said.startswith("damaged")
        assert "restore it from a copy" in said
    path.write_bytes(b"t,x,y\n")
    assert refusal(path).startswith("not a map; expected a map")
    path.write_bytes(b"")
    assert refusal(path).startswith("empty")


def test_a_map_that_cannot_be_opened_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pipe = tmp_path / "pipe.npz"
    os.mkfifo(pipe)
    assert refusal(pipe).startswith("neither a file nor a folder; expected a map")
    assert refusal(FILE / "map.npz").startswith("cannot be read (Not a directory); ")

    def deny(path: Path, *_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "open", deny)
    said = refusal(FILE)
    assert said.startswith("cannot be read (Permission denied); ")
    assert "permissions" in said


def test_a_run_directory_is_a_finished_map(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"^{tmp_path / 'map.npz'}: no such file; expected the map in which"):
        restore_map(LocaliseConfig(map=tmp_path), PathMap(), "recall")


@pytest.mark.soak
def test_a_localised_session_names_its_map_that_was_changed_or_moved(tmp_path: Path) -> None:
    place, session = tmp_path / "place.npz", tmp_path / "session.npz"
    shutil.copy(FILE, place)
    slam = ratslam.Slam.load(place, "localise")
    with open_recording(RecordingConfig(file=READINGS)) as recording:
        for sample, _ in zip(recording, range(5), strict=False):
            slam.step(sample.reading)
    slam.save(session)
    assert map_info(read_map(session))["steps"] == 5
    saved = read_map(place)
    first = map_info(saved)["accepted_sequences"][0]["sequence"]
    undo_sequence(saved, first, place)
    with pytest.raises(
        InputError, match=f"expected {place} as it was when this session was localised in it; "
    ):
        read_map(session).open_session()
    place.unlink()
    with pytest.raises(InputError, match=f"{place}: no such file; expected the map in which"):
        read_map(session).open_session()


def test_a_map_in_the_place_of_a_recording_is_one_error(tmp_path: Path) -> None:
    shutil.copy(FILE, tmp_path / "map.npz")
    for path in (FILE, tmp_path):
        with pytest.raises(InputError, match="a map, which is no recording") as caught:
            recorded_alike(path, read_map(FILE))
        assert "\n" not in str(caught.value)
