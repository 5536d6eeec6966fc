"""The command `localise` in a map of `backend: grid`: found, live to the same bits, refused."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import ratslam
from ratslam.cli import main
from ratslam.core.estimates import Localisation
from ratslam.grid.localiser import GridLocaliser
from ratslam.runs.build_session import build_session
from ratslam.runs.localise import localising
from ratslam.runs.saved_map import read_map
from tactile.base.types import Odometry, observation
from tests.ratslam.cli.test_localise import refused

REPORTS = 600
MOUNTS = ", ".join(
    f"{{x: {x}, y: {y}, direction_deg: {turn}}}"
    for x, y, turn in ((0.1, 0.08, 50), (0.13, 0.03, 15), (0.13, 0, 0), (0.13, -0.03, -15), (0.1, -0.08, -50))
)
"""Of a robot with five whiskers."""
SETTINGS = f"""
create_simulation: {{arena: {{side: 1.25, seed: 104}}, reports: {REPORTS}, seed: 104}}
backend: grid
session: {{precision: float32}}
grid: {{side: 2.5, particles: 50}}
localise: {{log_odds: 4, particles: 4000}}
"""


def test_a_way_needs_experiences(arena: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["path", str(arena / "map"), "--to", "0,0"]) == 2
    assert "a map of `backend: grid` without experiences" in capsys.readouterr().err


@pytest.fixture(scope="module")
def arena(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a configuration and the run directory of its map."""
    folder = tmp_path_factory.mktemp("arena")
    (folder / "arena.yaml").write_text(SETTINGS)
    ratslam.run(folder / "arena.yaml", folder / "map")
    return folder


@pytest.fixture(scope="module")
def found(arena: Path) -> Path:
    """The run directory of the map's own session, localised in the map, which stays as it is."""
    before = (arena / "map" / "map.npz").read_bytes()
    arguments = ["localise", str(arena / "map"), str(arena / "arena.yaml"), "-o", str(arena / "found")]
    assert main(arguments) == 0
    assert (arena / "map" / "map.npz").read_bytes() == before
    return arena / "found"


@pytest.mark.soak
def test_a_session_is_found_in_its_own_map(arena: Path, found: Path) -> None:
    with (found / "localisation.csv").open() as file:
        known = np.array([row["state"] == "found" for row in csv.DictReader(file)])
    assert known[-1]
    assert not known[:30].any()
    where, mapped = ratslam.Result(found).trajectory, ratslam.Result(arena / "map").trajectory
    assert np.hypot(*(where - mapped)[known][:, :2].T).max() < 0.09
    assert (found / "grid.npz").is_file()
    assert (found / "scorecard.json").is_file()


@pytest.mark.soak
def test_a_loop_localises_to_the_same_bits(arena: Path, found: Path) -> None:
    slam = ratslam.Slam.load(arena / "map", mode="localise")
    with (found / "steps.csv").open() as file:
        expected = list(csv.DictReader(file))[:60]
    with ratslam.open_source(arena / "arena.yaml") as source:
        for sample, row in zip(source, expected, strict=False):
            estimate = slam.step(sample)
            assert [float(row[name]) for name in ("x", "y", "heading")] == estimate.pose.tolist()
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


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("simulation: {}", "the sensor is whisker head and was fixed whiskers"),
        (
            "create_simulation: {whiskers: {length: 0.12}, reports: 5}",
            "touch.reports.length is 0.12 and was 0.14",
        ),
        (f"create_simulation: {{whiskers: {{mounts: [{MOUNTS}]}}, reports: 5}}", "when the map was made"),
        ("{create_simulation: {reports: 5}, touch: {reports: {walls: none}}}", "touch.reports.walls is none"),
    ],
    ids=["sensor", "size", "whiskers", "walls"],
)
def test_another_sensor_is_refused(arena: Path, tmp_path: Path, capsys, config: str, message: str) -> None:
    (tmp_path / "other.yaml").write_text(config)
    command = ["localise", str(arena / "map"), str(tmp_path / "other.yaml")]
    error = refused(capsys, tmp_path / "run", *command)
    assert "made with " in error
    assert message in error


def test_maps_of_the_grid_filter_are_not_merged(arena: Path, tmp_path: Path, capsys) -> None:
    map = str(arena / "map")
    assert main(["merge", map, map, "-o", str(tmp_path / "both")]) == 2
    assert "has no keyframes whose views could be compared" in capsys.readouterr().err
