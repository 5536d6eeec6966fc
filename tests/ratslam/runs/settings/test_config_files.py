"""Configurations in files: what they include, settings that have moved or differ, names, completion."""

import re
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from evaluation.studies.study import read_study
from ratslam.cli import main
from ratslam.runs.build_session import open_source
from ratslam.runs.map_settings import differing_settings, flat_settings
from ratslam.runs.settings.completion import EXTENT_FACTOR, EXTENT_MARGIN, complete
from ratslam.runs.settings.openratslam import convert_parameters
from ratslam.runs.settings.packaged import PRESETS, find_config, packaged_configs, read_citation
from ratslam.runs.settings.run_config import RunConfig, changed_settings, load_config
from ratslam.runs.settings.strict_yaml import MOVED, dump, load, parse, validate
from robot.sources.source import SOURCES, SourceDescription, SourceInfo
from robot.touch_source import TOUCH
from tactile.base.errors import InputError, InputErrors
from tests.helpers import tactile_arrays
from tests.helpers.commands import ROOT, refused

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
    assert (config.recording.file, config.recording.odometry.turn_scale) == (folder / "a.csv", 1.25)
    assert config.touch.head.dead == (1, 2)
    assert config.keyframes.calibration.turn_error == 0.25  # of the file itself
    assert config.keyframes.calibration.heading_bias == 0.375  # of the later file
    assert (config.include, validate(parse(dump(config), "again"), RunConfig)) == ((), config)
    config = load_config(folder / "main.yaml", ["touch.head.dead=[3]", "include=[../rig.yaml]"])
    assert (config.touch.head.dead, config.keyframes.calibration.heading_bias) == ((3,), 0.125)


