"""The commands `localise` and `live --localise`: a recording found in a saved map, and refusals."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import ratslam
from evaluation.report.run_report import read_run_report
from ratslam.cli import main
from ratslam.methods.localise import LOG_ODDS
from ratslam.runs.localise import check_assignments
from ratslam.runs.saved_map import read_map
from tests.ratslam.runs.test_saved_map import rewritten

ROOT = Path(__file__).parents[3]
SQUARE = ROOT / "configs" / "square.yaml"
TOUCH = ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz"
"""A map by whiskers."""


@pytest.fixture(scope="module")
def found(square: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run directory of the map's own recording, localised in the map."""
    before = (square / "map.npz").read_bytes()
    directory = tmp_path_factory.mktemp("found") / "run"
    assert main(["localise", str(square), str(SQUARE), "-o", str(directory)]) == 0
    assert (square / "map.npz").read_bytes() == before
    return directory


def rows(directory: Path) -> list[dict[str, str]]:
    with (directory / "localisation.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_recording_is_found_in_its_own_map(found: Path, square: Path) -> None:
    states = [row["state"] for row in rows(found)]
    assert set(states) <= {"searching", "found", "lost", "not_this_map"}
    first = states.index("found")
    assert states.count("found") > 0.5 * len(states)
    assert float(rows(found)[first]["mass"]) > 0.5
    where, mapped = ratslam.Result(found).trajectory, ratslam.Result(square).trajectory
    known = np.array(states) == "found"
    assert np.median(np.hypot(*(where - mapped)[known][:, :2].T)) < 0.1
    assert json.loads((found / "manifest.json").read_text())["status"] == "complete"
    assert (found / "map.json").read_bytes() == (square / "map.json").read_bytes()
    assert read_run_report(found).map_path is None


def test_a_loop_localises_to_the_same_bits(found: Path, square: Path) -> None:
    slam = ratslam.Slam.load(square, mode="localise")
    assert slam.config.backend == "localise"
    with (found / "steps.csv").open() as file:
        expected = list(csv.DictReader(file))[:40]
    with ratslam.open_source(SQUARE) as source:
        for sample, row in zip(source, expected, strict=False):
            estimate = slam.step(sample)
            assert [float(row[name]) for name in ("x", "y", "heading")] == estimate.pose.tolist()
            assert bool(int(row["lost"])) == estimate.lost


def test_a_bare_recording_is_read_as_that_of_the_map(found: Path, square: Path, tmp_path: Path) -> None:
    recording = ratslam.load_config(SQUARE).recording
    assert recording is not None
    arguments = ["localise", str(square / "map.npz"), str(recording.file), "-o", str(tmp_path / "again")]
    assert main([*arguments, "--set", f"localise.log_odds={LOG_ODDS}"]) == 0
    for name in ("localisation.csv", "steps.csv", "trajectory.tum"):
        assert (tmp_path / "again" / name).read_bytes() == (found / name).read_bytes()


def refused(capsys: pytest.CaptureFixture[str], directory: Path, *arguments: str) -> str:
    """The one error of a command that is refused and makes no run directory."""
    assert main([*arguments, "-o", str(directory)]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "error:" in line]
    assert len(errors) == 1
    assert not directory.exists()
    return errors[0]


@pytest.mark.parametrize(
    ("map", "config", "message"),
    [
        (
            "square",
            "simulation: {}",
            "the sensor is whisker head and was camera or laser when the map was made",
        ),
        (TOUCH, "create_simulation: {}", "the sensor is fixed whiskers and was whisker head"),
        (TOUCH, "{simulation: {}, touch: {image: {radial: true}}}", "the shape of the views is"),
        (
            TOUCH,
            "{simulation: {}, touch: {image: {tallest: 0.04}}}",
            "touch.image.tallest is 0.04 and was 0.05 when the map was made",
        ),
        (
            TOUCH,
            "{simulation: {}, touch: {head: {rest_deg: 70}}}",
            "touch.head.rest_deg is 70.0 and was 75.0",
        ),
    ],
    ids=["sensor", "whiskers", "shape", "transform", "geometry"],
)
def test_another_sensor_is_refused(
    square: Path, tmp_path: Path, capsys, map: Path | str, config: str, message: str
) -> None:
    (tmp_path / "other.yaml").write_text(config)
    file = square / "map.npz" if map == "square" else map
    error = refused(capsys, tmp_path / "run", "localise", str(file), str(tmp_path / "other.yaml"))
    assert f"{file}: made with " in error
    assert message in error


@pytest.mark.parametrize(
    ("backend", "reason"),
    [
        ("classic", "not how likely it is of another place"),
        ("localise", "a session in another map"),
        ("localise_grid", "a session in another map"),
    ],
)
def test_maps_of_methods_that_cannot_localise_are_refused(
    square: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], backend: str, reason: str
) -> None:
    text = (square / "config.yaml").read_text().replace("backend: recall", f"backend: {backend}")
    file = rewritten(square / "map.npz", tmp_path / "map.npz", config=text)
    error = refused(capsys, tmp_path / "run", "localise", str(file), str(SQUARE))
    assert f"a map made by `backend: {backend}`, w" in error or f"`backend: {backend}`, in w" in error
    assert reason in error
    assert "expected a map made by `backend: recall`" in error


def test_a_run_directory_without_a_map_is_refused(square: Path, tmp_path: Path, capsys) -> None:
    shutil.copy(square / "config.yaml", tmp_path)
    for command in (
        ["localise", str(tmp_path), str(SQUARE)],
        ["live", "live_maze", "--localise", str(tmp_path)],
    ):
        assert "map.npz: no such file; expected a map" in refused(capsys, tmp_path / "run", *command)


def test_a_configuration_without_a_map_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    error = refused(capsys, tmp_path / "run", "run", str(SQUARE), "--set", "backend=localise")
    assert "localise.map: missing; expected the file of a map" in error


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("backend=grid", "--set backend: without effect: backend is as "),
        ("keyframes.min_score=9", "--set keyframes.min_score: without effect: keyframes is as "),
        ("session.precision=float32", "--set session.precision: without effect: session is as "),
        ("localise.map=other", "--set localise.map: the map is "),
    ],
)
def test_settings_that_follow_from_the_map_are_refused(
    setting: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in (["localise", str(TOUCH), str(SQUARE)], ["live", "live_maze", "--localise", str(TOUCH)]):
        error = refused(capsys, tmp_path / "run", *command, "--set", setting)
        assert words in error
        assert str(TOUCH) in error
        assert "leave it out" in error


def test_settings_of_the_session_are_its_own() -> None:
    own = ["recording.limits.speed=3", "score.relations=null", "localise.log_odds=3", "touch.image.smooth=1"]
    check_assignments(own, read_map(TOUCH))
