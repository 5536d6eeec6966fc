"""The keyframes that a robot at a pose is compared with, and the poses that they claim."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.ground import NEAR, Ground
from ratslam.mapping.ground import REACH as REACH_CELLS
from ratslam.recall.config import RecallConfig, sector_shifts
from tactile.base.se2 import compose
from tests.ratslam.places.alignment_cases import (
    POSES,
    REACH,
    REACH_HEADING,
    SEEDS,
    VARIANCE,
    assert_same_pose,
    ground_at,
    moved_by,
)


def scattered(seed: int, count: int = 40) -> Ground:
    poses = np.random.default_rng(seed).uniform([-0.2, -0.2, -np.pi], [0.2, 0.2, np.pi], (count, 3))
    return ground_at(poses, (0.0, np.pi))


@given(SEEDS)
def test_near_keyframes_claim_poses_within_reach_and_no_others_do(seed: int) -> None:
    ground = scattered(seed)
    found = set(
        zip(*(index.tolist() for index in ground.near(np.zeros(3), REACH, REACH_HEADING)), strict=True)
    )
    for shift in range(2):
        for frame in range(len(ground.poses)):
            x, y, heading = ground.claims(np.array([shift]), np.array([frame]))[0]
            expected = np.hypot(x, y) < REACH and abs(heading) < REACH_HEADING
            assert ((shift, frame) in found) == expected


@given(SEEDS)
def test_the_best_match_is_the_largest_gain_near_by_that_is_better_than_a_new_place(seed: int) -> None:
    ground, random = scattered(seed), np.random.default_rng(seed + 1)
    gain = random.normal(0.0, 2.0, (2, len(ground.poses)))
    near = gain[ground.near(np.zeros(3), REACH, REACH_HEADING)]
    match = ground.best_match(np.zeros(3), gain)
    if match is None:
        assert not (near > 0).any()
    else:
        assert match.gain == gain[match.shift, match.frame] == near.max() > 0
    assert ground.best_match(np.zeros(3), -np.abs(gain)) is None


@given(SEEDS, POSES)
def test_what_is_near_does_not_depend_on_the_frame_of_the_map(seed: int, change: np.ndarray) -> None:
    ground, moved = scattered(seed), moved_by(change, scattered(seed))
    for one, other in zip(ground.near(np.zeros(3), REACH, 1.0), moved.near(change, REACH, 1.0), strict=True):
        np.testing.assert_array_equal(one, other)
    assert moved.places() == pytest.approx(ground.places())


@given(st.integers(1, 6), st.integers(1, 4))
def test_places_are_counted_once(apart: int, visits: int) -> None:
    poses = np.array([[k * 3 * REACH, 0.0, 0.0] for k in range(apart) for _ in range(visits)])
    assert ground_at(poses).places() == pytest.approx(apart)
    assert ground_at(poses, (0.0, np.pi)).places() == pytest.approx(2 * apart)


def test_a_single_keyframe_is_one_place() -> None:
    ground = ground_at(np.zeros(3))
    assert ground.places() == 1.0
    assert [len(index) for index in ground.near(np.array([1.0, 0.0, 0.0]), REACH, 1.0)] == [0, 0]


@pytest.mark.parametrize(
    ("recall", "angle", "least"),
    [
        ({"sector_fov": "whiskers"}, np.pi, 0.3),
        ({"sector_fov": "none"}, 0.0, 0.3),
        ({"sector_fov": 6.28, "shifts": 3}, 0.8, 0.48),  # half the turns between two shifts, and more
    ],
)
def test_a_turned_robot_sees_shifted_views(recall: dict, angle: float, least: float) -> None:
    config = RecallConfig.model_validate(recall)
    shifts = sector_shifts(config)
    ground = Ground.of(np.zeros((1, 3)), shifts, 0.05, angle, VARIANCE, NEAR)
    assert ground.reach == pytest.approx(REACH_CELLS * 0.05)
    assert ground.reach_heading == pytest.approx(least)
    assert len(ground.turns) == len(shifts)
    claimed = ground.claims(np.arange(len(shifts)), np.zeros(len(shifts), int))
    expected = compose(np.zeros((len(shifts), 3)), np.array([[0, 0, -k * angle] for k in shifts.tolist()]))
    assert_same_pose(claimed, expected)