@pytest.mark.parametrize(("name", "assignment", "at"), [
    ("square", "recording.file=runs/a.npz", "recording.file"),
    ("square", "recording={file: runs/a.npz}", "recording.file"),
    ("whisker_maze", "simulation.maze.file=runs/a.npz", "simulation.maze.file"),
    ("live_maze", "live.plan.goal={map: runs/a.npz, to: [0]}", "live.plan.goal.map"),
    ("square", "score.relations=runs/a.npz", "score.relations"),
    ("square", "localise.map=runs/a.npz", "localise.map"),
])  # fmt: skip
def test_paths_of_set_start_at_the_working_folder(name, assignment, at, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert attrgetter(at)(load_config(name, [assignment])) == tmp_path / "runs" / "a.npz"
    assert load_config("square").recording.file.is_file()  # those of a file start at its folder


@pytest.mark.parametrize(("name", "text", "message"), [
    ("rig.yaml", "touch: {haed: {}}\n", r"rig\.yaml:1:9: touch\.haed"),
    ("rig.yaml", "touch: {head: {dead: 7}}\n", r"rig\.yaml:1:22: touch\.head\.dead"),
    ("rig.yaml", "include: [other.yaml]\n", r"rig\.yaml:1:1: include: files that an included file"),
    ("rig.yaml", "a: [\n", r"rig\.yaml:1:4: a bracket"),
    ("main.yaml", "include: [none.yaml]\n", r"main\.yaml:1:1: include: no file .*none\.yaml"),
    ("main.yaml", "include: rig.yaml\nrecording: {file: a.csv}\n", r"main\.yaml:1:10: include"),
    ("rig.yaml", "presets: [tuch]\n", r"rig\.yaml:1:11: presets\.0: 'tuch'.*did you mean 'touch'"),
])  # fmt: skip
def test_an_error_in_an_included_file_names_it(name: str, text: str, message: str, folder: Path) -> None:
    (folder / name).write_text(text)
    with pytest.raises((InputError, InputErrors), match=message):
        load_config(folder / "main.yaml")


def test_every_new_key_exists_and_no_old_one() -> None:
    for name, expected in (dict.fromkeys(MOVED, False) | dict.fromkeys(MOVED.values(), True)).items():
        if name is not None:
            section, key = name.split(".")
            assert (key in type(RunConfig.model_fields[section].default).model_fields) == expected


def test_settings_that_have_moved_are_read_but_for_those_without_a_counterpart(tmp_path: Path) -> None:
    written = tmp_path / "config.yaml"
    with np.load(ROOT / "tests" / "data" / "maps" / "ratslam-map-1.npz") as arrays:
        written.write_text(str(arrays["config"]))
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
    (path := tmp_path / "mine.yaml").write_text("pose_cells: {engine: dense, excite_sigma: 1.5}\n")
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
    assert changed_settings(path) == [("recording.file", '"<b>.npz"', "null")]
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


def test_settings_that_change_the_map_are_told_and_others_may_differ() -> None:
    """Maps of views say 0 where an earlier version wrote merges."""
    now, before = (load_config("square", [f"keyframes.merge_stood={stood}"]) for stood in (4, 0))
    assert differing_settings([before, now]) == {}
    other = load_config("square", ["keyframes.min_length=3"])
    assert differing_settings([before, other]) == {"keyframes.min_length": [2, 3]}
    free = load_config("square", ["session={seed: 5, reserve: 64}", "cells={}"])
    assert differing_settings([now, free]) == {}
    single = load_config("square", ["session.precision=float32"])
    found = differing_settings([now, now, single])
    assert found == {"session.precision": ["float64", "float64", "float32"]}


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_configuration_is_found_by_its_name_after_files_and_before_folders(elsewhere: Path) -> None:
    lines = packaged_configs()
    assert list(lines) == sorted(FILES)
    for name, line in lines.items():
        assert find_config(name).samefile(FILES[name])
        assert re.fullmatch(r"[A-Z0-9].{20,150}\.", line), name
    assert {name for name, line in lines.items() if "Needs RATSLAM_" in line} == REAL
    assert read_citation().startswith("cff-version: ")
    # Else an installed wheel, which has the files of `setup.py` only, could not run them.
    for name in FILES.keys() - REAL:
        if "base" not in load(FILES[name]).data:
            config = load_config(find_config(name))
            assert config.recording is None or config.recording.file.exists()
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
    unknown = refused(capsys, *command.format("squarre").split())
    assert "no such file or packaged configuration" in unknown
    error = refused(capsys, *command.format("square").split(), "--set", "recording.format.x=1")
    assert "square" in error or "recording.format" in error
    assert "no such file" not in error
    assert list(elsewhere.iterdir()) == []


@pytest.mark.parametrize("command", ["run", "study", "live"])
def test_the_list_has_a_line_for_each(command: str, capsys) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        main([command, "--list"])
    assert dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines()) == packaged_configs()


def test_the_base_of_a_study_may_be_a_name(elsewhere: Path) -> None:
    (elsewhere / "study.yaml").write_text("base: square\n")
    (job,) = read_study("study.yaml").jobs
    assert job.config.recording is not None
    assert job.config.recording.file.samefile(ROOT / "tests" / "golden" / "a_square3.npz")


SQUARE = {"recording": {"file": str(ROOT / "tests" / "golden" / "a_square3.npz")}}
ARM = {"simulation": {"path": {"explore": 5}}, "touch": {"head": {"dead": [4]}}}
CREATE = {"create_simulation": {"reports": 5}}
CASES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "square": (SQUARE, ()),
    "arm": (ARM, ("touch",)),
    "arm, classic": (ARM | {"backend": "classic"}, ("touch",)),
    "arm, grid": (ARM | {"backend": "grid"}, ("arm",)),
    "create": (CREATE, ("create", "touch")),
    "create, grid": (CREATE | {"backend": "grid"}, ("create",)),
}


