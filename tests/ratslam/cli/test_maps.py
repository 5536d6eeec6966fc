"""Saved maps by command: map and path; `localise` in maps of views, whiskers and a grid."""

import csv
import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import ratslam
from evaluation.report.run_report import read_run_report
from ratslam.cli import build_parser, main
from ratslam.cli.maps import read_place
from ratslam.core.estimates import Localisation
from ratslam.grid.localiser import GridLocaliser
from ratslam.live.goal_planner import TOLERANCE, experience_at
from ratslam.mapping.map_solution import Obstacle
from ratslam.methods.localise import LOG_ODDS
from ratslam.runs.build_session import build_session
from ratslam.runs.localise import check_assignments, localising
from ratslam.runs.saved_map import read_map
from robot.recordings.formats import open_recording
from robot.recordings.recording_config import RecordingConfig
from tactile.base.types import Odometry, observation
from tests.helpers.commands import ROOT, SQUARE, contents, refused, said
from tests.ratslam.places.test_route import TRAVEL, line_map, travel_graph
from tests.ratslam.runs.test_saved_map import FILES

FILE, MAP = FILES[0], str(FILES[-1])
READINGS = ROOT / "tests" / "golden" / "touch_circuits.mcap"


def info(capsys: pytest.CaptureFixture[str], *paths: Path, command: str = "info") -> dict:
    return json.loads(said(capsys, "map", command, *paths, "--json"))


difference = partial(info, command="diff")


def test_info_says_what_is_in_a_map_and_an_undone_sequence_is_gone(capsys, tmp_path: Path) -> None:
    before, undone, own = info(capsys, FILE), tmp_path / "undone.npz", tmp_path / "own.npz"
    assert (before["steps"], before["format"], before["backend"]) == (360, "ratslam-map-1", "recall")
    assert 300 < before["keyframes"] <= 360
    sequences = before["accepted_sequences"]
    assert before["closures"] >= len(sequences) > 0
    sequence = sequences[0]["sequence"]
    assert f"experiences {before['experiences']}; pieces 1" in said(capsys, "map", "info", FILE)
    said(capsys, "map", "undo", FILE, sequence, "-o", undone)
    after = info(capsys, undone)
    assert sequence not in {one["sequence"] for one in after["accepted_sequences"]}
    assert after["sequences_undone"] == before["sequences_undone"] + 1
    found = difference(capsys, FILE, undone)
    assert (found["common"], found["removed"], found["added"]) == (before["keyframes"], 0, 0)
    assert found["closures_removed"] > 0
    assert found["moved_max"] >= found["moved_rms"] > 0
    assert (found["settings"], found["sensor"], found["same"]) == ({}, "", False)
    assert f"moved     at most {found['moved_max']:.3g} m" in said(capsys, "map", "diff", FILE, undone)
    assert said(capsys, "map", "diff", FILE, FILE) == "the same map\n"
    shutil.copy(FILE, own)
    said(capsys, "map", "undo", own, sequence)
    assert info(capsys, own)["digest"] == after["digest"]
    assert "is not an accepted closure sequence" in refused(capsys, "map", "undo", own, sequence)


def test_the_files_of_a_run_follow_a_map_that_is_corrected_in_it(capsys, tmp_path: Path, run: Path) -> None:
    sequence = info(capsys, run)["accepted_sequences"][-1]["sequence"]
    before = contents(run)
    said(capsys, "map", "undo", run, sequence, "-o", tmp_path / "undone.npz")
    assert contents(run) == before
    said(capsys, "map", "undo", run, sequence)
    made = read_map(run).open_session().map
    assert np.array_equal(ratslam.Result(run).trajectory[:, :2], made.trajectory()[:, :2])
    rows = list(csv.DictReader((run / "closures.csv").read_text().splitlines()))
    assert {row["verdict"] for row in rows if row["sequence"] == str(sequence)} == {"undone"}
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
    assert (read_map(tmp_path / "begin.npz").steps, read_map(tmp_path / "whole.npz").steps) == (100, 360)


def test_a_sequence_that_cannot_be_undone_has_another_cure(capsys, tmp_path: Path, monkeypatch) -> None:
    sequences = info(capsys, FILE)["accepted_sequences"]
    assert all(one["can_be_undone"] for one in sequences)
    for obstacle, cure in (
        (Obstacle.NOT_ACCEPTED, "lists them"),
        (Obstacle.MERGED, "keyframes.merge_stood=0"),
        (Obstacle.ONLY_LINK, "one of the sides"),
    ):
        monkeypatch.setattr("ratslam.runs.map_care.obstacle", lambda *_, found=obstacle: found)
        assert not any(one["can_be_undone"] for one in info(capsys, FILE)["accepted_sequences"])
        error = refused(capsys, "map", "undo", FILE, sequences[0]["sequence"], "-o", tmp_path / "undone.npz")
        assert f"sequence {sequences[0]['sequence']} {obstacle}; " in error
        assert cure in error


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
    other = difference(capsys, file, FILE)
    assert (other["common"], other["settings"]["backend"]) == (0, ["classic", "recall"])
    for command, *part in (("undo", file, "0"), ("crop", file, "--piece", "0")):
        error = refused(capsys, "map", command, *part, "-o", tmp_path / "new.npz")
        assert "a map of `backend: classic`, which has no keyframes" in error


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
    assert PARSER.parse_args(["path", "map", "--to", "-.5,1"]).goal == "-.5,1"


