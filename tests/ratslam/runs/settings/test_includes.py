"""Files of settings that a configuration includes."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path

import pytest

from ratslam.runs.settings.run_config import RunConfig, load_config
from ratslam.runs.settings.strict_yaml import dump, parse, validate
from tactile.base.errors import InputError, InputErrors

MAIN = """\
include: [rig.yaml, calibration.yaml]
recording: {file: a.csv}
keyframes: {calibration: {turn_error: 0.25}}
"""
RIG = """\
recording: {odometry: {turn_scale: 1.25, length_scale: 0.75}}
keyframes: {calibration: {turn_error: 0.5, heading_bias: 0.125}}
touch: {head: {dead: [1, 2]}}
"""
CALIBRATION = "keyframes: {calibration: {heading_bias: 0.375}}\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "main.yaml").write_text(MAIN)
    (tmp_path / "rig.yaml").write_text(RIG)
    (tmp_path / "calibration.yaml").write_text(CALIBRATION)
    return tmp_path


def test_included_settings_fill_those_left_open(folder: Path) -> None:
    config = load_config(folder / "main.yaml")
    assert config.recording is not None
    assert config.recording.file == folder / "a.csv"
    assert config.recording.odometry.turn_scale == 1.25
    assert config.touch.head.dead == (1, 2)
    assert config.keyframes.calibration.turn_error == 0.25  # of the file itself
    assert config.keyframes.calibration.heading_bias == 0.375  # of the later file


def test_set_comes_before_all_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    config = load_config(folder / "main.yaml", ["touch.head.dead=[3]", "include=[rig.yaml]"])
    assert config.touch.head.dead == (3,)
    assert config.keyframes.calibration.heading_bias == 0.125


@pytest.mark.parametrize(
    ("name", "assignment", "at"),
    [
        ("square", "recording.file=runs/a.npz", "recording.file"),
        ("square", "recording={file: runs/a.npz}", "recording.file"),
        ("whisker_maze", "simulation.maze.file=runs/a.npz", "simulation.maze.file"),
        ("live_maze", "live.plan.goal={map: runs/a.npz, to: [0]}", "live.plan.goal.map"),
        ("square", "score.relations=runs/a.npz", "score.relations"),
        ("square", "localise.map=runs/a.npz", "localise.map"),
    ],
)
def test_paths_of_set_start_at_the_working_folder(name, assignment, at, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert attrgetter(at)(load_config(name, [assignment])) == tmp_path / "runs" / "a.npz"
    assert load_config("square").recording.file.is_file()  # those of a file start at its folder


def test_the_loaded_configuration_stands_alone(folder: Path) -> None:
    config = load_config(folder / "main.yaml")
    assert config.include == ()
    again = validate(parse(dump(config), "again"), RunConfig)
    assert again == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("touch: {haed: {}}\n", r"rig\.yaml:1:9: touch\.haed"),
        ("touch: {head: {dead: 7}}\n", r"rig\.yaml:1:22: touch\.head\.dead"),
        ("include: [other.yaml]\n", r"rig\.yaml:1:1: include: files that an included file includes"),
        ("a: [\n", r"rig\.yaml:1:4: a bracket"),
    ],
)
def test_an_error_in_an_included_file_names_it(text: str, message: str, folder: Path) -> None:
    (folder / "rig.yaml").write_text(text)
    with pytest.raises((InputError, InputErrors), match=message):
        load_config(folder / "main.yaml")


def test_a_missing_file_is_named(folder: Path) -> None:
    (folder / "rig.yaml").unlink()
    with pytest.raises(InputError, match=r"main\.yaml:1:1: include: no file .*rig\.yaml; .*paths start at"):
        load_config(folder / "main.yaml")


def test_includes_that_are_no_list_are_refused(folder: Path) -> None:
    (folder / "main.yaml").write_text("include: rig.yaml\nrecording: {file: a.csv}\n")
    with pytest.raises(InputErrors, match=r"main\.yaml:1:10: include"):
        load_config(folder / "main.yaml")
