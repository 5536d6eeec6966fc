"""Changed places are named, and no others: contacts laid over those of a map, their signs, and sessions."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ratslam.mapping.appearance import LabelAppearance, WhiskerAppearance
from ratslam.mapping.ground import Ground, learn_gain_odds
from ratslam.places import change as changing
from ratslam.places.change import ALARMS, PASS, Change, ContactMap, Signs, find_changes, learn_chance
from ratslam.places.contact_alignment import ContactCloud, RememberedContacts
from ratslam.places.localiser import Place, Visits
from ratslam.recall.whisker_likelihood import PRIOR, estimate_background, log_odds_table, pixel_layout
from tactile.base.se2 import between, compose
from tactile.frontend import TouchConfig

RADIUS, CHANCE = 0.09, (0.01, 8.0)


def walls(random: np.random.Generator, count: int = 2000) -> Signs:
    """Signs along a wall of 2 m that has not changed, in 400 keyframes."""
    points = np.column_stack([random.uniform(0.0, 2.0, count), random.normal(0.0, 0.005, count)])
    keyframe = np.sort(random.integers(0, 400, count))
    return Signs(points, random.normal(-0.5, 1.0, count), np.zeros(count), keyframe, 400)


def planted(signs: Signs, x: float, evidence: float, appears: float) -> Signs:
    """The same with the evidence changed within 6 cm of a point of the wall."""
    changed = {"evidence": evidence, "appears": appears}
    there = np.abs(signs.points[:, 0] - x) < 0.06
    return signs._replace(**{name: np.where(there, of, getattr(signs, name)) for name, of in changed.items()})


@pytest.mark.parametrize(("appears", "kind"), [(1.0, "new"), (-1.0, "gone"), (0.0, "different")])
def test_a_change_is_named_where_it_is(appears: float, kind: str) -> None:
    signs = planted(walls(np.random.default_rng(1)), 1.3, 1.5, appears)
    (change,) = find_changes(signs, CHANCE, RADIUS)
    np.testing.assert_allclose(change.position, [1.3, 0.0], atol=0.02)
    assert change.extent == pytest.approx(0.12, abs=0.03)
    assert change.kind == kind
    assert change.alarms < ALARMS
    assert change.passes >= 1 + (np.diff(change.keyframes) > PASS).sum()


def test_an_unchanged_wall_is_not_named_and_a_map_whose_revisits_disagree_needs_more_evidence() -> None:
    for seed in range(6):
        chance = learn_chance(walls(np.random.default_rng(seed + 100)), RADIUS)
        assert find_changes(walls(np.random.default_rng(seed)), chance, RADIUS) == []
    signs = walls(np.random.default_rng(0), 0)
    assert find_changes(signs, learn_chance(signs, RADIUS), RADIUS) == []
    random = np.random.default_rng(3)
    noisy = walls(random)._replace(evidence=random.normal(0.0, 3.0, 2000))
    calm, restless = learn_chance(walls(random), RADIUS), learn_chance(noisy, RADIUS)
    assert restless[1] > 2 * calm[1]
    assert restless[0] * np.exp(-60.0 / restless[1]) > calm[0] * np.exp(-60.0 / calm[1])


def test_places_are_named_by_descending_evidence_and_passes_are_told_apart() -> None:
    signs = planted(planted(walls(np.random.default_rng(2)), 0.4, 1.0, 1.0), 1.6, 3.0, -1.0)
    found = find_changes(signs, CHANCE, RADIUS)
    assert [change.kind for change in found] == ["gone", "new"]
    assert found[0].evidence > found[1].evidence
    keyframe = np.repeat([0, 2 * PASS, 5 * PASS], 10)
    points = np.random.default_rng(4).normal(0.0, 0.01, (30, 2))
    (change,) = find_changes(Signs(points, np.full(30, 3.0), np.ones(30), keyframe, 400), CHANCE, RADIUS)
    assert change.passes == 3


TOUCH = TouchConfig()
LAYOUT, TOUCHED = pixel_layout((3, 6, 1)), [1, 7, 13]
"""The last: whiskers on the left."""


def ground_along(poses: np.ndarray) -> Ground:
    return Ground(poses, np.array([0.0, -np.pi]), 0.06, 0.3, np.full(3, 1e-4))


def images(random: np.random.Generator, count: int) -> np.ndarray:
    """[count, 18] levels of a corridor with a wall on the left."""
    levels = np.zeros((count, 18), int)
    levels[:, TOUCHED] = random.integers(14, 18, (count, len(TOUCHED)))
    return levels


def corridor(reversed: bool = False) -> ContactMap:
    """The map of a corridor along x."""
    poses, levels = drive(50, 0.0, 0.98), images(np.random.default_rng(0), 50)
    if reversed:
        poses[:, 2], levels = np.pi, levels[:, LAYOUT.opposite]
    varied = np.concatenate([levels, np.roll(levels, 1, axis=1), np.zeros_like(levels)])
    table = log_odds_table(estimate_background(varied, LAYOUT.group), PRIOR)
    return ContactMap(ground_along(poses), levels, LAYOUT, table, TOUCH)


def drive(count: int = 20, begin: float = 0.2, end: float = 0.6) -> np.ndarray:
    return np.column_stack([np.linspace(begin, end, count), np.zeros((count, 2))])


def signs_of(levels: np.ndarray, reversed: bool = False, known: int = 50) -> Signs:
    """Of a drive with images [20, 18] along the corridor, of which so many keyframes are known."""
    return changing.contact_signs(corridor(reversed), drive(), levels, np.full(20, known))


@pytest.mark.parametrize("reversed", [False, True])
def test_the_same_wall_speaks_against_a_change_and_a_gone_one_is_missed_where_it_was(reversed):
    signs = signs_of(images(np.random.default_rng(1), 20), reversed)
    assert len(signs.evidence) == 60
    assert signs.evidence.mean() < 0
    assert not signs.appears.any()
    signs = signs_of(np.zeros((20, 18), int), reversed)
    assert (signs.evidence > 0).all()
    assert (signs.appears == -1).all()
    assert (signs.points[:, 1] > 0.03).all()  # on the left of the robot


def test_a_new_wall_stands_where_the_whiskers_touch_it_and_only_known_keyframes_are_compared() -> None:
    levels = images(np.random.default_rng(2), 20)
    right = np.arange(18).reshape(3, 6)[:, -np.arange(6) % 6].ravel()[TOUCHED]  # opposite sides
    levels[:, right] = 16
    signs = signs_of(levels)
    new = signs.appears == 1
    assert new.sum() == 60
    assert (signs.points[new, 1] < -0.03).all()
    assert (signs.evidence[new] > 0).all()
    points, touched = changing.contact_points(drive(), levels, TOUCH)
    assert touched.sum() == 120
    np.testing.assert_allclose(np.sort(signs.points[new, 0]), np.sort(points[:, right, 0].ravel()))
    levels = images(np.random.default_rng(3), 20)
    assert not len(signs_of(levels, known=0).evidence)
    assert set(signs_of(levels, known=9).keyframe.tolist()) == {0}


LONG, GONE = 100, slice(45, 56)
"""Keyframes of one way along the corridor, and those at the wall that is taken away."""


def drive_ways(seed: int, ways: int, changed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses [n, 3] and images [n, 18] along a corridor of 2 m with walls on both sides, so many times; the
    last `changed` lack the left wall at `GONE`."""
    random, x = np.random.default_rng(seed), np.tile(np.arange(LONG) * 0.02, ways)
    poses = np.column_stack([x, random.normal(0.0, 0.005, len(x)), np.zeros(len(x))])
    levels = np.zeros((ways, LONG, 18), int)
    for whisker in (1, 2, 4, 5, 7, 8, 10, 11):
        seen = random.random((ways, LONG)) < 0.95
        levels[..., whisker] = np.where(seen, random.integers(12, 18, seen.shape), 0)
    levels[ways - changed :, GONE, [1, 2, 7, 8]] = 0
    return poses, levels.reshape(-1, 18)


