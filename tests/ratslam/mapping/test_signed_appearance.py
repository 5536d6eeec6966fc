"""Signed images of keyframes: what is learned from a session, misfit and restored state."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ratslam.mapping.appearance import (
    LOG_ODDS_INTERVAL,
    NEUTRAL_IMAGE_MISFIT,
    NEW_IMAGE_LOG_ODDS,
    SignedAppearance,
)
from tactile.base.types import Odometry, observation

SHAPE, PLACES = (1, 4, 3), 10
SILENT = SimpleNamespace()


def no_pairs():
    return np.zeros((0, 3), int)


@pytest.fixture(scope="module")
def filled():
    """Twice along ten places, four images in each."""
    random = np.random.default_rng(0)
    there = 10 * random.normal(size=(PLACES, *SHAPE))
    appearance = SignedAppearance(int(np.prod(SHAPE)))
    for place in [*np.repeat(np.arange(PLACES), 4)] * 2:
        view = there[place] + random.normal(size=SHAPE)
        appearance.append(observation(Odometry(0.1, 0.0, 0.0, 1.0), view, view_shape=SHAPE, whiskers=4), 0, 0)
        appearance.learn(SILENT, no_pairs)
    return appearance


def test_the_metric_is_learned_at_intervals(filled):
    fresh = SignedAppearance(12)
    assert fresh.metric().scale == 0.0
    assert not fresh.metric().likeness.size
    assert fresh.least_misfit(0, np.array([0]), np.zeros(1, bool)) == NEUTRAL_IMAGE_MISFIT
    assert filled.metric().scale == NEW_IMAGE_LOG_ODDS
    assert filled.metric().likeness.size
    assert 2 * LOG_ODDS_INTERVAL == 8 * PLACES


def test_images_of_one_place_are_more_alike(filled):
    frames = np.arange(40, 80)
    ahead = np.zeros(40, bool)
    here = filled.misfits(frames, frames - 40, ahead)
    elsewhere = filled.misfits(frames, (frames - 20) % 40, ahead)
    assert (here < elsewhere).mean() > 0.9
    others = np.arange(40)
    odds = filled.log_odds(50, others, ahead)
    assert np.array_equal(odds, -filled.misfits(50, others, ahead))
    assert odds[8:12].min() > 0 > np.median(odds)
    one = filled.misfits(50, np.array([10, 30]), np.zeros(2, bool))
    np.testing.assert_allclose(one, [here[10], filled.misfits(np.array([50]), np.array([30]), ahead[:1])[0]])
    assert filled.least_misfit(50, np.array([10]), ahead[:1]) < filled.least_misfit(
        50, np.array([30]), ahead[:1]
    )


def test_restored_state_is_the_same(filled):
    other = SignedAppearance(12)
    other.restore(filled.arrays())
    np.testing.assert_array_equal(other.metric().likeness, filled.metric().likeness)
    np.testing.assert_array_equal(other.stored(np.arange(80))[0], filled.stored(np.arange(80))[0])
