"""Maps that hold the same session are not merged: continued, merged, cropped and corrected ones. Settings
that differ are told."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

import ratslam
from ratslam.cli import main
from ratslam.places.crop import keyframes_of_steps
from ratslam.runs import merge as merging
from ratslam.runs.map_care import crop_saved, undo_sequence
from ratslam.runs.map_settings import differing_settings
from ratslam.runs.merge import check_mergeable, describe_merge, merge_maps
from ratslam.runs.saved_map import read_map, write_map
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tests.ratslam.runs.test_map_formats import FILES

READINGS = Path(__file__).parents[2] / "golden" / "touch_circuits.mcap"
WHOLE = FILES[-1]


def part(path: Path, first: int, last: int) -> Path:
    """The steps of a map from `first` to `last` - 1."""
    crop_saved(read_map(WHOLE), partial(keyframes_of_steps, first=first, last=last), path)
    return path


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("halves")
    return [part(folder / "one.npz", 0, 180), part(folder / "two.npz", 180, 360)]


def refused(capsys: pytest.CaptureFixture[str], target: Path, *maps: Path) -> str:
    assert main(["merge", *map(str, maps), "-o", str(target)]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert not target.exists()
    return error


def test_a_part_of_a_map_is_not_merged_with_the_map(halves, capsys, tmp_path: Path) -> None:
    error = refused(capsys, tmp_path / "both", WHOLE, halves[1])
    assert str(WHOLE) in error
    assert str(halves[1]) in error
    assert "keyframes are equal to the bit; expected maps of different sessions" in error
    assert "all of which is in the other map" in error


def test_a_merged_map_holds_both_sessions(halves, capsys, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(merging, "join_all", lambda *_: [])
    merge_maps(halves, tmp_path / "both.npz")
    for half in halves:
        error = refused(capsys, tmp_path / "again.npz", tmp_path / "both.npz", half)
        assert f"leave out {half}, all of which is in the other map" in error


def test_a_continued_map_holds_the_session_before(halves, capsys, tmp_path: Path) -> None:
    slam = ratslam.Slam.load(halves[0])
    with open_recording(RecordingConfig(file=READINGS)) as recording:
        readings = [sample.reading for sample, _ in zip(recording, range(400), strict=False)]
    for reading in readings[390:]:
        slam.step(reading)
    slam.save(tmp_path / "longer.npz")
    error = refused(capsys, tmp_path / "both", tmp_path / "longer.npz", halves[0])
    assert f"leave out {halves[0]}, all of which is in the other map" in error


def test_a_corrected_map_is_of_the_same_session(capsys, tmp_path: Path) -> None:
    made = read_map(WHOLE).open_session().map
    log = made.solution().log
    undo_sequence(read_map(WHOLE), int(log.table()[log.accepted_rows(), 5].max()), tmp_path / "undone.npz")
    error = refused(capsys, tmp_path / "both", WHOLE, tmp_path / "undone.npz")
    assert "leave one of them out: each holds all of the other" in error


def test_common_steps_can_be_cut_out(halves, capsys, tmp_path: Path, monkeypatch) -> None:
    """The command that the error gives does so."""
    late = part(tmp_path / "late.npz", 120, 300)
    error = refused(capsys, tmp_path / "both", halves[0], late)
    command = error.split("`ratslam ")[1].removesuffix("`").split()
    rest = tmp_path / "rest.npz"
    assert main([*command[:-1], str(rest)]) == 0
    monkeypatch.setattr(merging, "join_all", lambda *_: [])
    other = late if command[2] == str(halves[0]) else halves[0]
    assert merge_maps([rest, other], tmp_path / "both.npz")["steps"]


def test_a_recording_is_mapped_once_whatever_the_settings(halves) -> None:
    one, two = (replace(read_map(half), recording="ab") for half in halves)
    with pytest.raises(ratslam.InputError, match=r"two.npz: .* the same recording .* as that of .*one.npz"):
        check_mergeable([one, two])
    check_mergeable([one, replace(two, recording="cd")])


def test_of_two_sensors_both_maps_are_named(halves) -> None:
    one, two = (read_map(half) for half in halves)
    cells = two.config.pose_cells.model_copy(update={"cell_size": 7.0})
    other = replace(two, config=two.config.model_copy(update={"pose_cells": cells}))
    size = one.config.pose_cells.cell_size
    with pytest.raises(ratslam.InputError, match=r"two.npz: made with other settings of") as caught:
        check_mergeable([one, other])
    assert f"pose_cells.cell_size is 7.0 here and {size} there" in str(caught.value)
    assert f"config.yaml --set pose_cells.cell_size={size} -o" in caught.value.cure


def test_settings_that_differ_are_told(halves, tmp_path: Path, monkeypatch) -> None:
    """With the values of each map; the merged map has those that the report says."""
    monkeypatch.setattr(merging, "join_all", lambda *_: [])
    saved = read_map(halves[1])
    keyframes = saved.config.keyframes.model_copy(update={"min_score": 77.0})
    config = saved.config.model_copy(update={"keyframes": keyframes})
    write_map(tmp_path / "two.npz", saved.open_session(), config, saved.source)
    report = merge_maps([halves[0], tmp_path / "two.npz"], tmp_path / "both.npz")
    ((name, values),) = report["settings"].items()
    assert (name, sorted(values)) == ("keyframes.min_score", [saved.config.keyframes.min_score, 77.0])
    assert read_map(tmp_path / "both.npz").config.keyframes.min_score == values[0]
    heading, line = describe_merge(report).splitlines()[-2:]
    assert report["maps"][0] in heading
    assert line == f"keyframes.min_score {values[0]} (map 2: {values[1]})"
    assert merge_maps(halves, tmp_path / "alike.npz")["settings"] == {}


def test_what_is_no_setting_of_the_method_may_differ() -> None:
    config = read_map(WHOLE).config
    session = config.session.model_copy(update={"seed": 5, "reserve": 64})
    assert differing_settings([config, config.model_copy(update={"session": session, "cells": None})]) == {}
    session = config.session.model_copy(update={"precision": "float32"})
    other = config.model_copy(update={"session": session})
    assert differing_settings([config, config, other]) == {
        "session.precision": ["float64", "float64", "float32"]
    }