def values(settings: dict[str, Any], config: Any, within: str = "") -> list[tuple[str, Any, Any]]:
    """Name and value of each setting of a preset, and its value in a configuration."""
    found = []
    for key, value in settings.items():
        name, given = f"{within}.{key}", getattr(config, key)
        found += values(value, given, name) if isinstance(value, dict) else [(name, value, given)]
    return found


@pytest.mark.parametrize("case", CASES)
def test_the_presets_that_suit_the_source_are_used_and_named(case: str) -> None:
    """The completed configuration and the file of it are complete: they stay the same if completed again."""
    parts, used = CASES[case]
    config = RunConfig.model_validate(parts)
    source = open_source(config)
    completed = complete(config, source)
    assert completed.presets == used
    taken = dict[str, Any]()  # the first preset that has a setting gives it
    for preset in used:
        for name, value, found in values(PRESETS[preset], completed):
            assert taken.setdefault(name, value) == found
    assert complete(completed, source) == completed
    again = validate(parse(dump(completed), "config.yaml"), RunConfig)
    assert complete(again, source) == again == completed
    assert dump(complete(again, source)) == dump(completed)
    assert complete(RunConfig.model_validate(parts | {"presets": used}), source) == completed


def test_settings_of_the_configuration_go_before_presets():
    given = {
        "pose_cells": {"cells_xy": 31}, "recall": {"enter": 0.4},
        "keyframes": {"min_score": 7.0, "noise": {"per_cell": 0.5}},
    }  # fmt: skip
    config = RunConfig.model_validate(ARM | given)
    completed, preset = complete(config, open_source(config)), PRESETS["touch"]["keyframes"]
    assert (completed.pose_cells.cells_xy, completed.recall.enter) == (31, 0.4)
    keyframes = completed.keyframes
    assert (keyframes.min_score, keyframes.noise.per_cell) == (7.0, 0.5)
    assert keyframes.select_every == preset["select_every"]
    assert keyframes.noise.heading_per_cell == preset["noise"]["heading_per_cell"]


@pytest.mark.parametrize(("setting", "used"), [
    ({"presets": []}, ()),
    ({"recall": {"sector_fov": "none"}}, ()),
    ({"recall": {"sector_fov": "whiskers"}}, ("touch",)),
])  # fmt: skip
def test_no_preset_is_used_if_the_list_is_empty_or_views_are_not_of_whiskers(setting, used):
    config, plain = (RunConfig.model_validate(ARM | given) for given in (setting, {}))
    completed = complete(config, open_source(config))
    assert completed.presets == used
    unset = completed.model_copy(update={"keyframes": config.keyframes})
    assert completed == (complete(plain, open_source(plain)) if used else unset)


def test_the_source_fills_head_cell_size_whiskers_and_the_extent_of_a_grid():
    config = RunConfig.model_validate(ARM)
    source = open_source(config)
    completed = complete(config, source)
    assert (completed.touch.head.dead, completed.pose_cells.cell_size) == ((4,), source.info.cell_size)
    config = RunConfig.model_validate(CREATE)
    source = open_source(config)
    reports, given = complete(config, source).touch.reports, source.info.planar_whiskers
    assert given is not None
    assert (reports.mounts, reports.length) == (given.mounts, given.length)
    config, given = (
        RunConfig.model_validate(CREATE | {"backend": "grid", "grid": grid}) for grid in ({}, {"side": 3.0})
    )
    source = open_source(config)
    assert complete(config, source).grid.side > 2 * EXTENT_MARGIN
    assert complete(config, source, 2.0).grid.side == round(2 * (EXTENT_FACTOR * 2.0 + EXTENT_MARGIN), 2)
    assert complete(given, source).grid.side == 3.0


@pytest.mark.parametrize(("drives", "used"), [(True, ("create", "touch")), (False, ("touch",))])
def test_a_robot_that_drives_has_the_odometry_noise_of_wheels(drives, used) -> None:
    source = SourceDescription((1, 5, 1), 5, 0.0, SourceInfo(drives=drives))
    completed = complete(RunConfig.model_validate(SQUARE), source)
    assert completed.presets == used
    assert (
        completed.keyframes.noise.heading_per_cell
        == PRESETS[used[0]]["keyframes"]["noise"]["heading_per_cell"]
    )
    assert completed.keyframes.noise.per_cell == PRESETS["touch"]["keyframes"]["noise"]["per_cell"]


