"""Observations of the front end from complete and dropped whisks."""

from __future__ import annotations

import numpy as np
import pytest

from tactile.base.types import Cycle, Observation, Odometry, Whisk
from tactile.calibration import Calibration
from tactile.frontend import Frontend, TouchConfig

W = 18
MOTION = Odometry(0.03, 0.01, -0.2, 1.0)
ONES = np.ones((W, 2))
CALIBRATION = Calibration(0 * ONES, 2e-3 * ONES, 0.04 * ONES, ONES[:, 0], ONES[:, 0] > 0, 2000.0)
DROPPED = Cycle(np.zeros(0), np.zeros((0, W)), np.zeros((0, W, 2)), MOTION)


def like(one: Observation, other: Observation) -> bool:
    """Whether shapes and types are equal, so that one chunk can hold both."""
    parts = zip([*one.odometry, *one[1:]], [*other.odometry, *other[1:]], strict=True)
    return all((np.shape(a), np.asarray(a).dtype) == (np.shape(b), np.asarray(b).dtype) for a, b in parts)


def a_whisk(alive: np.ndarray) -> Whisk:
    touched = np.linspace(0.1, 0.9, W)
    return Whisk(MOTION, alive, touched > 0.5, touched, touched > 0.7, touched, touched)


@pytest.mark.parametrize("settings", [{}, {"image": {"radial": True, "transform": "max_angle"}}])
def test_a_dropped_whisk_has_motion_but_no_view(settings: dict[str, object]) -> None:
    frontend = Frontend(TouchConfig.model_validate(settings), CALIBRATION)
    seen = frontend.observe(DROPPED)
    assert not seen.view_seen
    assert tuple(seen.odometry) == tuple(MOTION)
    for part in (seen.view, seen.contact, seen.point, seen.wall):
        assert not np.any(part)
    assert not seen.alive.any()  # unread whiskers must not count as free
    assert like(seen, frontend.observe(a_whisk(np.ones(W, bool))))


def test_one_live_whisker_makes_a_view() -> None:
    frontend = Frontend(TouchConfig(), CALIBRATION)
    for count in range(W + 1):
        seen = frontend.observe(a_whisk(np.arange(W) < count))
        assert bool(seen.view_seen) == (count > 0)
        assert seen.view_seen.dtype == bool
