"""Configurations in files: packaged ones, what they include, settings that have moved, those that differ."""

from __future__ import annotations

import re
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.studies.study import read_study
from ratslam.cli import main
from ratslam.runs.map_settings import differing_settings, flat_settings
from ratslam.runs.settings.packaged import find_config, packaged_configs, read_citation
from ratslam.runs.settings.run_config import RunConfig, changed_settings, load_config
from ratslam.runs.settings.strict_yaml import MOVED, dump, load, parse, validate
from tactile.base.errors import InputError, InputErrors

ROOT = Path(__file__).parents[4]
FILES = {path.stem: path for path in (ROOT / "configs").glob("*.yaml")}
REAL = {"building", "create_bumps", "create_lab", "intel_laser", "tuc_lecture_hall"}
INCLUDING = {
    "main.yaml": """\
include: [rig.yaml, calibration.yaml]
recording: {file: a.csv}
keyframes: {calibration: {turn_error: 0.25}}
""",
    "rig.yaml": """\
recording: {odometry: {turn_scale: 1.25, length_scale: 0.75}}
keyframes: {calibration: {turn_error: 0.5, heading_bias: 0.125}}
touch: {head: {dead: [1, 2]}}
""",
    "calibration.yaml": "keyframes: {calibration: {heading_bias: 0.375}}\n",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in INCLUDING.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "there").mkdir()
    monkeypatch.chdir(tmp_path / "there")
    return tmp_path


def test_included_settings_fill_those_left_open(folder: Path) -> None:
    config = load_config(folder / "main.yaml")
    assert config.recording is not None
    assert config.recording.file == folder / "a.csv"
    assert config.recording.odometry.turn_scale == 1.25
    assert config.touch.head.dead == (1, 2)
    assert config.keyframes.calibration.turn_error == 0.25  # of the file itself
    assert config.keyframes.calibration.heading_bias == 0.375  # of the later file
    assert config.include == ()
    assert validate(parse(dump(config), "again"), RunConfig) == config


def test_set_comes_before_all_files(folder: Path) -> None:
    config = load_config(folder / "main.yaml", ["touch.head.dead=[3]", "include=[../rig.yaml]"])
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


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("rig.yaml", "touch: {haed: {}}\n", r"rig\.yaml:1:9: touch\.haed"),
        ("rig.yaml", "touch: {head: {dead: 7}}\n", r"rig\.yaml:1:22: touch\.head\.dead"),
        ("rig.yaml", "include: [other.yaml]\n", r"rig\.yaml:1:1: include: files that an included file"),
        ("rig.yaml", "a: [\n", r"rig\.yaml:1:4: a bracket"),
        ("main.yaml", "include: [none.yaml]\n", r"main\.yaml:1:1: include: no file .*none\.yaml"),
        ("main.yaml", "include: rig.yaml\nrecording: {file: a.csv}\n", r"main\.yaml:1:10: include"),
    ],
)
def test_an_error_in_an_included_file_names_it(name: str, text: str, message: str, folder: Path) -> None:
    (folder / name).write_text(text)
    with pytest.raises((InputError, InputErrors), match=message):
        load_config(folder / "main.yaml")