WRENCH = {"plugin": "wrench", "settings": {"simulation": {"path": {"circuits": "C"}}}}


def test_touch_without_whiskers_has_the_preset_for_touch_and_no_layout(monkeypatch) -> None:
    monkeypatch.setitem(SOURCES.builtin, "wrench", tactile_arrays.WRENCH)
    monkeypatch.setitem(TOUCH.builtin, "wrench", tactile_arrays.WRENCH_FRONTEND)
    config = RunConfig.model_validate({"source": WRENCH, "touch": {"frontend": {"plugin": "wrench"}}})
    completed = complete(config, open_source(config))
    assert complete(completed, open_source(config)) == completed
    assert (completed.presets, completed.recall.sector_fov) == (("touch",), "none")
    assert completed.keyframes.noise.per_cell == PRESETS["touch"]["keyframes"]["noise"]["per_cell"]


@pytest.mark.parametrize("name", ["hall", "hall_2"])
def test_a_building_is_chosen_by_its_recording_or_by_a_variable(name, tmp_path, monkeypatch):
    config = ROOT / "configs" / "building.yaml"
    monkeypatch.delenv("RATSLAM_BUILDING", raising=False)
    with pytest.raises(InputError, match="the environment variable RATSLAM_BUILDING is not set"):
        load_config(config)
    for file in ("hall_odom_gt", "hall_scans", "hall_2_odom_gt", "hall_2_scans"):
        (tmp_path / f"{file}.csv").touch()
    given = load_config(config, [f"recording.file={tmp_path / name}_odom_gt.csv"])
    assert given.recording.table.views.file == tmp_path / f"{name}_scans.csv"
    monkeypatch.setenv("RATSLAM_BUILDING", str(tmp_path / name))
    assert load_config(config) == given


IRAT = """\
[general]
topic_root = irat_red

[draw]
enable=1

[ratslam]
image_crop_y_max = 150
template_x_size= 60
template_y_size =20
vt_shift_match = 4
vt_step_match=1
vt_match_threshold = 0.03
vt_active_decay = 1.0
pc_dim_xy = 11
pc_vt_inject_energy = 0.1
pc_cell_x_size = 0.015
exp_delta_pc_threshold = 2
exp_loops=20
exp_initial_em_deg = 140
"""
ST_LUCIA = """\
[ratslam]
template_x_size=60
vt_shift_match=5
vt_normalisation=0.4
pc_vt_restore=.04
[visual_odometry]
vtrans_image_x_max=475
vrot_image_y_max=240
camera_fov_deg=53
camera_hz=10
vtrans_scaling=1000
vtrans_max=20
"""


def written(text: str) -> Path:
    path = Path("config_irat.txt")
    path.write_text(text)
    return path


def test_the_irat_becomes_a_configuration(elsewhere: Path, capsys) -> None:
    output = Path("irat.yaml")
    assert main(["tools", "convert", str(written(IRAT)), "-o", str(output)]) == 0
    notes = capsys.readouterr().err.splitlines()
    assert notes == ["note: exp_initial_em_deg has no counterpart: maps start at heading 0"]
    load_config(output)
    settings = yaml.safe_load(output.read_text())
    assert settings["recording"] == {
        "file": "irat_red.bag",
        "image": {"crop": {"x_min": 0, "y_min": 0, "y_max": 150}, "rows": 20, "columns": 60},
        "topics": {"openratslam": "irat_red"},
    }
    assert settings["backend"] == "classic"
    assert settings["templates"] == {
        "threshold": 0.03, "shift": 4, "shift_step": 1, "panoramic": False, "normalise_mean": 0.0, "patch": 0,
        "patch_sd": 0.0, "energy": 0.1, "habituation": 1.0, "recovery": 0.05,
    }  # fmt: skip
    assert settings["places"] == {"radius": 2.0, "radius_heading": 2.0}
    assert settings["experience"] == {"solver": {"name": "relaxation", "loops": 20, "correction": 0.5}}
    cells = settings["pose_cells"]
    assert cells == {"cells_xy": 11, "cells_heading": 36, "cell_size": 0.015}
    assert settings["attractor"]["excite_sigma"] == 1.0


