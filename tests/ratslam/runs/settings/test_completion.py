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
from robot.sources.source import Source
from tactile.base.errors import InputError

ROOT = Path(__file__).parents[4]
SQUARE = {"recording": {"file": str(ROOT / "tests" / "golden" / "a_square3.npz")}}
ARM = {"simulation": {"path": {"explore": 5}}, "touch": {"head": {"dead": [4]}}}
CREATE = {"create_simulation": {"reports": 5}}
PARTS: dict[str, dict[str, Any]] = {
    "square": SQUARE,
    "arm": ARM,
    "arm, classic": ARM | {"backend": "classic"},
    "arm, grid": ARM | {"backend": "grid"},
    "create": CREATE,
    "create, grid": CREATE | {"backend": "grid"},
}
USED = {
    "square": (),
    "arm": ("touch",),
    "arm, classic": ("touch",),
    "arm, grid": ("arm",),
    "create": ("touch",),
    "create, grid": ("create",),
}


@pytest.fixture(scope="module", params=PARTS)
def case(request) -> tuple[str, RunConfig, Source]:
    config = RunConfig.model_validate(PARTS[request.param])
    return request.param, config, open_source(config)


def values(settings: dict[str, Any], config: Any) -> list[tuple[Any, Any]]:
    """Pairs of the value in a preset and in a configuration."""
    pairs = []
    for name, value in settings.items():
        found = getattr(config, name)
        pairs += values(value, found) if isinstance(value, dict) else [(value, found)]
    return pairs


def test_the_presets_that_suit_the_source_are_used_and_named(case):
    name, config, source = case
    completed = complete(config, source)
    assert completed.presets == USED[name]
    for preset in USED[name]:
        pairs = values(PRESETS[preset], completed)
        assert all(value == found for value, found in pairs)


def test_completing_again_changes_nothing(case):
    _, config, source = case
    completed = complete(config, source)
    assert complete(completed, source) == completed


def test_the_written_configuration_is_complete(case):
    _, config, source = case
    completed = complete(config, source)
    again = validate(parse(dump(completed), "config.yaml"), RunConfig)
    assert again == completed
    assert complete(again, source) == completed
    assert dump(complete(again, source)) == dump(completed)


def test_a_preset_that_is_named_gives_the_same(case):
    name, config, source = case
    named = RunConfig.model_validate(PARTS[name] | {"presets": USED[name]})
    assert complete(named, source) == complete(config, source)


def test_settings_of_the_configuration_go_before_presets():
    config = RunConfig.model_validate(ARM | {"pose_cells": {"cells_xy": 31}, "recall": {"enter": 0.4}})
    completed = complete(config, open_source(config))
    assert completed.pose_cells.cells_xy == 31
    assert completed.recall.enter == 0.4
    assert completed.keyframes.select_every == PRESETS["touch"]["keyframes"]["select_every"]


def test_no_preset_is_used_if_the_list_is_empty_or_views_are_not_of_whiskers():
    for setting in ({"presets": []}, {"recall": {"sector_fov": "none"}}):
        config = RunConfig.model_validate(ARM | setting)
        completed = complete(config, open_source(config))
        assert completed.presets == ()
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


def test_the_grid_covers_the_odometry_or_the_given_extent():
    config = RunConfig.model_validate(CREATE | {"backend": "grid"})
    source = open_source(config)
    side = complete(config, source).grid.side
    assert side is not None
    assert side > 2 * EXTENT_MARGIN
    assert complete(config, source, 2.0).grid.side == round(2 * (EXTENT_FACTOR * 2.0 + EXTENT_MARGIN), 2)
    given = RunConfig.model_validate(CREATE | {"backend": "grid", "grid": {"side": 3.0}})
    assert complete(given, source).grid.side == 3.0


@pytest.fixture
def buildings(tmp_path):
    """Files of two buildings, one name a prefix of the other, and the shared configuration."""
    for name in ("hall", "hall_2"):
        for file in ("odom_gt.csv", "scans.csv"):
            (tmp_path / f"{name}_{file}").touch()
    return tmp_path


@pytest.mark.parametrize("name", ["hall", "hall_2"])
def test_a_building_is_chosen_by_its_recording_or_by_a_variable(name, buildings, monkeypatch):
    config = ROOT / "configs" / "building.yaml"
    given = load_config(config, [f"recording.file={buildings / name}_odom_gt.csv"])
    assert given.recording is not None
    assert given.recording.table.views is not None
    assert given.recording.table.views.file == buildings / f"{name}_scans.csv"
    monkeypatch.setenv("RATSLAM_BUILDING", str(buildings / name))
    assert load_config(config) == given


def test_a_missing_choice_of_building_is_refused(monkeypatch):
    monkeypatch.delenv("RATSLAM_BUILDING", raising=False)
    with pytest.raises(InputError, match="the environment variable RATSLAM_BUILDING is not set"):
        load_config(ROOT / "configs" / "building.yaml")


@pytest.mark.parametrize("name", ["acapulco", "aces", "belgioioso", "freiburg_101"])
def test_the_shared_configuration_equals_those_of_single_buildings(name, reference_data):
    folder = (reference_data / "buildings").resolve()
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}")
    given = load_config(ROOT / "configs" / "building.yaml", [f"recording.file={folder / name}_odom_gt.csv"])
    assert given == load_config(folder / f"{name}.yaml")
