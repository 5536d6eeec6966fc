"""Packaged configurations: found by name by every command, listed with one line each."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from evaluation.studies.study import read_study
from ratslam.cli import main
from ratslam.runs.settings.packaged import find_config, packaged_configs
from ratslam.runs.settings.run_config import load_config
from ratslam.runs.settings.strict_yaml import load
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[4]
FILES = {path.stem: path for path in (ROOT / "configs").glob("*.yaml")}
REAL = {"building", "create_bumps", "create_lab", "intel_laser", "tuc_lecture_hall"}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", FILES)
def test_a_name_is_the_file_of_that_name(name: str) -> None:
    assert find_config(name).samefile(FILES[name])


def test_every_configuration_has_a_line_that_ends() -> None:
    lines = packaged_configs()
    assert list(lines) == sorted(FILES)
    for name, line in lines.items():
        assert re.fullmatch(r"[A-Z0-9].{20,150}\.", line), name
    assert {name for name, line in lines.items() if "Needs RATSLAM_" in line} == REAL


def test_files_that_are_named_without_a_variable_exist() -> None:
    """Else an installed wheel, which has the files of `setup.py` only, could not run them."""
    for name in FILES.keys() - REAL:
        if "base" not in load(FILES[name]).data:
            config = load_config(find_config(name))
            assert config.recording is None or config.recording.file.exists()


def test_a_file_comes_before_a_name_and_a_name_before_a_folder(elsewhere: Path) -> None:
    (elsewhere / "square").mkdir()
    assert find_config("square").samefile(FILES["square"])
    (elsewhere / "whisker_maze").write_text("seed: 1\n")
    assert find_config("whisker_maze").samefile(elsewhere / "whisker_maze")
    assert find_config("whisker_maze", ROOT).samefile(FILES["whisker_maze"])


@pytest.mark.parametrize("text", ["whiskr_maze", "whisker_maze.yaml", "configs/Whisker_Maze.yaml"])
def test_an_unknown_name_gives_a_similar_one_and_all(text: str) -> None:
    with pytest.raises(InputError) as caught:
        find_config(text)
    message = str(caught.value)
    assert message.startswith(f"{os.path.normpath(text)}: no such file or packaged configuration; ")
    assert message.endswith("did you mean 'whisker_maze'?")
    assert all(name in message for name in FILES)


def test_nothing_is_suggested_for_an_unlike_name() -> None:
    with pytest.raises(InputError) as caught:
        find_config("qqq")
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize(
    "command",
    [
        "run {}", "simulate {} -o new.mcap", "live {}", "emulate ur10 {}", "emulate head {}", "size {}",
        "study {}", "study --preset ablate {}", "study --preset growth {}", "reproduce threshold {}",
        "reproduce templates {} -o new.npz",
    ],
)  # fmt: skip
def test_every_command_takes_a_name(command: str, elsewhere: Path, capsys) -> None:
    """A wrong setting is the error of a command that found the configuration."""
    assert main(command.format("squarre").split()) == 2
    assert "no such file or packaged configuration" in capsys.readouterr().err
    assert main([*command.format("square").split(), "--set", "recording.format.x=1"]) == 2
    error = capsys.readouterr().err
    assert "square" in error or "recording.format" in error
    assert "no such file" not in error
    assert list(elsewhere.iterdir()) == []


@pytest.mark.parametrize("command", ["run", "study", "live"])
def test_the_list_has_a_line_for_each(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([command, "--list"])
    assert left.value.code == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines == packaged_configs()


def test_the_base_of_a_study_may_be_a_name(elsewhere: Path) -> None:
    (elsewhere / "study.yaml").write_text("base: square\n")
    (job,) = read_study("study.yaml").jobs
    assert job.config.recording is not None
    assert job.config.recording.file.samefile(ROOT / "tests" / "golden" / "a_square3.npz")
