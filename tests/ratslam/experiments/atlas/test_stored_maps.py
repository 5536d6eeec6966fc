"""A map is made once, written complete, and read as any other map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ratslam.experiments.atlas.scenarios import unknown_start
from ratslam.experiments.atlas.stored_maps import store_map
from ratslam.pipeline.saved_map import read_map


@pytest.mark.soak
def test_a_map_is_made_once_and_read_as_any_other(tmp_path: Path) -> None:
    recipe = unknown_start(31000)
    made = store_map(recipe, tmp_path / "maps")
    (file,) = made.path.glob("map.npz")
    before = file.stat().st_mtime_ns
    again = store_map(recipe, tmp_path / "maps")
    assert file.stat().st_mtime_ns == before
    for one, other in zip(made.arrays, again.arrays, strict=True):
        np.testing.assert_array_equal(one, other)
    saved = read_map(made.path)
    assert saved.steps == len(made.arrays.truth) == 120
    np.testing.assert_array_equal(saved.open_session().map.map_trajectory(), made.arrays.trajectory)
    assert [path.name for path in (tmp_path / "maps").iterdir()] == [made.path.name]
