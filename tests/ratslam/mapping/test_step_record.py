"""Steps are known relative to keyframes, those before the first keyframe of a piece too."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.optimizer import MapFit
from ratslam.mapping.step_record import NO_TRAVEL, StepRecord, Travel, leading_to
from tactile.base.se2 import compose
from tactile.base.types import Odometry

MOTION = np.array([0.2, 0.05, 0.3])
POSES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5], [50.0, 9.0, -2.0]])


def fit(poses: np.ndarray) -> MapFit:
    return MapFit(poses, 0.0, np.zeros(0))


def travelled(steps: int) -> Travel:
    travel = NO_TRAVEL
    for _ in range(steps):
        travel = travel.onwards(Odometry(*MOTION, 0.1))
    return travel


def record(taken: bool = True) -> StepRecord:
    """Two keyframes, each followed by a step; three steps of a new piece, the third being its keyframe."""
    steps = StepRecord()
    for frame in (0, 1):
        steps.append(frame, NO_TRAVEL, MOTION)
        steps.append(frame, travelled(1), MOTION)
    for k in (1, 2):
        steps.append(leading_to(2), travelled(k), MOTION)
    if taken:
        steps.arrive(2, travelled(3))
        steps.append(2, NO_TRAVEL, MOTION)
    return steps


def test_steps_before_the_first_keyframe_of_a_piece_lead_to_it() -> None:
    steps = record()
    found = steps.poses(fit(POSES))
    np.testing.assert_allclose(found[6], POSES[2])
    for k in (4, 5):
        np.testing.assert_allclose(compose(found[k], MOTION), found[k + 1], atol=1e-12)
    assert steps.first_steps(3).tolist() == [0, 2, 6]
    assert steps.of_keyframes(np.array([7, 8, 9])).tolist() == [7, 7, 8, 8, 9, 9, 9]


def test_until_it_is_taken_they_belong_to_the_keyframe_before() -> None:
    for steps in (pending := record(taken=False), settled := record(taken=False)):
        if steps is settled:
            steps.settle(2)
        np.testing.assert_allclose(steps.poses(fit(POSES[:2]))[5], compose(POSES[1], travelled(2).motion))
        assert steps.of_keyframes(np.array([7, 8])).tolist() == [7, 7, 8, 8, 8, 8]
    pending.arrive(2, travelled(3))
    settled.arrive(2, travelled(3))
    assert pending.of_keyframes(np.arange(3))[5] == 2
    assert settled.of_keyframes(np.arange(3))[5] == 1


@pytest.mark.parametrize("kept", [[0, 2], [2], [0, 1]])
def test_of_a_part_of_the_keyframes_the_steps_that_lead_to_them_remain(kept: list[int]) -> None:
    steps, number = record(), np.full(3, -1)
    number[kept] = np.arange(len(kept))
    before = steps.poses(fit(POSES))
    remaining = steps.take(number)
    owner = np.array([0, 0, 1, 1, 2, 2, 2])
    assert remaining.tolist() == np.flatnonzero(np.isin(owner, kept)).tolist()
    np.testing.assert_allclose(steps.poses(fit(POSES[kept])), before[remaining])