def test_the_end_of_a_way_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nodes = read_map(Path(MAP)).open_session().map.graph().nodes(data=True)
    x, y = min((data["x"], data["y"]) for _, data in nodes)
    picture = tmp_path / "way.PNG"
    way = said(capsys, "path", MAP, "--to", f"{x:.3f},{y:.3f}", "-o", picture)
    assert f" m from {float(f'{x:.3f}'):g}," in way
    assert picture.read_bytes().startswith(b"\x89PNG")
    places = {place: np.array([data["x"], data["y"]]) for place, data in nodes}
    goal = next(
        a for a in places for b in places if a != b and np.hypot(*(places[a] - places[b])) < TOLERANCE / 2
    )
    first, *others = said(capsys, "path", MAP, "--to", goal).splitlines()
    end = first.split(" to ")[1].split(":")[0]
    assert (end != str(goal)) == any(f"ends at {end}, which is so near to {goal}" in one for one in others)


def test_a_goal_of_a_drive_is_finite() -> None:
    for point in ((np.nan, np.nan), (np.inf, 0.0)):
        with pytest.raises(ratslam.InputError, match="expected finite numbers x, y, m"):
            experience_at(travel_graph(line_map(0.0, 0.0), TRAVEL), point, 0.1, "live.plan.goal.to[0]")


MOUNTS = ", ".join(
    f"{{x: {x}, y: {y}, direction_deg: {turn}}}"
    for x, y, turn in ((0.1, 0.08, 50), (0.13, 0.03, 15), (0.13, 0, 0), (0.13, -0.03, -15), (0.1, -0.08, -50))
)
ARENA = """
create_simulation: {arena: {side: 1.25, seed: 104}, reports: REPORTS, seed: 104}
backend: grid
session: {precision: float32}
grid: {side: 2.5, particles: 50}
localise: {log_odds: 4, particles: 4000}
"""