@pytest.mark.parametrize("old", MOVED)
def test_every_new_key_exists_and_no_old_one(old: str) -> None:
    section, key = old.split(".")
    assert key not in type(RunConfig.model_fields[section].default).model_fields
    new = MOVED[old]
    if new is not None:
        section, key = new.split(".")
        assert key in type(RunConfig.model_fields[section].default).model_fields


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """The configuration that an earlier version wrote, when the settings of `MOVED` had their old names."""
    path = tmp_path / "config.yaml"
    with np.load(ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz") as arrays:
        path.write_text(str(arrays["config"]))
    return path


def test_a_configuration_that_the_program_wrote_is_read_with_moved_settings(written: Path) -> None:
    old = parse(written.read_text(), "c.yaml").data["pose_cells"]
    config = load_config(written, source_required=False)
    assert {**dict(config.pose_cells), **dict(config.attractor)} == old
    assert old["engine"] == "dense"
    moved = {old for old, new in MOVED.items() if new is not None}
    assert {f"pose_cells.{name}" for name in config.attractor.model_fields_set} == moved
    assert "attractor.engine" in [name for name, _, _ in changed_settings(written)]
    options = ["attractor.engine=window", "attractor.settle_steps=7"]
    network = load_config(written, options, source_required=False).attractor
    assert (network.engine, network.settle_steps, network.excite_sigma) == ("window", 7, 1.0)
    written.write_text(written.read_text().replace("excite_width: 7", "excite_width: 6"))
    line = 1 + written.read_text().splitlines().index("  excite_width: 6")
    with pytest.raises(InputError, match=rf"config.yaml:{line}:17: attractor.excite_width: 6"):
        load_config(written, source_required=False)


def test_a_users_old_settings_move_but_for_those_without_a_counterpart(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("pose_cells: {engine: dense, excite_sigma: 1.5}\n")
    network = load_config(path, source_required=False).attractor
    assert (network.engine, network.excite_sigma) == ("dense", 1.5)
    path.write_text("recall: {reach: 1.0}\n")
    with pytest.raises(InputError, match=r"mine.yaml:1:10: recall.reach: unknown key"):
        load_config(path, source_required=False)


def test_settings_other_than_the_defaults_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(
        "{backend: classic, simulation: {seed: 3, path: {explore: 40}, maze: {heights: [0.03, 0.05]}},"
        " create_simulation: null, recall: {guard: 20}, session: {reserve: 0, seed: 2}}"
    )
    assert [tuple(setting) for setting in changed_settings(path)] == [
        ("simulation.maze.heights", "[0.03, 0.05]", "[0.05]"),
        ("simulation.path.circuits", '""', '"CCCAAACACA"'),
        ("simulation.path.explore", "40.0", "0.0"),
        ("simulation.seed", "3", "0"),
        ("backend", '"classic"', '"recall"'),
        ("session.seed", "2", "0"),
    ]
    path.write_text("recording: {file: '/private/<b>.npz'}\n")
    # Without a default; and pages are shared, folders are private.
    assert changed_settings(path) == [("recording.file", '"<b>.npz"', "")]
    path.write_text("nonsense: 1\n")
    with pytest.raises(InputError, match="nonsense"):
        changed_settings(path)


NAMES = st.text("abc_", min_size=1, max_size=3)
SECTIONS = st.recursive(st.integers() | st.just({}), lambda inner: st.dictionaries(NAMES, inner, max_size=3))


@given(st.dictionaries(NAMES, SECTIONS, max_size=3))
def test_every_value_is_found_by_its_dotted_name_and_none_is_left_out(settings):
    nested: dict = {}
    for name, value in flat_settings(settings).items():
        assert value == {} or not isinstance(value, dict)
        *above, last = name.split(".")
        at = nested
        for part in above:
            at = at.setdefault(part, {})
        at[last] = value
    assert nested == settings


def test_a_map_goes_on_whether_or_not_its_keyframes_were_merged() -> None:
    """Maps of views say 0 where an earlier version wrote them."""
    now, before = (load_config("square", [f"keyframes.merge_stood={stood}"]) for stood in (4, 0))
    assert differing_settings([before, now]) == {}
    other = load_config("square", ["keyframes.min_length=3"])
    assert differing_settings([before, other]) == {"keyframes.min_length": [2, 3]}


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_configuration_is_found_by_its_name_and_has_a_line_that_ends(elsewhere: Path) -> None:
    lines = packaged_configs()
    assert list(lines) == sorted(FILES)
    for name, line in lines.items():
        assert find_config(name).samefile(FILES[name])
        assert re.fullmatch(r"[A-Z0-9].{20,150}\.", line), name
    assert {name for name, line in lines.items() if "Needs RATSLAM_" in line} == REAL
    assert read_citation().startswith("cff-version: ")


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


@pytest.mark.parametrize(
    ("text", "similar"),
    [("whiskr_maze", True), ("whisker_maze.yaml", True), ("configs/Whisker_Maze.yaml", True), ("qqq", False)],
)
def test_an_unknown_name_gives_a_similar_one_and_all(text: str, similar: bool, elsewhere: Path) -> None:
    with pytest.raises(InputError, match=f"^{text}: no such file or packaged configuration") as caught:
        find_config(text)
    message = str(caught.value)
    assert message.endswith("did you mean 'whisker_maze'?") == similar == ("did you mean" in message)
    assert all(name in message for name in FILES)


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
    with pytest.raises(SystemExit, match=r"^0$"):
        main([command, "--list"])
    assert dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()) == packaged_configs()


def test_the_base_of_a_study_may_be_a_name(elsewhere: Path) -> None:
    (elsewhere / "study.yaml").write_text("base: square\n")
    (job,) = read_study("study.yaml").jobs
    assert job.config.recording is not None
    assert job.config.recording.file.samefile(ROOT / "tests" / "golden" / "a_square3.npz")
