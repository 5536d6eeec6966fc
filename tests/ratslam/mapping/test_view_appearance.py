"""Laws of views of keyframes: misfits in scales, stored views, sectors, no merging."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings

from ratslam.mapping.appearance import MIN_ERRORS, ViewAppearance
from tests.ratslam.mapping.appearance_cases import SHAPE, SIZE, alone, seeds, seen, viewed


@given(seeds)
@settings(max_examples=20)
def test_views_misfit_by_their_error_in_scales(seed):
    stream = np.random.default_rng(seed)
    views = stream.random((30, *SHAPE))
    frames = viewed(views, stream.uniform(0.1, 0.5, MIN_ERRORS))
    scale = frames.metric().scale
    assert 0.1 <= scale <= 0.2
    for frame in (0, 11, 29):
        near = stream.integers(0, 30, 4)
        errors = [np.abs(views[k] - views[frame]).mean() for k in near]
        expected = min(min(errors) / (2 * scale), 1.0)
        assert frames.least_misfit(frame, near, stream.random(4) < 0.5) == pytest.approx(expected, rel=1e-12)
    assert frames.least_misfit(11, *alone(11)) == 0


def test_a_scale_needs_enough_errors_and_grows_with_the_sensors_unit():
    errors = np.random.default_rng(0).uniform(0.1, 0.5, MIN_ERRORS)
    views = np.zeros((1, *SHAPE))
    assert viewed(views, errors[:-20]).metric().scale == 0
    scale = viewed(views, errors).metric().scale
    assert viewed(views, 2 * errors).metric().scale == 2 * scale
    half_known = np.where(np.arange(2 * MIN_ERRORS) % 2, np.nan, np.repeat(errors, 2))
    assert viewed(views, half_known).metric().scale == scale
    assert viewed(views, np.zeros(MIN_ERRORS)).metric().scale == 0


def test_views_are_stored_as_recall_compares_them():
    frames = ViewAppearance(SIZE, None, lambda view: view / 2)
    views = np.random.default_rng(0).random((3, *SHAPE))
    for view in views:
        frames.append(seen(view), 0.0, 0.1)
    assert np.array_equal(frames.arrays()["view"], views.reshape(3, -1) / 2)


def test_only_ordered_sectors_have_an_angle():
    views = np.zeros((1, *SHAPE))
    assert viewed(views).metric().angle == 0
    assert viewed(views, fan=0.0).metric().angle == 0
    assert viewed(views, fan=3.6).metric().angle == pytest.approx(0.2)
    assert viewed(views).metric().likeness.size == 0