@pytest.fixture(scope="module")
def arena(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a configuration and the run directory of its map; 600 reports are needed to be found."""
    folder, soak = tmp_path_factory.mktemp("arena"), request.config.getoption("--soak")
    (folder / "arena.yaml").write_text(ARENA.replace("REPORTS", "600" if soak else "60"))
    ratslam.run(folder / "arena.yaml", folder / "map")
    return folder


def find(map: Path, recording: str, directory: Path) -> Path:
    """The run directory of a recording localised in the map of it, which stays as it is."""
    before = (map / "map.npz").read_bytes()
    assert main(["localise", str(map), recording, "-o", str(directory)]) == 0
    assert (map / "map.npz").read_bytes() == before
    return directory


@pytest.fixture(scope="module")
def found(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return find(square, SQUARE, tmp_path_factory.mktemp("found") / "run")


def rows(directory: Path, name: str) -> list[dict[str, str]]:
    with (directory / name).open() as file:
        return list(csv.DictReader(file))


def assert_live_gives(directory: Path, map: Path, recording: str, steps: int) -> ratslam.Slam:
    slam = ratslam.Slam.load(map, mode="localise")
    with ratslam.open_source(recording) as source:
        for sample, row in zip(source, rows(directory, "steps.csv")[:steps], strict=False):
            estimate = slam.step(sample)
            assert [float(row[name]) for name in ("x", "y", "heading")] == estimate.pose.tolist()
            assert bool(int(row["lost"])) == estimate.lost
    return slam


def test_a_recording_is_found_in_its_own_map_live_to_the_same_bits(found: Path, square: Path) -> None:
    localised = rows(found, "localisation.csv")
    states = np.array([row["state"] for row in localised])
    known = states == "found"
    assert {*states} <= {"searching", "found", "lost", "not_this_map"}
    assert known.mean() > 0.5
    assert float(localised[int(known.argmax())]["mass"]) > 0.5
    where, mapped = ratslam.Result(found).trajectory, ratslam.Result(square).trajectory
    assert np.median(np.hypot(*(where - mapped)[known][:, :2].T)) < 0.1
    assert json.loads((found / "manifest.json").read_text())["status"] == "complete"
    assert (found / "map.json").read_bytes() == (square / "map.json").read_bytes()
    assert read_run_report(found).map_path is None
    assert assert_live_gives(found, square, SQUARE, 40).config.backend == "localise"


def test_a_bare_recording_is_read_as_that_of_the_map(found: Path, square: Path, tmp_path: Path) -> None:
    recording = ROOT / "tests" / "golden" / "a_square3.npz"
    arguments = ["localise", str(square / "map.npz"), str(recording), "-o", str(tmp_path / "again")]
    assert main([*arguments, "--set", f"localise.log_odds={LOG_ODDS}"]) == 0
    for name in ("localisation.csv", "steps.csv", "trajectory.tum"):
        assert (tmp_path / "again" / name).read_bytes() == (found / name).read_bytes()


@pytest.mark.soak
def test_a_session_by_touch_is_found_in_its_own_grid_live_to_the_same_bits(arena: Path) -> None:
    found = find(arena / "map", str(arena / "arena.yaml"), arena / "found")
    known = np.array([row["state"] == "found" for row in rows(found, "localisation.csv")])
    assert known[-1]
    assert not known[:30].any()
    where, mapped = ratslam.Result(found).trajectory, ratslam.Result(arena / "map").trajectory
    assert np.hypot(*(where - mapped)[known][:, :2].T).max() < 0.09
    assert {"grid.npz", "scorecard.json"} <= {path.name for path in found.iterdir()}
    slam = assert_live_gives(found, arena / "map", str(arena / "arena.yaml"), 60)
    assert isinstance(slam.map, GridLocaliser)
    assert slam.map.localisation().state == Localisation.SEARCHING


def test_a_known_start_in_a_grid_is_just_believed_and_grids_are_not_merged(
    arena, tmp_path: Path, capsys
) -> None:
    config = ratslam.load_config(arena / "arena.yaml", ["localise.start=here"])
    saved = read_map(arena / "map")
    session = build_session(localising(config, saved), saved.source)
    still = observation(Odometry(0.0, 0.0, 0.0, 0.5), view_shape=saved.source.view_shape, whiskers=4)
    estimate = session.step(still._replace(alive=np.zeros(4, bool)))
    last = ratslam.Result(arena / "map").trajectory[-1]
    assert np.hypot(*(estimate.pose - last)[:2]) < 0.1
    assert not estimate.estimate.lost
    assert isinstance(session.map, GridLocaliser)
    assert 0.2 < session.map.localisation().mass < 0.8
    assert "without experiences" in refused(capsys, "path", arena / "map", "--to", "0,0")
    error = refused(capsys, "merge", arena / "map", arena / "map", "-o", tmp_path / "both")
    assert "has no keyframes whose views could be compared" in error


@pytest.mark.parametrize(
    ("map", "config", "message"),
    [
        (FILE, "create_simulation: {}", "the sensor is fixed whiskers and was whisker head"),
        (FILE, "{simulation: {}, touch: {image: {radial: true}}}", "the shape of the views is"),
        (FILE, "{simulation: {}, touch: {image: {tallest: 0.04}}}", "touch.image.tallest is 0.04 and was"),
        (FILE, "{simulation: {}, touch: {head: {rest_deg: 70}}}", "touch.head.rest_deg is 70.0 and was"),
        ("arena", "create_simulation: {whiskers: {length: 0.12}, reports: 5}", "reports.length is 0.12 and"),
        ("arena", f"create_simulation: {{whiskers: {{mounts: [{MOUNTS}]}}, reports: 5}}", "the map was made"),
        ("arena", "{create_simulation: {reports: 5}, touch: {reports: {walls: none}}}", "walls is none"),
    ],
)  # fmt: skip
def test_another_sensor_is_refused(map, config, message, arena: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "other.yaml").write_text(config)
    file = arena / "map" if map == "arena" else map
    error = refused(capsys, "localise", file, tmp_path / "other.yaml", "-o", tmp_path / "run")
    assert [one for one in (str(file), "made with ", message) if one not in error] == []
    assert not (tmp_path / "run").exists()


def test_settings_that_follow_from_the_map_are_refused_and_those_of_the_session_are_its_own(capsys) -> None:
    saved = read_map(FILE)
    own = ["recording.limits.speed=3", "score.relations=null", "localise.log_odds=3", "touch.image.smooth=1"]
    check_assignments(own, saved)
    for setting, words in (
        ("backend=grid", "without effect: backend is as "),
        ("keyframes.min_score=9", "without effect: keyframes is as "),
        ("session.precision=float32", "without effect: session is as "),
        ("localise.map=other", "the map is "),
    ):
        message = f"--set {setting.split('=')[0]}: {words}.*{FILE}.*leave it out"
        with pytest.raises(ratslam.InputError, match=message):
            check_assignments([*own, setting], saved)
    for command in (["localise", FILE, SQUARE], ["live", "live_maze", "--localise", FILE]):
        assert "--set backend: without effect" in refused(capsys, *command, "--set", "backend=grid")
