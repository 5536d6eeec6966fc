"""The command `localise` in maps of views, whiskers and a grid: found, live to the same bits, refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import ratslam
from evaluation.report.run_report import read_run_report
from ratslam.cli import main
from ratslam.core.estimates import Localisation
from ratslam.grid.localiser import GridLocaliser
from ratslam.methods.localise import LOG_ODDS
from ratslam.runs.build_session import build_session
from ratslam.runs.localise import check_assignments, localising
from ratslam.runs.saved_map import read_map
from tactile.base.errors import InputError
from tactile.base.types import Odometry, observation
from tests.helpers.commands import ROOT, SQUARE, refused

TOUCH = ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz"
"""A map by whiskers."""
MOUNTS = ", ".join(
    f"{{x: {x}, y: {y}, direction_deg: {turn}}}"
    for x, y, turn in ((0.1, 0.08, 50), (0.13, 0.03, 15), (0.13, 0, 0), (0.13, -0.03, -15), (0.1, -0.08, -50))
)
"""Of a robot with five whiskers."""
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
    folder = tmp_path_factory.mktemp("arena")
    reports = "600" if request.config.getoption("--soak") else "60"
    (folder / "arena.yaml").write_text(ARENA.replace("REPORTS", reports))
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
    """The first steps of a loop have the bits of a localised run."""
    slam = ratslam.Slam.load(map, mode="localise")
    with ratslam.open_source(recording) as source:
        for sample, row in zip(source, rows(directory, "steps.csv")[:steps], strict=False):
            estimate = slam.step(sample)
            assert [float(row[name]) for name in ("x", "y", "heading")] == estimate.pose.tolist()
            assert bool(int(row["lost"])) == estimate.lost
    return slam


def test_a_recording_is_found_in_its_own_map_live_to_the_same_bits(found: Path, square: Path) -> None:
    states = [row["state"] for row in rows(found, "localisation.csv")]
    assert set(states) <= {"searching", "found", "lost", "not_this_map"}
    first = states.index("found")
    assert states.count("found") > 0.5 * len(states)
    assert float(rows(found, "localisation.csv")[first]["mass"]) > 0.5
    where, mapped = ratslam.Result(found).trajectory, ratslam.Result(square).trajectory
    known = np.array(states) == "found"
    assert np.median(np.hypot(*(where - mapped)[known][:, :2].T)) < 0.1
    assert json.loads((found / "manifest.json").read_text())["status"] == "complete"
    assert (found / "map.json").read_bytes() == (square / "map.json").read_bytes()
    assert read_run_report(found).map_path is None
    assert assert_live_gives(found, square, SQUARE, 40).config.backend == "localise"


def test_a_bare_recording_is_read_as_that_of_the_map(found: Path, square: Path, tmp_path: Path) -> None:
    recording = ratslam.load_config(SQUARE).recording
    assert recording is not None
    arguments = ["localise", str(square / "map.npz"), str(recording.file), "-o", str(tmp_path / "again")]
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


def test_a_known_start_is_just_believed(arena: Path) -> None:
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


def test_a_map_of_a_grid_has_no_ways_and_is_not_merged(arena: Path, tmp_path: Path, capsys) -> None:
    assert "without experiences" in refused(capsys, "path", arena / "map", "--to", "0,0")
    error = refused(capsys, "merge", arena / "map", arena / "map", "-o", tmp_path / "both")
    assert "has no keyframes whose views could be compared" in error


@pytest.mark.parametrize(
    ("map", "config", "message"),
    [
        ("square", "simulation: {}", "the sensor is whisker head and was camera or laser"),
        (TOUCH, "create_simulation: {}", "the sensor is fixed whiskers and was whisker head"),
        (TOUCH, "{simulation: {}, touch: {image: {radial: true}}}", "the shape of the views is"),
        (TOUCH, "{simulation: {}, touch: {image: {tallest: 0.04}}}", "touch.image.tallest is 0.04 and was"),
        (TOUCH, "{simulation: {}, touch: {head: {rest_deg: 70}}}", "touch.head.rest_deg is 70.0 and was"),
        ("arena", "simulation: {}", "the sensor is whisker head and was fixed whiskers"),
        ("arena", "create_simulation: {whiskers: {length: 0.12}, reports: 5}", "reports.length is 0.12 and"),
        ("arena", f"create_simulation: {{whiskers: {{mounts: [{MOUNTS}]}}, reports: 5}}", "the map was made"),
        ("arena", "{create_simulation: {reports: 5}, touch: {reports: {walls: none}}}", "walls is none"),
    ],
)  # fmt: skip
def test_another_sensor_is_refused(map, config, message, square, arena: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "other.yaml").write_text(config)
    file = {"square": square / "map.npz", "arena": arena / "map"}.get(map, map)
    error = refused(capsys, "localise", file, tmp_path / "other.yaml", "-o", tmp_path / "run")
    assert f"{file}" in error
    assert "made with " in error
    assert message in error
    assert not (tmp_path / "run").exists()


def test_settings_that_follow_from_the_map_are_refused_and_those_of_the_session_are_its_own(capsys) -> None:
    saved = read_map(TOUCH)
    own = ["recording.limits.speed=3", "score.relations=null", "localise.log_odds=3", "touch.image.smooth=1"]
    check_assignments(own, saved)
    for key, words in (
        ("backend=grid", "without effect: backend is as "),
        ("keyframes.min_score=9", "without effect: keyframes is as "),
        ("session.precision=float32", "without effect: session is as "),
        ("localise.map=other", "the map is "),
    ):
        with pytest.raises(InputError, match=f"--set {key.split('=')[0]}: {words}.*leave it out") as caught:
            check_assignments([*own, key], saved)
        assert str(TOUCH) in str(caught.value)
    for command in (["localise", TOUCH, SQUARE], ["live", "live_maze", "--localise", TOUCH]):
        assert "--set backend: without effect" in refused(capsys, *command, "--set", "backend=grid")