def test_a_video_and_visual_odometry_load(elsewhere: Path, capsys) -> None:
    """The relative path of the recording is found from the folder of the output."""
    (elsewhere / "there").mkdir()
    command = ["tools", "convert", str(written(ST_LUCIA)), "--recording", "lucia.avi"]
    assert main([*command, "-o", "there/lucia.yaml"]) == 0
    assert "calibrate recording.visual_odometry.scaling" in capsys.readouterr().err
    config = load_config("there/lucia.yaml")
    assert config.recording is not None
    assert (config.recording.file.resolve(), config.recording.video.rate) == (elsewhere / "lucia.avi", 10)
    visual = config.recording.visual_odometry
    assert visual is not None
    assert (visual.fov_deg, visual.scaling, visual.max_speed) == (53, 100, 20)
    assert (visual.translation.x_max, visual.rotation.y_max, visual.rotation.x_max) == (475, 240, None)
    assert (config.templates.normalise_mean, config.templates.recovery) == (0.4, 0.04)
    assert config.attractor.global_inhibition == 2e-5  # missing keys keep the default of OpenRatSLAM
    assert config.places.radius == 2.0


@pytest.mark.parametrize(("text", "note"), [
    (IRAT + "vt_magic=1\n", ":21: vt_magic in [ratslam] is unknown"),
    (IRAT + "[loops]\na=1\n", "[loops] is unknown"),
    ("[ratslam]\ntemplate_x_size=6\n", "vt_shift_match 25 leaves none of 6 columns: 2 is set"),
    ("[ratslam]\n", "no topic_root"),
    ("[ratslam]\n[visual_odometry]\ncamera_hz=5\n", "no camera_fov_deg and is left out"),
])  # fmt: skip
def test_what_has_no_counterpart_is_noted(text: str, note: str, elsewhere: Path) -> None:
    assert note in "\n".join(convert_parameters(written(text))[1])


@pytest.mark.parametrize(("text", "found"), [
    ("", " is empty"),
    ("a: 1\n", ":1: 'a: 1' stands before any section"),
    ("[general]\ntopic_root=a\n", " no section [ratslam]"),
    ("[ratslam]\n\npc_dim_xy = big\n", ":3: pc_dim_xy = big; expected a whole number"),
    ("[ratslam]\npc_cell_x_size=nan\n", ":2: pc_cell_x_size = nan; expected a finite number"),
    ("[ratslam]\nvt_panoramic=2\n", ":2: vt_panoramic = 2; expected 0 or 1"),
    ("[ratslam]\npc_dim_xy = 3\npc_dim_th=36\n", ":2: pc_dim_xy: pose_cells.cells_xy"),
    ("[ratslam]\npc_dim_xy=9\npc_dim_xy=11\n", ":3: pc_dim_xy in [ratslam] stands twice"),
    ("[ratslam]\npc_dim_xy\n", ":2: "),
    ("[ratslam]\n[visual_odometry]\ncamera_hz=0\n", ":3: camera_hz = 0; expected a rate above 0"),
])  # fmt: skip
def test_faults_have_a_line(text: str, found: str, elsewhere: Path) -> None:
    with pytest.raises(InputError) as error:
        convert_parameters(written(text))
    assert found in str(error.value)
    assert len(str(error.value).splitlines()) == 1
