"""Sums of signs name changed places, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.places.change import ALARMS, PASS, Signs, find_changes, learn_chance

RADIUS = 0.09
CHANCE = (0.01, 8.0)


def walls(random: np.random.Generator, count: int = 2000) -> Signs:
    """Signs along a wall of 2 m that has not changed, in 400 keyframes."""
    points = np.column_stack([random.uniform(0.0, 2.0, count), random.normal(0.0, 0.005, count)])
    keyframe = np.sort(random.integers(0, 400, count))
    return Signs(points, random.normal(-0.5, 1.0, count), np.zeros(count), keyframe, 400)


def planted(signs: Signs, x: float, evidence: float, appears: float) -> Signs:
    """The same with the evidence changed within 6 cm of a point of the wall."""
    there = np.abs(signs.points[:, 0] - x) < 0.06
    return signs._replace(
        evidence=np.where(there, evidence, signs.evidence), appears=np.where(there, appears, signs.appears)
    )


@pytest.mark.parametrize(("appears", "kind"), [(1.0, "new"), (-1.0, "gone"), (0.0, "different")])
def test_a_change_is_named_where_it_is(appears: float, kind: str) -> None:
    signs = planted(walls(np.random.default_rng(1)), 1.3, 1.5, appears)
    (change,) = find_changes(signs, CHANCE, RADIUS)
    np.testing.assert_allclose(change.position, [1.3, 0.0], atol=0.02)
    assert change.extent == pytest.approx(0.12, abs=0.03)
    assert change.kind == kind
    assert change.alarms < ALARMS
    assert change.passes >= 1 + (np.diff(change.keyframes) > PASS).sum()


def test_an_unchanged_wall_is_not_named() -> None:
    for seed in range(20):
        signs = walls(np.random.default_rng(seed))
        assert (
            find_changes(signs, learn_chance(walls(np.random.default_rng(seed + 100)), RADIUS), RADIUS) == []
        )


def test_places_are_named_by_descending_evidence() -> None:
    signs = planted(planted(walls(np.random.default_rng(2)), 0.4, 1.0, 1.0), 1.6, 3.0, -1.0)
    found = find_changes(signs, CHANCE, RADIUS)
    assert [change.kind for change in found] == ["gone", "new"]
    assert found[0].evidence > found[1].evidence


def test_a_map_whose_revisits_disagree_needs_more_evidence() -> None:
    random = np.random.default_rng(3)
    noisy = walls(random)
    noisy = noisy._replace(evidence=random.normal(0.0, 3.0, len(noisy.evidence)))
    calm, restless = learn_chance(walls(random), RADIUS), learn_chance(noisy, RADIUS)
    assert restless[1] > 2 * calm[1]
    by_chance = [rate * np.exp(-60.0 / height) for rate, height in (calm, restless)]
    assert by_chance[1] > by_chance[0]


def test_passes_are_told_apart() -> None:
    count = 30
    keyframe = np.repeat([0, 2 * PASS, 5 * PASS], count // 3)
    points = np.random.default_rng(4).normal(0.0, 0.01, (count, 2))
    (change,) = find_changes(
        Signs(points, np.full(count, 3.0), np.ones(count), keyframe, 400), CHANCE, RADIUS
    )
    assert change.passes == 3


def test_nothing_is_named_without_signs() -> None:
    empty = np.zeros(0)
    signs = Signs(np.zeros((0, 2)), empty, empty, empty.astype(int), 0)
    assert find_changes(signs, learn_chance(signs, RADIUS), RADIUS) == []
