"""Changed places are named, and no others: contacts laid over those of a map, their signs, and sessions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ratslam.mapping.appearance import LabelAppearance, WhiskerAppearance
from ratslam.mapping.ground import Ground, learn_gain_odds
from ratslam.places.change import (
    ALARMS,
    PASS,
    ContactMap,
    Signs,
    contact_points,
    contact_signs,
    find_changes,
    learn_chance,
    session_changes,
)
from ratslam.places.contact_alignment import ContactCloud, RememberedContacts
from ratslam.places.localiser import Place, Visits
from ratslam.recall.whisker_likelihood import PRIOR, estimate_background, log_odds_table, pixel_layout
from tactile.base.se2 import between, compose
from tactile.whisker_geometry import HeadConfig, ur10_head

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


def test_an_unchanged_wall_and_one_without_signs_are_not_named() -> None:
    for seed in range(6):
        chance = learn_chance(walls(np.random.default_rng(seed + 100)), RADIUS)
        assert find_changes(walls(np.random.default_rng(seed)), chance, RADIUS) == []
    signs = walls(np.random.default_rng(0), 0)
    assert find_changes(signs, learn_chance(signs, RADIUS), RADIUS) == []


def test_passes_are_told_apart() -> None:
    keyframe = np.repeat([0, 2 * PASS, 5 * PASS], 10)
    points = np.random.default_rng(4).normal(0.0, 0.01, (30, 2))
    (change,) = find_changes(Signs(points, np.full(30, 3.0), np.ones(30), keyframe, 400), CHANCE, RADIUS)
    assert change.passes == 3


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


HEAD = ur10_head(HeadConfig())
LAYOUT = pixel_layout((3, 6, 1))
TALLEST = 0.05
TOUCHED = [1, 7, 13]
"""Whiskers on the left."""


def images(random: np.random.Generator, count: int) -> np.ndarray:
    """[count, 18] levels of a corridor with a wall on the left."""
    levels = np.zeros((count, 18), int)
    levels[:, TOUCHED] = random.integers(14, 18, (count, len(TOUCHED)))
    return levels


def corridor(reversed: bool = False) -> ContactMap:
    """The map of a corridor along x."""
    random = np.random.default_rng(0)
    poses = np.column_stack([np.arange(0.0, 1.0, 0.02), np.zeros(50), np.zeros(50)])
    levels = images(random, 50)
    if reversed:
        poses[:, 2], levels = np.pi, levels[:, LAYOUT.opposite]
    varied = np.concatenate([levels, np.roll(levels, 1, axis=1), np.zeros_like(levels)])
    table = log_odds_table(estimate_background(varied, LAYOUT.group), PRIOR)
    ground = Ground(poses, np.array([0.0, -np.pi]), 0.06, 0.3, np.full(3, 1e-4))
    return ContactMap(ground, levels, LAYOUT, table, HEAD, TALLEST)


def drive(count: int = 20) -> np.ndarray:
    return np.column_stack([np.linspace(0.2, 0.6, count), np.zeros(count), np.zeros(count)])


@pytest.mark.parametrize("reversed", [False, True])
def test_the_same_wall_speaks_against_a_change_and_a_gone_one_is_missed_where_it_was(reversed):
    made, poses = corridor(reversed), drive()
    signs = contact_signs(made, poses, images(np.random.default_rng(1), 20), np.full(20, 50))
    assert len(signs.evidence) == 60
    assert signs.evidence.mean() < 0
    assert not signs.appears.any()
    signs = contact_signs(made, poses, np.zeros((20, 18), int), np.full(20, 50))
    assert (signs.evidence > 0).all()
    assert (signs.appears == -1).all()
    assert (signs.points[:, 1] > 0.03).all()  # on the left of the robot


def test_a_new_wall_stands_where_the_whiskers_touch_it() -> None:
    made, poses = corridor(), drive()
    levels = images(np.random.default_rng(2), 20)
    right = np.arange(18).reshape(3, 6)[:, -np.arange(6) % 6].ravel()[TOUCHED]  # opposite sides
    levels[:, right] = 16
    signs = contact_signs(made, poses, levels, np.full(20, 50))
    new = signs.appears == 1
    assert new.sum() == 60
    assert (signs.points[new, 1] < -0.03).all()
    assert (signs.evidence[new] > 0).all()
    points, touched = contact_points(poses, levels, HEAD, TALLEST)
    assert touched.sum() == 120
    np.testing.assert_allclose(np.sort(signs.points[new, 0]), np.sort(points[:, right, 0].ravel()))


def test_only_known_keyframes_are_compared() -> None:
    made, poses = corridor(), drive()
    levels = images(np.random.default_rng(3), 20)
    assert not len(contact_signs(made, poses, levels, np.zeros(20, int)).evidence)
    behind = contact_signs(made, poses, levels, np.full(20, 9))
    assert set(behind.keyframe.tolist()) == {0}


TOUCH = (ur10_head(HeadConfig()), 0.05)
LONG = 100
"""Keyframes of one way along the corridor."""
GONE = slice(45, 56)


def drive_ways(random: np.random.Generator, ways: int) -> tuple[np.ndarray, np.ndarray]:
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


def corridor_place(after: int = 0) -> Place:
    """The map of three ways, and of some `after` the wall has gone."""
    poses, levels = drive_ways(np.random.default_rng(0), 3 + after)
    remove_wall(levels, after)
    appearance = WhiskerAppearance(LAYOUT, 1.0)
    table = log_odds_table(estimate_background(np.roll(levels, 1, axis=1), LAYOUT.group), PRIOR)
    arrays = appearance.arrays() | {"level": levels, "likeness/0": table}
    appearance.restore(arrays)
    map = SimpleNamespace(
        appearance=appearance,
        solution=lambda: SimpleNamespace(pose=SimpleNamespace(rows=poses)),
        state=SimpleNamespace(total=len(poses), guard=20),
    )
    ground = Ground(poses, np.array([0.0, -np.pi]), 0.06, 0.3, np.full(3, 1e-4))
    return Place(cast(Any, map), np.arange(len(poses)), ground, learn_gain_odds(np.zeros(0), np.zeros(0)))


def visits(ways: int, changed: int) -> Visits:
    """Ways along the corridor, of which the last `changed` lack the left wall at `GONE`."""
    poses, levels = drive_ways(np.random.default_rng(1), ways)
    remove_wall(levels, changed)
    return Visits(np.arange(len(poses)), poses, levels)


def test_the_missing_wall_is_named_where_it_was() -> None:
    place = corridor_place()
    (change,) = session_changes(place, visits(3, 3), *TOUCH)
    assert change.kind == "gone"
    assert change.position[0] == pytest.approx(1.0, abs=0.05)
    assert change.position[1] > 0.03
    assert change.passes == 3


def test_nothing_is_named_that_the_map_knows() -> None:
    """A map that was continued after the change knows both looks; a map of other views compares none."""
    assert session_changes(corridor_place(), visits(3, 0), *TOUCH) == []
    place = corridor_place(after=3)
    assert session_changes(place, visits(3, 3), *TOUCH) == []
    assert session_changes(place, visits(3, 0), *TOUCH) == []
    place.map.appearance = LabelAppearance()
    assert session_changes(place, visits(1, 1), *TOUCH) == []


RANDOM = np.random.default_rng(3)


def contacts(corner: bool) -> np.ndarray:
    """Contacts on both sides of a corridor, and on a wall across its end."""
    along = RANDOM.uniform(0, 1, (3000, 1))
    side = np.where(RANDOM.random((3000, 1)) < 0.5, -0.09, 0.09)
    walls = np.hstack([along, side + RANDOM.normal(0, 0.003, (3000, 1))])
    across = np.column_stack([np.full(600, 1.0), RANDOM.uniform(-0.09, 0.09, 600)])
    return np.vstack([walls, across]) if corner else walls


def seen_from(pose: np.ndarray, points: np.ndarray, count: int = 40) -> np.ndarray:
    near = points[np.hypot(*(points - pose[:2]).T) < 0.2]
    chosen = RANDOM.choice(near, count)
    return between(pose, np.column_stack([chosen, np.zeros(count)]))[:, :2]


@pytest.mark.parametrize("error", [(0.0, 0.02, 0.05), (0.015, -0.02, -0.08)])
def test_the_pose_is_found_again(error):
    points, true = contacts(corner=True), np.array([0.9, 0.01, 0.2])
    cloud, seen = ContactCloud(points), seen_from(true, points)
    pose = compose(true, np.array(error))
    for _ in range(3):
        pose = cloud.align(pose, seen)
    assert np.abs(between(true, pose)).max() < 0.006


def test_along_a_corridor_the_given_pose_stays():
    points, true = contacts(corner=False), np.array([0.5, 0.0, 0.0])
    found = ContactCloud(points).align(compose(true, np.array([0.02, 0.02, 0.0])), seen_from(true, points))
    assert abs(found[1]) < 0.004
    assert found[0] == pytest.approx(0.52, abs=0.004)


def test_few_or_unknown_contacts_change_nothing():
    cloud, pose = ContactCloud(contacts(corner=True)), np.array([0.5, 0.0, 0.0])
    assert np.array_equal(cloud.align(pose, np.zeros((0, 2))), pose)
    assert np.array_equal(cloud.align(pose, RANDOM.normal(0, 0.01, (30, 2))), pose)
    assert np.array_equal(ContactCloud(np.zeros((0, 2))).align(pose, np.ones((9, 2))), pose)


def test_contacts_agree_at_their_pose_and_not_elsewhere():
    points = contacts(corner=True)
    poses = np.column_stack([np.tile(np.linspace(0.2, 0.9, 40), 3), np.zeros((120, 2))])
    known = RememberedContacts(poses, [seen_from(pose, points, 12) for pose in poses], 5)
    assert 0.5 < known.least <= 1.0
    true = np.array([0.9, 0.0, 0.0])
    seen = seen_from(true, points)
    assert known.agrees(true, seen)
    assert not known.agrees(true + [0.0, 0.04, 0.0], seen)
    assert not known.agrees(true + [0.0, 0.0, 0.8], seen)
    assert known.agrees(true + [0.0, 0.04, 0.0], seen[:3]), "too few deny nothing"
