"""Settings that have moved: configurations with the old names open, with the same values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.runs.settings.renamed_keys import MOVED
from ratslam.runs.settings.run_config import RunConfig, changed_settings, load_config
from ratslam.runs.settings.strict_yaml import parse
from tactile.base.errors import InputError

WRITTEN = Path(__file__).parents[3] / "data" / "maps" / "ratslam-map-1.npz"
"""A map file, whose configuration was written when the settings of `MOVED` had their old names."""


@pytest.mark.parametrize("old", MOVED)
def test_every_new_key_exists_and_no_old_one(old: str) -> None:
    section, key = old.split(".")
    assert key not in type(RunConfig.model_fields[section].default).model_fields
    if MOVED[old] is not None:
        section, key = MOVED[old].split(".")
        assert key in type(RunConfig.model_fields[section].default).model_fields


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """The configuration of an earlier version as the file of a run folder."""
    path = tmp_path / "config.yaml"
    with np.load(WRITTEN) as arrays:
        path.write_text(str(arrays["config"]))
    return path


def test_a_configuration_that_the_program_wrote_is_read_with_moved_settings(written: Path) -> None:
    old = parse(written.read_text(), "c.yaml").data["pose_cells"]
    config = load_config(written, source_required=False)
    now = {**dict(config.pose_cells), **dict(config.attractor)}
    assert now == old
    assert old["engine"] == "dense"
    moved = {old for old, new in MOVED.items() if new is not None}
    assert {f"pose_cells.{name}" for name in config.attractor.model_fields_set} == moved
    assert "attractor.engine" in [name for name, _, _ in changed_settings(written)]


def test_options_come_before_moved_settings(written: Path) -> None:
    options = ["attractor.engine=window", "attractor.settle_steps=7"]
    network = load_config(written, options, source_required=False).attractor
    assert (network.engine, network.settle_steps, network.excite_sigma) == ("window", 7, 1.0)


def test_wrong_values_in_it_are_reported_where_they_stand(written: Path) -> None:
    written.write_text(written.read_text().replace("excite_width: 7", "excite_width: 6"))
    line = 1 + written.read_text().splitlines().index("  excite_width: 6")
    with pytest.raises(InputError, match=rf"config.yaml:{line}:17: attractor.excite_width: 6: must be odd"):
        load_config(written, source_required=False)


def test_a_users_old_settings_move_too(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("pose_cells: {engine: dense, excite_sigma: 1.5}\n")
    network = load_config(path, source_required=False).attractor
    assert (network.engine, network.excite_sigma) == ("dense", 1.5)


def test_a_users_setting_without_a_counterpart_is_an_unknown_key(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("recall: {reach: 1.0}\n")
    with pytest.raises(InputError, match=r"mine.yaml:1:10: recall.reach: unknown key"):
        load_config(path, source_required=False)
