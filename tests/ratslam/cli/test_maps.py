"""The command map on a run by whisker, on runs of other methods, and its refusals."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import ratslam
from ratslam.cli import main
from ratslam.mapping.map_solution import MapSolution, Obstacle
from ratslam.runs.saved_map import read_map
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tests.helpers.square_run import copy_square_run

MAPS = Path(__file__).parents[2] / "data" / "maps"
FILE = MAPS / "ratslam-map-1.npz"
READINGS = Path(__file__).parents[2] / "golden" / "touch_circuits.mcap"


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["map", *map(str, arguments)]) == 0
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main(["map", *map(str, arguments)]) == 2
    errors = capsys.readouterr().err
    assert errors.count("ratslam: error:") == errors.count("\n") == 1
    return errors


def info(capsys: pytest.CaptureFixture[str], path: Path) -> dict:
    return json.loads(said(capsys, "info", path, "--json"))


def difference(capsys: pytest.CaptureFixture[str], *paths: Path) -> dict:
    return json.loads(said(capsys, "diff", *paths, "--json"))


def test_info_says_what_is_in_a_map(capsys) -> None:
    found, text = info(capsys, FILE), said(capsys, "info", FILE)
    assert found["steps"] == 360
    assert found["format"] == "ratslam-map-1"
    assert 300 < found["keyframes"] <= 360
    assert found["closures"] >= len(found["accepted_sequences"]) > 0
    for words in (
        f"ratslam-map-1, sha256 {found['digest'][:12]}", "whisker head, 18 whiskers; views of 3 x 6 x 1",
        f"steps       360; experiences {found['experiences']}; pieces 1", "heading bias", "doubt       0.",
    ):  # fmt: skip
        assert words in text


def test_an_undone_sequence_is_gone_and_the_map_differs(capsys, tmp_path: Path) -> None:
    before = info(capsys, FILE)
    sequence = before["accepted_sequences"][0]["sequence"]
    said(capsys, "undo", FILE, sequence, "-o", tmp_path / "undone.npz")
    after = info(capsys, tmp_path / "undone.npz")
    assert sequence not in {one["sequence"] for one in after["accepted_sequences"]}
    assert after["sequences_undone"] == before["sequences_undone"] + 1
    found = difference(capsys, FILE, tmp_path / "undone.npz")
    assert (found["common"], found["removed"], found["added"]) == (before["keyframes"], 0, 0)
    assert found["closures_removed"] > 0
    assert found["moved_max"] >= found["moved_rms"] > 0
    assert (found["settings"], found["sensor"], found["same"]) == ({}, "", False)
    text = said(capsys, "diff", FILE, tmp_path / "undone.npz")
    assert f"{found['closures_removed']} only in the first" in text
    assert said(capsys, "diff", FILE, FILE) == "the same map\n"
    shutil.copy(FILE, tmp_path / "own.npz")
    said(capsys, "undo", tmp_path / "own.npz", sequence)
    assert info(capsys, tmp_path / "own.npz")["digest"] == after["digest"]
    assert "is not an accepted closure sequence" in refused(capsys, "undo", tmp_path / "own.npz", sequence)


def test_the_files_of_a_run_follow_a_map_that_is_corrected_in_it(capsys, tmp_path: Path) -> None:
    run = copy_square_run(tmp_path / "run")
    capsys.readouterr()
    sequence = info(capsys, run)["accepted_sequences"][-1]["sequence"]
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    said(capsys, "undo", run, sequence, "-o", tmp_path / "undone.npz")
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before
    text = said(capsys, "undo", run, sequence)
    assert f"{run}: trajectory, graph, closures and map.png follow it" in text
    made = read_map(run).open_session().map
    assert np.array_equal(ratslam.Result(run).trajectory[:, :2], made.trajectory()[:, :2])
    lines = (run / "closures.csv").read_text().splitlines()
    head = lines[0].split(",")
    number, verdict = head.index("sequence"), head.index("verdict")
    rows = [line.split(",") for line in lines[1:]]
    assert {row[verdict] for row in rows if row[number] == str(sequence)} == {"undone"}
    assert info(capsys, run)["closures"] == 0
    assert (run / "trajectory.tum").read_bytes() == (run / "odometry.tum").read_bytes()
    assert not (run / "calibration.yaml").exists()
    before.pop("calibration.yaml")
    changed = {name for name, content in before.items() if (run / name).read_bytes() != content}
    assert {"map.npz", "closures.csv", "map.tum", "map.g2o", "scorecard.json", "map.png"} <= changed
    assert not changed & {"steps.csv", "online.tum", "odometry.tum", "truth.tum", "config.yaml"}


def test_a_cropped_map_is_a_map(capsys, tmp_path: Path) -> None:
    part = tmp_path / "part.npz"
    assert said(capsys, "crop", FILE, "--steps", "100:", "-o", part) == f"{part}: 260 of 360 steps\n"
    found = difference(capsys, FILE, part)
    before, after = info(capsys, FILE), info(capsys, part)
    assert found["removed"] == before["keyframes"] - after["keyframes"]
    assert found["added"] <= 1, "the odometry into the first keyframe may be that of a gap"
    assert 0 < after["closures"] <= before["closures"]
    assert after["recording"] is None
    slam = ratslam.Slam.load(part)
    with open_recording(RecordingConfig(file=READINGS)) as recording:
        readings = [sample.reading for sample in recording]
    for reading in readings[360:460]:
        slam.step(reading)
    assert slam.steps == 360
    assert len(slam.map.closures()) > after["closures"], "the newer steps are recognised in the part"
    assert np.isfinite(slam.trajectory()).all()


def test_boxes_and_pieces(capsys, tmp_path: Path) -> None:
    x0, y0, x1, y1 = info(capsys, FILE)["box_m"]
    box = f"--box={x0 - 0.01},{y0 - 0.01},{(x0 + x1) / 2},{y1 + 0.01}"
    said(capsys, "crop", FILE, box, "-o", tmp_path / "west.npz")
    assert 0 < read_map(tmp_path / "west.npz").steps < 360
    said(capsys, "crop", FILE, "--piece", 0, "-o", tmp_path / "whole.npz")
    assert read_map(tmp_path / "whole.npz").steps == 360


def test_what_cannot_be_cropped_is_refused(capsys, tmp_path: Path) -> None:
    part = tmp_path / "part.npz"
    assert "no keyframe remains" in refused(capsys, "crop", FILE, "--steps", "9000:", "-o", part)
    assert "no keyframe remains" in refused(capsys, "crop", FILE, "--piece", "7", "-o", part)
    assert "A:B" in refused(capsys, "crop", FILE, "--steps", "1,2", "-o", part)
    assert "four numbers" in refused(capsys, "crop", FILE, "--box", "1,2,3", "-o", part)
    assert "X0 < X1" in refused(capsys, "crop", FILE, "--box", "1,0,0,1", "-o", part)
    assert "no such file" in refused(capsys, "info", tmp_path)
    assert not part.exists()


@pytest.mark.parametrize(
    ("obstacle", "cure"),
    [
        (Obstacle.NOT_ACCEPTED, "--json` lists them"),
        (Obstacle.MERGED, "keyframes.merge_stood=0"),
        (Obstacle.ONLY_LINK, "map crop --steps"),
    ],
)
def test_a_sequence_that_cannot_be_undone_has_another_cure(
    obstacle: Obstacle, cure: str, capsys, tmp_path: Path, monkeypatch
) -> None:
    sequences = info(capsys, FILE)["accepted_sequences"]
    assert all(one["can_be_undone"] for one in sequences)
    monkeypatch.setattr(MapSolution, "obstacle", lambda *_: obstacle)
    assert not any(one["can_be_undone"] for one in info(capsys, FILE)["accepted_sequences"])
    said = refused(capsys, "undo", FILE, sequences[0]["sequence"], "-o", tmp_path / "undone.npz")
    assert f"sequence {sequences[0]['sequence']} {obstacle}; " in said
    assert cure in said
    assert ("lists them" in said) == (obstacle == Obstacle.NOT_ACCEPTED)


@pytest.mark.parametrize("backend", ["classic", pytest.param("grid", marks=pytest.mark.soak)])
def test_maps_without_keyframes(backend: str, capsys, tmp_path: Path) -> None:
    config = tmp_path / "config.yaml"
    settings = (
        "pose_cells: {cells_xy: 11, cells_heading: 12}\nattractor: {engine: dense}\ngrid: {particles: 20}\n"
    )
    config.write_text(f"recording: {{file: {READINGS}}}\nbackend: {backend}\n{settings}")
    slam = ratslam.Slam(config)
    with open_recording(RecordingConfig(file=READINGS)) as recording:
        for sample, _ in zip(recording, range(40), strict=False):
            slam.step(sample)
    slam.save(tmp_path / "map.npz")
    found = info(capsys, tmp_path / "map.npz")
    assert (found["backend"], found["steps"], "keyframes" in found) == (backend, 40, False)
    assert f"method      {backend}" in said(capsys, "info", tmp_path / "map.npz")
    other = difference(capsys, tmp_path / "map.npz", FILE)
    assert other["common"] == 0
    assert other["settings"]["backend"] == [backend, "recall"]
    for command in (("undo", "0"), ("crop", "--piece", "0")):
        error = refused(capsys, command[0], tmp_path / "map.npz", *command[1:], "-o", tmp_path / "new.npz")
        assert f"a map of `backend: {backend}`, which has no keyframes" in error