def corridor_place(after: int = 0) -> Place:
    """The map of three ways, and of some `after` the wall has gone."""
    poses, levels = drive_ways(0, 3 + after, after)
    appearance = WhiskerAppearance(LAYOUT, 1.0)
    table = log_odds_table(estimate_background(np.roll(levels, 1, axis=1), LAYOUT.group), PRIOR)
    appearance.restore(appearance.arrays() | {"level": levels, "likeness/0": table})
    map = SimpleNamespace(
        appearance=appearance,
        solution=lambda: SimpleNamespace(pose=SimpleNamespace(rows=poses)),
        state=SimpleNamespace(total=len(poses), guard=20),
    )
    odds = learn_gain_odds(np.zeros(0), np.zeros(0))
    return Place(cast(Any, map), np.arange(len(poses)), ground_along(poses), odds)


def changes(place: Place, ways: int, changed: int) -> list[Change]:
    """Those of a session along the corridor."""
    poses, levels = drive_ways(1, ways, changed)
    return changing.session_changes(place, Visits(np.arange(len(poses)), poses, levels), TOUCH)


def test_the_missing_wall_is_named_where_it_was_and_nothing_that_the_map_knows() -> None:
    fresh, place = corridor_place(), corridor_place(after=3)
    (change,) = changes(fresh, 3, 3)
    assert change.kind == "gone"
    assert change.position[0] == pytest.approx(1.0, abs=0.05)
    assert change.position[1] > 0.03
    assert change.passes == 3
    assert changes(fresh, 3, 0) == changes(place, 3, 3) == changes(place, 3, 0) == []
    place.map.appearance = LabelAppearance()
    assert changes(place, 1, 1) == []


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
    pose, seen = compose(true, np.array(error)), seen_from(true, points)
    for _ in range(3):
        pose = ContactCloud(points).align(pose, seen)
    assert np.abs(between(true, pose)).max() < 0.006


def test_along_a_corridor_the_given_pose_stays_and_few_or_unknown_contacts_change_nothing():
    points, true = contacts(corner=False), np.array([0.5, 0.0, 0.0])
    found = ContactCloud(points).align(compose(true, np.array([0.02, 0.02, 0.0])), seen_from(true, points))
    assert abs(found[1]) < 0.004
    assert found[0] == pytest.approx(0.52, abs=0.004)
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
