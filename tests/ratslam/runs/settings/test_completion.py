"""Completion of a configuration: the precedence of values, and that every setting is filled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ratslam.runs.build_session import open_source
from ratslam.runs.settings.completion import EXTENT_FACTOR, EXTENT_MARGIN, complete
from ratslam.runs.settings.packaged import PRESETS
from ratslam.runs.settings.run_config import RunConfig, load_config
from ratslam.runs.settings.strict_yaml import dump, parse, validate
from robot.sources.source import SOURCES
from robot.touch_source import TOUCH
from tactile.base.errors import InputError
from tests.helpers import tactile_arrays

ROOT = Path(__file__).parents[4]
SQUARE = {"recording": {"file": str(ROOT / "tests" / "golden" / "a_square3.npz")}}
ARM = {"simulation": {"path": {"explore": 5}}, "touch": {"head": {"dead": [4]}}}
CREATE = {"create_simulation": {"reports": 5}}
CASES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "square": (SQUARE, ()),
    "arm": (ARM, ("touch",)),
    "arm, classic": (ARM | {"backend": "classic"}, ("touch",)),
    "arm, grid": (ARM | {"backend": "grid"}, ("arm",)),
    "create": (CREATE, ("touch",)),
    "create, grid": (CREATE | {"backend": "grid"}, ("create",)),
}


def values(settings: dict[str, Any], config: Any) -> list[tuple[Any, Any]]:
    """Pairs of the value in a preset and in a configuration."""
    pairs = []
    for name, value in settings.items():
        found = getattr(config, name)
        pairs += values(value, found) if isinstance(value, dict) else [(value, found)]
    return pairs


@pytest.mark.parametrize("case", CASES)
def test_the_presets_that_suit_the_source_are_used_and_named(case: str) -> None:
    """The completed configuration and the file of it are complete: they stay the same if completed again."""
    parts, used = CASES[case]
    config = RunConfig.model_validate(parts)
    source = open_source(config)
    completed = complete(config, source)
    assert completed.presets == used
    for preset in used:
        assert all(value == found for value, found in values(PRESETS[preset], completed))
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
    assert completed.pose_cells.cells_xy == 31
    assert completed.recall.enter == 0.4
    keyframes = completed.keyframes
    assert (keyframes.min_score, keyframes.noise.per_cell) == (7.0, 0.5)
    assert keyframes.select_every == preset["select_every"]
    assert keyframes.noise.heading_per_cell == preset["noise"]["heading_per_cell"]


@pytest.mark.parametrize(
    ("setting", "used"),
    [
        ({"presets": []}, ()),
        ({"recall": {"sector_fov": "none"}}, ()),
        ({"recall": {"sector_fov": "whiskers"}}, ("touch",)),
    ],
)
def test_no_preset_is_used_if_the_list_is_empty_or_views_are_not_of_whiskers(setting, used):
    config, plain = (RunConfig.model_validate(ARM | given) for given in (setting, {}))
    completed = complete(config, open_source(config))
    assert completed.presets == used
    if used:
        assert completed == complete(plain, open_source(plain))
    else:
        assert completed.keyframes == config.keyframes


def test_an_unknown_preset_is_refused():
    with pytest.raises(InputError, match=r"c\.yaml:2:11: presets\.0: 'tuch'.*did you mean 'touch'"):
        validate(parse("simulation: {}\npresets: [tuch]\n", "c.yaml"), RunConfig)


def test_the_source_fills_head_cell_size_and_whiskers():
    config = RunConfig.model_validate(ARM)
    source = open_source(config)
    completed = complete(config, source)
    assert completed.touch.head.dead == (4,)
    assert completed.pose_cells.cell_size == source.info.cell_size
    config = RunConfig.model_validate(CREATE)
    source = open_source(config)
    reports = complete(config, source).touch.reports
    assert source.info.planar_whiskers is not None
    assert reports.mounts == source.info.planar_whiskers.mounts
    assert reports.length == source.info.planar_whiskers.length


WRENCH = {"plugin": "wrench", "settings": {"simulation": {"path": {"circuits": "C"}}}}


def test_touch_without_whiskers_has_the_preset_for_touch_and_no_layout() -> None:
    SOURCES.register("wrench", tactile_arrays.WRENCH)
    TOUCH.register("wrench", tactile_arrays.WRENCH_FRONTEND)
    try:
        config = RunConfig.model_validate({"source": WRENCH, "touch": {"frontend": {"plugin": "wrench"}}})
        completed = complete(config, open_source(config))
        assert complete(completed, open_source(config)) == completed
    finally:
        for registry in (SOURCES, TOUCH):
            registry.unregister("wrench")
    assert (completed.presets, completed.recall.sector_fov) == (("touch",), "none")
    assert completed.keyframes.noise.per_cell == PRESETS["touch"]["keyframes"]["noise"]["per_cell"]


def test_the_grid_covers_the_odometry_or_the_given_extent():
    config = RunConfig.model_validate(CREATE | {"backend": "grid"})
    source = open_source(config)
    side = complete(config, source).grid.side
    assert side is not None
    assert side > 2 * EXTENT_MARGIN
    assert complete(config, source, 2.0).grid.side == round(2 * (EXTENT_FACTOR * 2.0 + EXTENT_MARGIN), 2)
    given = RunConfig.model_validate(CREATE | {"backend": "grid", "grid": {"side": 3.0}})
    assert complete(given, source).grid.side == 3.0


@pytest.mark.parametrize("name", ["hall", "hall_2"])
def test_a_building_is_chosen_by_its_recording_or_by_a_variable(name, tmp_path, monkeypatch):
    """Also of two buildings, one name a prefix of the other."""
    config = ROOT / "configs" / "building.yaml"
    monkeypatch.delenv("RATSLAM_BUILDING", raising=False)
    with pytest.raises(InputError, match="the environment variable RATSLAM_BUILDING is not set"):
        load_config(config)
    for file in ("hall_odom_gt", "hall_scans", "hall_2_odom_gt", "hall_2_scans"):
        (tmp_path / f"{file}.csv").touch()
    given = load_config(config, [f"recording.file={tmp_path / name}_odom_gt.csv"])
    assert given.recording is not None
    assert given.recording.table.views is not None
    assert given.recording.table.views.file == tmp_path / f"{name}_scans.csv"
    monkeypatch.setenv("RATSLAM_BUILDING", str(tmp_path / name))
    assert load_config(config) == given
