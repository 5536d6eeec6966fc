"""Laws of the looks of frames: what fits, by what measure, and that all of it is kept."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.keyframes.appearance import (
    LOG_ODDS_INTERVAL,
    MIN_ERRORS,
    MIN_KEYFRAMES,
    NEUTRAL_IMAGE_MISFIT,
    NEUTRAL_MISFIT,
    NEW_IMAGE_LOG_ODDS,
    ConfirmedPairs,
    LabelAppearance,
    ViewAppearance,
    WhiskerAppearance,
)
from ratslam.keyframes.view_sectors import NO_ESTIMATE
from ratslam.recall.whisker_likelihood import (
    DEAD,
    HEIGHTS,
    LEVELS,
    PRIOR,
    estimate_background,
    estimate_variation,
    live_pixels,
    log_odds_table,
    pixel_layout,
    pixel_levels,
)
from tactile.base.types import Odometry, observation

SHAPE = (3, 6, 1)
PIXELS = pixel_layout(SHAPE)
SIZE = len(PIXELS.group)
TEMPER = 0.25
SILENT = SimpleNamespace(background=np.full(20, np.nan))
seeds = st.integers(0, 10_000)


def no_pairs():
    none = np.zeros(0, int)
    return ConfirmedPairs(none, none, none.astype(bool))


def seen(view=None, label=-1, dead=()):
    told = observation(Odometry(0.1, 0.0, 0.0, 1.0), view, view_shape=SHAPE, label=label, whiskers=SIZE)
    reports = np.ones(SIZE, bool)
    reports[list(dead)] = False
    return told._replace(alive=reports)


def felt(stream, count):
    """[count, 3, 6, 1] whisker images."""
    return stream.random((count, *SHAPE)) * (stream.random((count, *SHAPE)) < 0.4)


def touched(views, known=no_pairs, dead=()):
    """Frames of these images, learned from as they came."""
    looks = WhiskerAppearance(PIXELS, TEMPER)
    for view in views:
        looks.append(seen(view, dead=dead), 0.0, 0.1)
        looks.learn(SILENT, known)
    return looks


def viewed(views, errors=(), fan=None):
    looks = ViewAppearance(SIZE, fan)
    for view in views:
        looks.append(seen(view), 0.0, 0.1)
    for k in range(0, len(errors), 20):
        looks.learn(SimpleNamespace(background=np.asarray(errors[k : k + 20])), no_pairs)
    return looks


def labelled(labels):
    looks = LabelAppearance()
    for label in labels:
        looks.append(seen(label=label), 0.0, 0.1)
    return looks


def alone(near):
    return np.array([near]), np.array([False])


# Touch


def test_whiskers_are_compared_once_there_is_enough_to_learn_from():
    asked = []
    looks = WhiskerAppearance(PIXELS, TEMPER)
    for k, view in enumerate(felt(np.random.default_rng(0), 200), start=1):
        looks.append(seen(view), 0.0, 0.1)

        def known(k=k):
            asked.append(k)
            return no_pairs()

        assert looks.learn(SILENT, known) == NO_ESTIMATE
        measure = looks.metric()
        assert measure.angle == np.pi
        assert measure.scale == (NEW_IMAGE_LOG_ODDS if k >= MIN_KEYFRAMES else 0.0)
        assert measure.likeness.size == (3 * LEVELS**2 if k >= MIN_KEYFRAMES else 0)
        assert (looks.misfit(0, *alone(0)) == NEUTRAL_IMAGE_MISFIT) == (k < MIN_KEYFRAMES)
    assert asked == list(range(LOG_ODDS_INTERVAL, 201, LOG_ODDS_INTERVAL))


def test_what_is_learned_is_what_images_and_pairs_tell():
    views = felt(np.random.default_rng(0), 2 * LOG_ODDS_INTERVAL)
    frame, match = np.arange(50, 70), np.arange(10, 30)
    about = np.arange(20) % 3 == 0
    likeness = touched(views, lambda: ConfirmedPairs(frame[:0], match[:0], about[:0])).metric().likeness
    level = pixel_levels(views.reshape(len(views), -1), np.ones(SIZE)).astype(int)
    known = estimate_background(level, PIXELS.group)
    assert np.array_equal(likeness, log_odds_table(known, estimate_variation(level[:0], level[:0])))
    assert np.allclose(likeness, log_odds_table(known, PRIOR))

    then = level[match].copy()
    then[about] = then[about][:, PIXELS.opposite]
    looks = WhiskerAppearance(PIXELS, TEMPER)
    for view in views:
        looks.append(seen(view), 0.0, 0.1)
    looks.learn(SILENT, lambda: ConfirmedPairs(frame, match, about))
    assert np.array_equal(
        looks.metric().likeness, log_odds_table(known, estimate_variation(level[frame], then))
    )


@given(seeds)
@settings(max_examples=20)
def test_nothing_fits_an_image_as_the_same_one_does(seed):
    views = felt(np.random.default_rng(seed), LOG_ODDS_INTERVAL)
    views[7] = views[3]
    looks = touched(views)
    misfits = [looks.misfit(7, *alone(k)) for k in range(len(views))]
    assert misfits[3] == misfits[7] == min(misfits)
    assert all(misfit > misfits[3] for k, misfit in enumerate(misfits) if (views[k] != views[3]).any())
    assert min(misfits) >= 0


def test_the_more_pixels_differ_the_worse_it_fits():
    views = felt(np.random.default_rng(0), LOG_ODDS_INTERVAL)
    for k in range(10):
        views[k] = views[0]
        views[k].reshape(-1)[:k] = 1 - np.ceil(views[0].reshape(-1)[:k])  # touching is silent and the like
    looks = touched(views)
    misfits = [looks.misfit(0, *alone(k)) for k in range(10)]
    assert misfits == sorted(misfits)
    assert misfits[9] > 2 * misfits[0]


@given(seeds, st.lists(st.integers(0, LOG_ODDS_INTERVAL - 1), min_size=1, max_size=8))
@settings(max_examples=20)
def test_a_frame_fits_where_one_of_its_neighbours_fits(seed, near):
    stream = np.random.default_rng(seed)
    looks = touched(felt(stream, LOG_ODDS_INTERVAL))
    near, about = np.array(near), stream.random(len(near)) < 0.5
    each = [looks.misfit(5, near[k : k + 1], about[k : k + 1]) for k in range(len(near))]
    assert looks.misfit(5, near, about) == pytest.approx(min(each), rel=1e-12)


@given(seeds)
@settings(max_examples=20)
def test_a_frame_turned_about_fits_as_what_it_would_feel(seed):
    views = felt(np.random.default_rng(seed), LOG_ODDS_INTERVAL)
    views[8] = views[3].reshape(-1)[PIXELS.opposite].reshape(SHAPE)
    looks = touched(views)
    turned = looks.misfit(8, np.array([3]), np.array([True]))
    assert turned == looks.misfit(8, *alone(8))
    for k in (0, 1, 2):
        about = looks.misfit(8, np.array([k]), np.array([True]))
        there = looks.misfit(3, *alone(k))
        assert about == pytest.approx(there, rel=1e-9)  # both turned about is neither


def test_dead_whiskers_neither_fit_nor_misfit():
    stream = np.random.default_rng(0)
    dead = (1, 8, 15)
    views = felt(stream, LOG_ODDS_INTERVAL)
    other = views.copy()
    other.reshape(LOG_ODDS_INTERVAL, -1)[:, list(dead)] = stream.random((LOG_ODDS_INTERVAL, 3))
    one, two = (touched(rows, dead=dead) for rows in (views, other))
    for name, rows in one.arrays().items():
        assert np.array_equal(rows, two.arrays()[name]), name
    assert (one.arrays()["level"][:, list(dead)] == DEAD).all()
    assert np.array_equal(one.metric().likeness, two.metric().likeness)
    numb = touched(views, dead=range(SIZE))
    assert numb.misfit(5, *alone(6)) == pytest.approx(np.log(2))


@pytest.mark.parametrize("kind", ["touch", "views", "labels"])
def test_where_there_is_nothing_to_compare_with_there_is_doubt(kind):
    views = felt(np.random.default_rng(0), LOG_ODDS_INTERVAL)
    looks = {"touch": touched(views), "views": viewed(views), "labels": labelled([1] * 5)}[kind]
    none = np.zeros(0, int)
    assert looks.misfit(3, none, none.astype(bool)) == (
        NEUTRAL_IMAGE_MISFIT if isinstance(looks, WhiskerAppearance) else NEUTRAL_MISFIT
    )


def test_whiskers_that_nobody_speaks_of_report():
    plain = observation(Odometry(0.1, 0.0, 0.0, 1.0), np.ones((3, 6, 2)))
    assert plain.alive.shape == (0,)
    assert live_pixels(plain).all()
    assert live_pixels(plain).shape == (3, 6, 2)
    told = plain._replace(alive=np.arange(18) != 7)
    assert np.array_equal(np.argwhere(~live_pixels(told)), [[1, 1, 0], [1, 1, 1]])


# Views


@given(seeds)
@settings(max_examples=20)
def test_views_misfit_by_their_error_in_scales(seed):
    stream = np.random.default_rng(seed)
    views = stream.random((30, *SHAPE))
    looks = viewed(views, stream.uniform(0.1, 0.5, MIN_ERRORS))
    scale = looks.metric().scale
    assert 0.1 <= scale <= 0.2
    for frame in (0, 11, 29):
        near = stream.integers(0, 30, 4)
        errors = [np.abs(views[k] - views[frame]).mean() for k in near]
        expected = min(min(errors) / (2 * scale), 1.0)
        assert looks.misfit(frame, near, stream.random(4) < 0.5) == pytest.approx(expected, rel=1e-12)
    assert looks.misfit(11, *alone(11)) == 0


def test_a_scale_needs_enough_errors_and_grows_with_the_sensors_unit():
    errors = np.random.default_rng(0).uniform(0.1, 0.5, MIN_ERRORS)
    views = np.zeros((1, *SHAPE))
    assert viewed(views, errors[:-20]).metric().scale == 0
    scale = viewed(views, errors).metric().scale
    assert viewed(views, 2 * errors).metric().scale == 2 * scale
    half_known = np.where(np.arange(2 * MIN_ERRORS) % 2, np.nan, np.repeat(errors, 2))
    assert viewed(views, half_known).metric().scale == scale
    assert viewed(views, np.zeros(MIN_ERRORS)).metric().scale == 0


def test_views_are_kept_as_recall_compares_them():
    looks = ViewAppearance(SIZE, None, lambda view: view / 2)
    views = np.random.default_rng(0).random((3, *SHAPE))
    for view in views:
        looks.append(seen(view), 0.0, 0.1)
    assert np.array_equal(looks.arrays()["view"], views.reshape(3, -1) / 2)


def test_only_a_fan_has_an_angle():
    views = np.zeros((1, *SHAPE))
    assert viewed(views).metric().angle == 0
    assert viewed(views, fan=0.0).metric().angle == 0
    assert viewed(views, fan=3.6).metric().angle == pytest.approx(0.2)
    assert viewed(views).metric().likeness.size == 0


# Given ids


def test_ids_fit_where_they_were_given():
    looks = labelled([4, 5, 4, 6])
    assert looks.misfit(2, *alone(0)) == 0
    assert looks.misfit(2, *alone(1)) == 1
    assert looks.misfit(2, np.array([1, 3, 0]), np.zeros(3, bool)) == 0
    assert looks.metric().scale == looks.metric().angle == 0
    assert looks.learn(SILENT, no_pairs) == NO_ESTIMATE


# All


def fresh(kind):
    return {
        "touch": lambda: WhiskerAppearance(PIXELS, TEMPER),
        "views": lambda: ViewAppearance(SIZE, None),
        "fan": lambda: ViewAppearance(SIZE, 0.0),
        "labels": LabelAppearance,
    }[kind]()


@pytest.mark.parametrize("kind", ["touch", "views", "fan", "labels"])
@pytest.mark.parametrize("stop", [0, 1, 39, 40, 75])
def test_looks_that_were_kept_go_on_as_if_never_stopped(kind, stop):
    stream = np.random.default_rng(0)
    views, label = felt(stream, 120), stream.integers(0, 9, 120)
    errors = stream.uniform(0.1, 0.5, (120, 20))
    turn, pairs = (
        stream.normal(0, 0.2, 120),
        ConfirmedPairs(np.arange(20, 30), np.arange(10), np.arange(10) % 2 == 0),
    )

    def follow(looks, rows):
        told = []
        for k in rows:
            looks.append(seen(views[k], label=int(label[k])), turn[k], 0.1)
            told.append(looks.learn(SimpleNamespace(background=errors[k]), lambda: pairs))
        return told

    whole = fresh(kind)
    told = follow(whole, range(120))
    first = fresh(kind)
    assert follow(first, range(stop)) == told[:stop]
    kept = first.arrays()
    follow(first, range(stop, 100))  # what was kept is a copy
    second = fresh(kind)
    follow(second, range(5))  # and takes the place of everything
    second.restore(kept)
    assert follow(second, range(stop, 120)) == told[stop:]
    assert second.arrays().keys() == whole.arrays().keys()
    for name, rows in whole.arrays().items():
        assert np.array_equal(rows, second.arrays()[name]), name
    for one, two in zip(whole.metric(), second.metric(), strict=True):
        assert np.array_equal(one, two)
    near, about = np.arange(10), np.arange(10) % 2 == 0
    assert whole.misfit(100, near, about) == second.misfit(100, near, about)
    assert (whole.metric().likeness.size > 0) == (kind == "touch")
    assert (whole.metric().scale > 0) == (kind != "labels")


def test_a_white_pixel_is_the_tallest():
    looks = touched(np.ones((LOG_ODDS_INTERVAL, *SHAPE)))
    assert (looks.arrays()["level"] == HEIGHTS).all()
