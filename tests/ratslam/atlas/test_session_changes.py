"""A session in a corridor whose wall is gone for a stretch: it is named, and its keyframes are outdated."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ratslam.alignment.gain_odds import learn_gain_odds
from ratslam.alignment.ground import Ground
from ratslam.atlas.localiser import Place, Visits
from ratslam.atlas.session_changes import Touch, contradicted_keyframes, session_changes
from ratslam.keyframes.appearance import LabelAppearance, WhiskerAppearance
from ratslam.keyframes.outdated import OutdatedKeyframes
from ratslam.recall.whisker_likelihood import PRIOR, estimate_background, log_odds_table, pixel_layout
from tactile.whiskers.head_geometry import HeadConfig, ur10_head

TOUCH = Touch(ur10_head(HeadConfig()), 0.05)
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


def corridor() -> Place:
    """The map of three ways."""
    poses, levels = drive(np.random.default_rng(0), 3)
    appearance = WhiskerAppearance(LAYOUT, 1.0)
    table = log_odds_table(estimate_background(np.roll(levels, 1, axis=1), LAYOUT.group), PRIOR)
    arrays = appearance.arrays() | {"level": levels, "likeness/0": table}
    appearance.restore(arrays)
    map = SimpleNamespace(
        appearance=appearance,
        outdated=OutdatedKeyframes(),
        solution=lambda: SimpleNamespace(fit=SimpleNamespace(poses=poses)),
        keyframes=lambda: SimpleNamespace(count=len(poses), guard=20),
    )
    ground = Ground(poses, np.array([0.0, -np.pi]), 0.06, 0.3, np.full(3, 1e-4))
    return Place(cast(Any, map), np.arange(len(poses)), ground, learn_gain_odds(np.zeros(0), np.zeros(0)))


def visits(ways: int, changed: int) -> Visits:
    """Ways along the corridor, of which the first `changed` lack the left wall at `GONE`."""
    poses, levels = drive(np.random.default_rng(1), ways)
    by_way = levels.reshape(ways, LONG, 18)
    by_way[:changed, GONE, [1, 2, 7, 8]] = 0
    return Visits(np.arange(len(poses)), poses, levels)


def test_the_missing_wall_is_named_where_it_was() -> None:
    place = corridor()
    (change,) = session_changes(place, visits(3, 3), TOUCH)
    assert change.kind == "gone"
    assert change.position[0] == pytest.approx(1.0, abs=0.05)
    assert change.position[1] > 0.03
    assert change.passes == 3


def test_an_unchanged_session_names_nothing() -> None:
    assert session_changes(corridor(), visits(3, 0), TOUCH) == []


def test_keyframes_are_outdated_after_two_passes_and_only_at_the_change() -> None:
    place = corridor()
    for passes in (1, 3):
        session = visits(3, passes)
        outdated = contradicted_keyframes(place, session, TOUCH, session_changes(place, session, TOUCH))
        if passes == 1:
            assert not len(outdated)
        else:
            assert len(outdated) > 20
            assert np.abs(place.ground.poses[outdated, 0] - 1.0).max() < 0.25


def test_maps_of_other_views_name_nothing() -> None:
    place = corridor()
    place.map.appearance = LabelAppearance()
    assert session_changes(place, visits(1, 1), TOUCH) == []
