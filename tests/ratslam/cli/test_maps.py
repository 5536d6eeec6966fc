"""The commands map and path on saved maps: by whisker, of a run, and of other methods."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ratslam
from ratslam.cli import build_parser
from ratslam.cli.maps import read_place
from ratslam.live.goal_planner import TOLERANCE, experience_at
from ratslam.mapping.map_solution import Obstacle
from ratslam.runs.saved_map import read_map
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tactile.base.errors import InputError
from tests.helpers.commands import ROOT, refused, said
from tests.helpers.square_run import copy_square_run
from tests.ratslam.places.test_route import TRAVEL, line_map, travel_graph
from tests.ratslam.runs.test_map_formats import FILES

FILE = ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz"
READINGS = ROOT / "tests" / "golden" / "touch_circuits.mcap"


def info(capsys: pytest.CaptureFixture[str], path: Path) -> dict:
    return json.loads(said(capsys, "map", "info", path, "--json"))


def difference(capsys: pytest.CaptureFixture[str], *paths: Path) -> dict:
    return json.loads(said(capsys, "map", "diff", *paths, "--json"))


def test_info_says_what_is_in_a_map(capsys) -> None:
    found, text = info(capsys, FILE), said(capsys, "map", "info", FILE)
    assert (found["steps"], found["format"], found["backend"]) == (360, "ratslam-map-1", "recall")
    assert 300 < found["keyframes"] <= 360
    assert found["closures"] >= len(found["accepted_sequences"]) > 0
    for words in (found["digest"][:12], "18 whiskers", f"experiences {found['experiences']}; pieces 1",
                  f"closures    {found['closures']}, in {len(found['accepted_sequences'])} accepted",
                  "heading bias", f"doubt       {found['doubt']:.2f}"):  # fmt: skip
        assert words in text


def test_an_undone_sequence_is_gone_and_the_map_differs(capsys, tmp_path: Path) -> None:
    before, undone, own = info(capsys, FILE), tmp_path / "undone.npz", tmp_path / "own.npz"
    sequence = before["accepted_sequences"][0]["sequence"]
    said(capsys, "map", "undo", FILE, sequence, "-o", undone)
    after = info(capsys, undone)
    assert sequence not in {one["sequence"] for one in after["accepted_sequences"]}
    assert after["sequences_undone"] == before["sequences_undone"] + 1
    found = difference(capsys, FILE, undone)
    assert (found["common"], found["removed"], found["added"]) == (before["keyframes"], 0, 0)
    assert found["closures_removed"] > 0
    assert found["moved_max"] >= found["moved_rms"] > 0
    assert (found["settings"], found["sensor"], found["same"]) == ({}, "", False)
    text = said(capsys, "map", "diff", FILE, undone)
    assert f"{found['closures_removed']} only in the first" in text
    assert f"moved     at most {found['moved_max']:.3g} m" in text
    assert said(capsys, "map", "diff", FILE, FILE) == "the same map\n"
    shutil.copy(FILE, own)
    said(capsys, "map", "undo", own, sequence)
    assert info(capsys, own)["digest"] == after["digest"]
    assert "is not an accepted closure sequence" in refused(capsys, "map", "undo", own, sequence)


def test_the_files_of_a_run_follow_a_map_that_is_corrected_in_it(capsys, tmp_path: Path) -> None:
    run = copy_square_run(tmp_path / "run")
    sequence = info(capsys, run)["accepted_sequences"][-1]["sequence"]
    before = {file.name: file.read_bytes() for file in run.iterdir()}
    said(capsys, "map", "undo", run, sequence, "-o", tmp_path / "undone.npz")
    assert {file.name: file.read_bytes() for file in run.iterdir()} == before
    assert "trajectory, graph, closures and map.png follow it" in said(capsys, "map", "undo", run, sequence)
    made = read_map(run).open_session().map
    assert np.array_equal(ratslam.Result(run).trajectory[:, :2], made.trajectory()[:, :2])
    head, *rows = (line.split(",") for line in (run / "closures.csv").read_text().splitlines())
    number, verdict = head.index("sequence"), head.index("verdict")
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
    assert said(capsys, "map", "crop", FILE, "--steps", "100:", "-o", part) == f"{part}: 260 of 360 steps\n"
    found = difference(capsys, FILE, part)
    before, after = info(capsys, FILE), info(capsys, part)
    assert found["removed"] == before["keyframes"] - after["keyframes"]
    assert found["added"] <= 1, "the odometry into the first keyframe may be that of a gap"
    assert 0 < after["closures"] <= before["closures"]
    assert after["recording"] is None
    x0, y0, x1, y1 = before["box_m"]
    west = f"--box={x0 - 0.01},{y0 - 0.01},{(x0 + x1) / 2},{y1 + 0.01}"
    for name, chosen in (("west", [west]), ("begin", ["--steps", ":100"]), ("whole", ["--piece", "0"])):
        said(capsys, "map", "crop", FILE, *chosen, "-o", tmp_path / f"{name}.npz")
    assert 0 < read_map(tmp_path / "west.npz").steps < 360
    assert read_map(tmp_path / "begin.npz").steps == 100
    assert read_map(tmp_path / "whole.npz").steps == 360


def test_a_sequence_that_cannot_be_undone_has_another_cure(capsys, tmp_path: Path, monkeypatch) -> None:
    sequences = info(capsys, FILE)["accepted_sequences"]
    assert all(one["can_be_undone"] for one in sequences)
    for obstacle, cure in (
        (Obstacle.NOT_ACCEPTED, "--json` lists them"),
        (Obstacle.MERGED, "keyframes.merge_stood=0"),
        (Obstacle.ONLY_LINK, "map crop --steps"),
    ):
        monkeypatch.setattr("ratslam.runs.map_care.obstacle", lambda *_, found=obstacle: found)
        assert not any(one["can_be_undone"] for one in info(capsys, FILE)["accepted_sequences"])
        error = refused(capsys, "map", "undo", FILE, sequences[0]["sequence"], "-o", tmp_path / "undone.npz")
        assert f"sequence {sequences[0]['sequence']} {obstacle}; " in error
        assert cure in error
        assert ("lists them" in error) == (obstacle == Obstacle.NOT_ACCEPTED)


def test_maps_without_keyframes(capsys, tmp_path: Path) -> None:
    config, file = tmp_path / "config.yaml", tmp_path / "map.npz"
    method = "backend: classic\npose_cells: {cells_xy: 11, cells_heading: 12}\nattractor: {engine: dense}\n"
    config.write_text(f"recording: {{file: {READINGS}}}\n{method}")
    slam = ratslam.Slam(config)
    with open_recording(RecordingConfig(file=READINGS)) as recording:
        for sample, _ in zip(recording, range(40), strict=False):
            slam.step(sample)
    slam.save(file)
    found = info(capsys, file)
    assert (found["backend"], found["steps"], "keyframes" in found) == ("classic", 40, False)
    assert "method      classic" in said(capsys, "map", "info", file)
    other = difference(capsys, file, FILE)
    assert other["common"] == 0
    assert other["settings"]["backend"] == ["classic", "recall"]
    for command, *part in (("undo", file, "0"), ("crop", file, "--piece", "0")):
        error = refused(capsys, "map", command, *part, "-o", tmp_path / "new.npz")
        assert "a map of `backend: classic`, which has no keyframes" in error


MAP = str(FILES[-1])
PARSER = build_parser()
number = st.floats(-1e6, 1e6)


@given(number, number, st.sampled_from(["{:g}", "{:.3f}", "{:e}"]))
@settings(derandomize=True, deadline=None, max_examples=60)
def test_a_coordinate_may_be_negative(x: float, y: float, form: str) -> None:
    text = f"{form.format(x)},{form.format(y)}"
    words = ["path", "runs/maze", "--from", text, "--to", text, "--json"]
    found = PARSER.parse_args(words)
    assert (found.start, found.goal, found.json) == (text, text, True)
    assert read_place(found.goal, "--to") == pytest.approx((x, y), rel=1e-4, abs=1e-3)
    corners = f"{text},{text}"
    crop = PARSER.parse_args(["map", "crop", "runs/maze", "--box", corners, "-o", "part.npz"])
    assert crop.box == corners


def test_a_value_may_begin_with_a_point() -> None:
    assert PARSER.parse_args(["path", "map", "--to", "-.5,1"]).goal == "-.5,1"


def test_the_end_of_a_way_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nodes = read_map(Path(MAP)).open_session().map.graph().nodes(data=True)
    x, y = min((data["x"], data["y"]) for _, data in nodes)
    picture = tmp_path / "way.PNG"
    point = f"{x:.3f},{y:.3f}"
    assert f" m from {float(f'{x:.3f}'):g}," in said(capsys, "path", MAP, "--to", point, "-o", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    places = {place: np.array([data["x"], data["y"]]) for place, data in nodes}
    goal = next(
        a for a in places for b in places if a != b and np.hypot(*(places[a] - places[b])) < TOLERANCE / 2
    )
    first, *others = said(capsys, "path", MAP, "--to", goal).splitlines()
    end = first.split(" to ")[1].split(":")[0]
    assert (end != str(goal)) == any(f"ends at {end}, which is so near to {goal}" in one for one in others)


@pytest.mark.parametrize("point", [(np.nan, np.nan), (np.inf, 0.0)])
def test_a_goal_of_a_drive_is_finite(point: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="expected finite numbers x, y, m"):
        experience_at(travel_graph(line_map(0.0, 0.0), TRAVEL), point, 0.1, "live.plan.goal.to[0]")
