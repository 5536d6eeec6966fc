"""A session in a corridor whose wall is gone for a stretch: it is named."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ratslam.mapping.appearance import LabelAppearance, WhiskerAppearance
from ratslam.mapping.ground import Ground, learn_gain_odds
from ratslam.places.change import session_changes
from ratslam.places.localiser import Place, Visits
from ratslam.recall.whisker_likelihood import PRIOR, estimate_background, log_odds_table, pixel_layout
from tactile.whisker_geometry import HeadConfig, ur10_head

TOUCH = (ur10_head(HeadConfig()), 0.05)
LAYOUT = pixel_layout((3, 6, 1))
LONG = 100
"""Keyframes of one way along the corridor."""
GONE = slice(45, 56)


def drive(random: np.random.Generator, ways: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses [n, 3] and images [n, 18] along a corridor of 2 m with walls on both sides, `ways` times."""
    x = np.tile(np.arange(LONG) * 0.02, ways)
    poses = np.column_stack([x, random.normal(0.0, 0.005, len(x)), np.zeros(len(x))])
    levels = np.zeros((len(x), 18), int)
    for whisker in (1, 2, 4, 5, 7, 8, 10, 11):
        seen = random.random(len(x)) < 0.95
        levels[:, whisker] = np.where(seen, random.integers(12, 18, len(x)), 0)
    return poses, levels


def remove_wall(levels: np.ndarray, ways: int) -> None:
    """Takes away the left wall at `GONE` in the last `ways` of images [n, 18]."""
    by_way = levels.reshape(-1, LONG, 18)
    by_way[len(by_way) - ways :, GONE, [1, 2, 7, 8]] = 0


def corridor(after: int = 0) -> Place:
    """The map of three ways, and of some `after` the wall has gone."""
    poses, levels = drive(np.random.default_rng(0), 3 + after)
    remove_wall(levels, after)
    appearance = WhiskerAppearance(LAYOUT, 1.0)
    table = log_odds_table(estimate_background(np.roll(levels, 1, axis=1), LAYOUT.group), PRIOR)
    arrays = appearance.arrays() | {"level": levels, "likeness/0": table}
    appearance.restore(arrays)
    map = SimpleNamespace(
        appearance=appearance,
        solution=lambda: SimpleNamespace(fit=SimpleNamespace(poses=poses)),
        keyframes=lambda: SimpleNamespace(count=len(poses), guard=20),
    )
    ground = Ground(poses, np.array([0.0, -np.pi]), 0.06, 0.3, np.full(3, 1e-4))
    return Place(cast(Any, map), np.arange(len(poses)), ground, learn_gain_odds(np.zeros(0), np.zeros(0)))


def visits(ways: int, changed: int) -> Visits:
    """Ways along the corridor, of which the last `changed` lack the left wall at `GONE`."""
    poses, levels = drive(np.random.default_rng(1), ways)
    remove_wall(levels, changed)
    return Visits(np.arange(len(poses)), poses, levels)


def test_the_missing_wall_is_named_where_it_was() -> None:
    place = corridor()
    (change,) = session_changes(place, visits(3, 3), *TOUCH)
    assert change.kind == "gone"
    assert change.position[0] == pytest.approx(1.0, abs=0.05)
    assert change.position[1] > 0.03
    assert change.passes == 3


def test_an_unchanged_session_names_nothing() -> None:
    assert session_changes(corridor(), visits(3, 0), *TOUCH) == []


def test_a_map_that_was_continued_after_the_change_knows_both_looks() -> None:
    """Nothing is named any more, whether the wall is gone or is back."""
    place = corridor(after=3)
    assert session_changes(place, visits(3, 3), *TOUCH) == []
    assert session_changes(place, visits(3, 0), *TOUCH) == []


def test_maps_of_other_views_name_nothing() -> None:
    place = corridor()
    place.map.appearance = LabelAppearance()
    assert session_changes(place, visits(1, 1), *TOUCH) == []
