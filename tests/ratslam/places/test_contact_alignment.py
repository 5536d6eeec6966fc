"""Contacts laid over those of a map."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.places.contact_alignment import ContactCloud, RememberedContacts
from tactile.base.se2 import between, compose

RANDOM = np.random.default_rng(3)


def corridor(corner: bool) -> np.ndarray:
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
    points, true = corridor(corner=True), np.array([0.9, 0.01, 0.2])
    cloud, seen = ContactCloud(points), seen_from(true, points)
    pose = compose(true, np.array(error))
    for _ in range(3):
        pose = cloud.align(pose, seen)
    assert np.abs(between(true, pose)).max() < 0.006


def test_along_a_corridor_the_given_pose_stays():
    points, true = corridor(corner=False), np.array([0.5, 0.0, 0.0])
    found = ContactCloud(points).align(compose(true, np.array([0.02, 0.02, 0.0])), seen_from(true, points))
    assert abs(found[1]) < 0.004
    assert found[0] == pytest.approx(0.52, abs=0.004)


def test_few_or_unknown_contacts_change_nothing():
    cloud, pose = ContactCloud(corridor(corner=True)), np.array([0.5, 0.0, 0.0])
    assert np.array_equal(cloud.align(pose, np.zeros((0, 2))), pose)
    assert np.array_equal(cloud.align(pose, RANDOM.normal(0, 0.01, (30, 2))), pose)
    assert np.array_equal(ContactCloud(np.zeros((0, 2))).align(pose, np.ones((9, 2))), pose)


def test_contacts_agree_at_their_pose_and_not_elsewhere():
    points = corridor(corner=True)
    poses = np.column_stack([np.tile(np.linspace(0.2, 0.9, 40), 3), np.zeros((120, 2))])
    known = RememberedContacts(poses, [seen_from(pose, points, 12) for pose in poses], 5)
    assert 0.5 < known.least <= 1.0
    true = np.array([0.9, 0.0, 0.0])
    seen = seen_from(true, points)
    assert known.agrees(true, seen)
    assert not known.agrees(true + [0.0, 0.04, 0.0], seen)
    assert not known.agrees(true + [0.0, 0.0, 0.8], seen)
    assert known.agrees(true + [0.0, 0.04, 0.0], seen[:3]), "too few deny nothing"
