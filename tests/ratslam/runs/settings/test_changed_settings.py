"""The settings that differ from the defaults."""

from __future__ import annotations

from pathlib import Path

import pytest

from ratslam.runs.settings.packaged import read_citation
from ratslam.runs.settings.run_config import changed_settings
from tactile.base.errors import InputError

CONFIG = """
backend: classic
simulation: {seed: 3, path: {explore: 40}, maze: {heights: [0.03, 0.05]}}
create_simulation: null
recall: {guard: 20}
session: {reserve: 0, seed: 2}
"""


def test_only_other_values_are_listed(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(CONFIG)
    assert [tuple(setting) for setting in changed_settings(path)] == [
        ("simulation.maze.heights", "[0.03, 0.05]", "[0.05]"),
        ("simulation.path.circuits", '""', '"CCCAAACACA"'),
        ("simulation.path.explore", "40.0", "0.0"),
        ("simulation.seed", "3", "0"),
        ("backend", '"classic"', '"recall"'),
        ("session.seed", "2", "0"),
    ]


def test_a_setting_that_must_be_given_has_no_default(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("recording: {file: '/private/<b>.npz'}\n")
    ((name, value, default),) = changed_settings(path)
    assert (name, default) == ("recording.file", "")
    assert value == '"<b>.npz"'  # pages are shared, folders are private


def test_a_malformed_configuration_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("nonsense: 1\n")
    with pytest.raises(InputError, match="nonsense"):
        changed_settings(tmp_path / "config.yaml")


def test_the_citation_comes_with_the_program() -> None:
    assert read_citation().startswith("cff-version: ")
