"""Laws of whisker images of keyframes: log-odds, misfits, dead whiskers, frames seen from behind."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.appearance import (
    LOG_ODDS_INTERVAL,
    MIN_KEYFRAMES,
    NEUTRAL_IMAGE_MISFIT,
    NEW_IMAGE_LOG_ODDS,
    WhiskerAppearance,
)
from ratslam.mapping.odometry_calibration import NO_ESTIMATE
from ratslam.methods.config import RecallBackendConfig
from ratslam.methods.recall import RecallBackend
from ratslam.recall.whisker_likelihood import (
    DEAD,
    HEIGHTS,
    LEVELS,
    PRIOR,
    estimate_background,
    estimate_variation,
    live_pixels,
    log_odds_table,
    pixel_levels,
)
from tactile.base.types import Odometry, observation
from tests.ratslam.mapping.appearance_cases import (
    PIXELS,
    SHAPE,
    SILENT,
    SIZE,
    TEMPER,
    alone,
    images,
    no_pairs,
    seeds,
    seen,
    touched,
)


def test_whiskers_are_compared_after_the_first_estimate():
    calls = []
    frames = WhiskerAppearance(PIXELS, TEMPER)
    for k, view in enumerate(images(np.random.default_rng(0), 200), start=1):
        frames.append(seen(view), 0.0, 0.1)

        def known(k=k):
            calls.append(k)
            return no_pairs()

        assert frames.learn(SILENT, known) == NO_ESTIMATE
        measure = frames.metric()
        assert measure.angle == np.pi
        assert measure.scale == (NEW_IMAGE_LOG_ODDS if k >= MIN_KEYFRAMES else 0.0)
        assert measure.likeness.size == (3 * LEVELS**2 if k >= MIN_KEYFRAMES else 0)
        assert (frames.least_misfit(0, *alone(0)) == NEUTRAL_IMAGE_MISFIT) == (k < MIN_KEYFRAMES)
    assert calls == list(range(LOG_ODDS_INTERVAL, 201, LOG_ODDS_INTERVAL))


def test_log_odds_follow_from_images_and_pairs():
    views = images(np.random.default_rng(0), 2 * LOG_ODDS_INTERVAL)
    frame, match = np.arange(50, 70), np.arange(10, 30)
    about = np.arange(20) % 3 == 0
    likeness = touched(views, lambda: np.zeros((0, 3), int)).metric().likeness
    level = pixel_levels(views.reshape(len(views), -1), np.ones(SIZE)).astype(int)
    known = estimate_background(level, PIXELS.group)
    assert np.array_equal(likeness, log_odds_table(known, estimate_variation(level[:0], level[:0])))
    assert np.allclose(likeness, log_odds_table(known, PRIOR))

    then = level[match].copy()
    then[about] = then[about][:, PIXELS.opposite]
    frames = WhiskerAppearance(PIXELS, TEMPER)
    for view in views:
        frames.append(seen(view), 0.0, 0.1)
    frames.learn(SILENT, lambda: np.column_stack([frame, match, about]))
    assert np.array_equal(
        frames.metric().likeness, log_odds_table(known, estimate_variation(level[frame], then))
    )


@given(seeds)
@settings(max_examples=20)
def test_an_image_fits_itself_best(seed):
    views = images(np.random.default_rng(seed), LOG_ODDS_INTERVAL)
    views[7] = views[3]
    frames = touched(views)
    misfits = [frames.least_misfit(7, *alone(k)) for k in range(len(views))]
    assert misfits[3] == misfits[7] == min(misfits)
    assert all(misfit > misfits[3] for k, misfit in enumerate(misfits) if (views[k] != views[3]).any())
    assert min(misfits) >= 0


def test_the_misfit_grows_with_the_number_of_different_pixels():
    views = images(np.random.default_rng(0), LOG_ODDS_INTERVAL)
    for k in range(10):
        views[k] = views[0]
        views[k].reshape(-1)[:k] = 1 - np.ceil(views[0].reshape(-1)[:k])  # contact becomes silent, and so on
    frames = touched(views)
    misfits = [frames.least_misfit(0, *alone(k)) for k in range(10)]
    assert misfits == sorted(misfits)
    assert misfits[9] > 2 * misfits[0]


@given(seeds, st.lists(st.integers(0, LOG_ODDS_INTERVAL - 1), min_size=1, max_size=8))
@settings(max_examples=20)
def test_the_misfit_is_that_of_the_best_neighbour(seed, near):
    stream = np.random.default_rng(seed)
    frames = touched(images(stream, LOG_ODDS_INTERVAL))
    near, about = np.array(near), stream.random(len(near)) < 0.5
    each = [frames.least_misfit(5, near[k : k + 1], about[k : k + 1]) for k in range(len(near))]
    assert frames.least_misfit(5, near, about) == pytest.approx(min(each), rel=1e-12)


@given(seeds)
@settings(max_examples=20)
def test_a_reversed_frame_fits_by_its_opposite_pixels(seed):
    views = images(np.random.default_rng(seed), LOG_ODDS_INTERVAL)
    views[8] = views[3].reshape(-1)[PIXELS.opposite].reshape(SHAPE)
    frames = touched(views)
    turned = frames.least_misfit(8, np.array([3]), np.array([True]))
    assert turned == frames.least_misfit(8, *alone(8))
    for k in (0, 1, 2):
        about = frames.least_misfit(8, np.array([k]), np.array([True]))
        there = frames.least_misfit(3, *alone(k))
        assert about == pytest.approx(there, rel=1e-9)  # two half turns are none


def test_dead_whiskers_neither_fit_nor_misfit():
    stream = np.random.default_rng(0)
    dead = (1, 8, 15)
    views = images(stream, LOG_ODDS_INTERVAL)
    other = views.copy()
    other.reshape(LOG_ODDS_INTERVAL, -1)[:, list(dead)] = stream.random((LOG_ODDS_INTERVAL, 3))
    one, two = (touched(rows, dead=dead) for rows in (views, other))
    for name, rows in one.arrays().items():
        assert np.array_equal(rows, two.arrays()[name]), name
    assert (one.arrays()["level"][:, list(dead)] == DEAD).all()
    assert np.array_equal(one.metric().likeness, two.metric().likeness)
    numb = touched(views, dead=range(SIZE))
    assert numb.least_misfit(5, *alone(6)) == pytest.approx(np.log(2))


def test_whiskers_without_a_flag_count_as_alive():
    plain = observation(Odometry(0.1, 0.0, 0.0, 1.0), np.ones((3, 6, 2)))
    assert plain.alive.shape == (0,)
    assert live_pixels(plain).all()
    assert live_pixels(plain).shape == (3, 6, 2)
    partial = plain._replace(alive=np.arange(18) != 7)
    assert np.array_equal(np.argwhere(~live_pixels(partial)), [[1, 1, 0], [1, 1, 1]])


def test_a_pixel_of_value_1_has_the_highest_level():
    frames = touched(np.ones((LOG_ODDS_INTERVAL, *SHAPE)))
    assert (frames.arrays()["level"] == HEIGHTS).all()


@pytest.mark.parametrize(("columns", "angle"), [(6, np.pi), (22, np.pi), (5, 0.0)])
def test_only_an_even_number_of_columns_is_compared_as_seen_from_behind(columns, angle):
    config = RecallBackendConfig.model_validate({"recall": {"sector_fov": "whiskers"}})
    assert RecallBackend(config, (4, columns, 1)).new_map().feedback().angle == angle
