"""Saved maps of simulated sessions, merged one by one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.papers.maps.operations import Methods
from evaluation.papers.maps.scenarios import Recipe
from evaluation.papers.maps.stored_maps import store_map
from evaluation.papers.tables.touch_table import touch_config
from tests.ratslam.runs.touch_walks import SMALL

MAZE, SESSIONS = 31001, 4


def session(number: int) -> Recipe:
    """Laps that begin at another cell in each session."""
    path = {"circuits": "CCCC", "start": 2 * number}
    return Recipe(touch_config(MAZE, number, {"maze": SMALL, "path": path}))


@pytest.mark.soak
@pytest.mark.parametrize("later_first", [False, True])
def test_each_further_session_joins_the_merged_map(later_first: bool, tmp_path: Path) -> None:
    merged, *others = [store_map(session(number), tmp_path / "maps") for number in range(SESSIONS)]
    worst = max(one.arrays.em for one in (merged, *others))
    for number, one in enumerate(others):
        maps = [one, merged] if later_first else [merged, one]
        merged = Methods().merge(maps, tmp_path / f"merged {number}")
        assert not merged.arrays.piece.any()
        np.testing.assert_array_equal(merged.arrays.truth, np.concatenate([m.arrays.truth for m in maps]))
        assert merged.arrays.em < 1.5 * worst
