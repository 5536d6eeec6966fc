"""Errors of poses in a map: a deformed map is no error of localisation, a wrong place is."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.papers.maps.localisation_metrics import BUILDING, RIGHT, WRONG, MapSteps, pose_errors
from tactile.base.se2 import compose


def straight(count: int = 11) -> np.ndarray:
    """Steps of 0.1 m along x."""
    return np.column_stack([0.1 * np.arange(count), np.zeros((count, 2))])


def test_a_map_that_is_moved_has_no_error() -> None:
    truth, motion = straight(), np.array([3.0, -2.0, 2.0])
    steps = MapSteps.known(compose(motion, truth), truth)
    here = np.array([[0.43, 0.05, 0.3], [0.9, 0.0, -0.2]])
    np.testing.assert_allclose(steps.errors(compose(motion, here), here, 0.1), 0, atol=1e-12)
    np.testing.assert_allclose(pose_errors(steps.align(compose(motion, here)), here), 0, atol=1e-12)


def test_a_bent_map_is_an_error_only_after_alignment() -> None:
    truth = straight()
    bent = truth.copy()
    bent[6:] = compose(np.array([0.3, 0.4, 0.5]), truth[6:])
    steps = MapSteps.known(bent, truth)
    here = truth[[8]] + [0.0, 0.02, 0.0]
    pose = compose(np.array([0.3, 0.4, 0.5]), here)
    np.testing.assert_allclose(steps.errors(pose, here, 0.1), 0, atol=1e-12)
    assert pose_errors(steps.align(pose), here)[0, 0] > 0.05


def test_a_wrong_place_is_an_error_of_its_distance_and_turn() -> None:
    truth = straight()
    steps = MapSteps.known(truth, truth)
    error = steps.errors(np.array([[0.5, 0.1, np.pi - 0.1]]), np.array([[0.2, 0.1, -np.pi]]), 0.1)
    np.testing.assert_allclose(error, [[0.3, 0.1]], atol=1e-12)


def test_a_step_with_the_same_heading_is_preferred_if_it_is_about_as_near() -> None:
    truth = np.array([[0.0, 0.0, np.pi], [0.05, 0.0, 0.0], [0.5, 0.0, 0.0]])
    steps = MapSteps.known(truth, truth)
    assert steps.nearest(np.zeros((1, 3)), 0.09).tolist() == [1]
    assert steps.nearest(np.zeros((1, 3)), 0.04).tolist() == [0]


def test_steps_without_truth_are_left_out() -> None:
    truth = straight()
    truth[3] = np.nan
    steps = MapSteps.known(straight(), truth)
    assert len(steps.pose) == 10
    error = steps.errors(straight(), truth, 0.1)
    assert np.isnan(error[3]).all()
    assert not WRONG.exceeded(error)[3]
    assert not RIGHT.holds(error)[3]
    assert RIGHT.holds(error).sum() == 10


@pytest.mark.parametrize(
    ("error", "right", "wrong"),
    [
        ((0.09, 0.3), True, False),
        ((0.1, 0.0), False, False),
        ((0.19, 0.0), False, True),
        ((0.0, 0.6), False, True),
    ],
)
def test_between_right_and_wrong_is_neither(error: tuple[float, float], right: bool, wrong: bool) -> None:
    assert RIGHT.holds(np.array([error]))[0] == right
    assert WRONG.exceeded(np.array([error]))[0] == wrong


def test_a_step_is_revisited_with_its_heading() -> None:
    steps = MapSteps.known(straight(), straight())
    truth = np.array([[0.5, 1.9, 0.5], [0.5, 2.1, 0.0], [0.5, 0.0, np.pi]])
    assert steps.revisited(truth, BUILDING).tolist() == [True, False, False]


def test_places_move_with_the_map_around_them() -> None:
    truth, motion = straight(), np.array([1.0, 2.0, np.pi / 2])
    place = compose(motion, np.array([[0.5, 0.2, 0.0]]))[:, :2]
    np.testing.assert_allclose(MapSteps.known(compose(motion, truth), truth).true_places(place), [[0.5, 0.2]])
