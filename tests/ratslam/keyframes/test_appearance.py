"""Laws of the appearance of keyframes: metric, misfit and restored state."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.backends.config import RecallBackendConfig
from ratslam.backends.recall import RecallBackend
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
    seen = observation(Odometry(0.1, 0.0, 0.0, 1.0), view, view_shape=SHAPE, label=label, whiskers=SIZE)
    reports = np.ones(SIZE, bool)
    reports[list(dead)] = False
    return seen._replace(alive=reports)


def images(stream, count):
    """[count, 3, 6, 1] whisker images."""
    return stream.random((count, *SHAPE)) * (stream.random((count, *SHAPE)) < 0.4)


def touched(views, known=no_pairs, dead=()):
    """The appearance of frames with these images, updated after each."""
    frames = WhiskerAppearance(PIXELS, TEMPER)
    for view in views:
        frames.append(seen(view, dead=dead), 0.0, 0.1)
        frames.learn(SILENT, known)
    return frames


def viewed(views, errors=(), fan=None):
    frames = ViewAppearance(SIZE, fan)
    for view in views:
        frames.append(seen(view), 0.0, 0.1)
    for k in range(0, len(errors), 20):
        frames.learn(SimpleNamespace(background=np.asarray(errors[k : k + 20])), no_pairs)
    return frames


def labelled(labels):
    frames = LabelAppearance()
    for label in labels:
        frames.append(seen(label=label), 0.0, 0.1)
    return frames


def alone(near):
    return np.array([near]), np.array([False])


# Touch


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
        assert (frames.misfit(0, *alone(0)) == NEUTRAL_IMAGE_MISFIT) == (k < MIN_KEYFRAMES)
    assert calls == list(range(LOG_ODDS_INTERVAL, 201, LOG_ODDS_INTERVAL))


def test_log_odds_follow_from_images_and_pairs():
    views = images(np.random.default_rng(0), 2 * LOG_ODDS_INTERVAL)
    frame, match = np.arange(50, 70), np.arange(10, 30)
    about = np.arange(20) % 3 == 0
    likeness = touched(views, lambda: ConfirmedPairs(frame[:0], match[:0], about[:0])).metric().likeness
    level = pixel_levels(views.reshape(len(views), -1), np.ones(SIZE)).astype(int)
    known = estimate_background(level, PIXELS.group)
    assert np.array_equal(likeness, log_odds_table(known, estimate_variation(level[:0], level[:0])))
    assert np.allclose(likeness, log_odds_table(known, PRIOR))

    then = level[match].copy()
    then[about] = then[about][:, PIXELS.opposite]
    frames = WhiskerAppearance(PIXELS, TEMPER)
    for view in views:
        frames.append(seen(view), 0.0, 0.1)
    frames.learn(SILENT, lambda: ConfirmedPairs(frame, match, about))
    assert np.array_equal(
        frames.metric().likeness, log_odds_table(known, estimate_variation(level[frame], then))
    )


@pytest.mark.parametrize("kind", ["touch", "views", "ids"])
def test_equal_views_are_likelier_of_one_place(kind):
    """The log-odds of one place fall with the unlikeness of the views, and are above 0 for equal ones."""
    stream, places = np.random.default_rng(0), np.arange(100) % 50
    views = images(stream, 50)[places]
    made = {
        "touch": lambda: touched(views),
        "views": lambda: viewed(views, errors=np.full(40, 0.1)),
        "ids": lambda: labelled(places),
    }
    frames, ahead = made[kind](), np.zeros(100, bool)
    odds = np.array([frames.log_odds(k, np.arange(100), ahead) for k in range(100)])
    same = places[:, None] == places
    assert odds[same].min() > 0
    assert odds[same].mean() > odds[~same].mean() + 0.5
    order = [frames.unlikeness(7, np.arange(100), ahead), odds[7]]
    assert (np.diff(order[1][np.argsort(order[0], kind="stable")]) <= 0).all()


@given(seeds)
@settings(max_examples=20)
def test_an_image_fits_itself_best(seed):
    views = images(np.random.default_rng(seed), LOG_ODDS_INTERVAL)
    views[7] = views[3]
    frames = touched(views)
    misfits = [frames.misfit(7, *alone(k)) for k in range(len(views))]
    assert misfits[3] == misfits[7] == min(misfits)
    assert all(misfit > misfits[3] for k, misfit in enumerate(misfits) if (views[k] != views[3]).any())
    assert min(misfits) >= 0


def test_the_misfit_grows_with_the_number_of_different_pixels():
    views = images(np.random.default_rng(0), LOG_ODDS_INTERVAL)
    for k in range(10):
        views[k] = views[0]
        views[k].reshape(-1)[:k] = 1 - np.ceil(views[0].reshape(-1)[:k])  # contact becomes silent, and so on
    frames = touched(views)
    misfits = [frames.misfit(0, *alone(k)) for k in range(10)]
    assert misfits == sorted(misfits)
    assert misfits[9] > 2 * misfits[0]


@given(seeds, st.lists(st.integers(0, LOG_ODDS_INTERVAL - 1), min_size=1, max_size=8))
@settings(max_examples=20)
def test_the_misfit_is_that_of_the_best_neighbour(seed, near):
    stream = np.random.default_rng(seed)
    frames = touched(images(stream, LOG_ODDS_INTERVAL))
    near, about = np.array(near), stream.random(len(near)) < 0.5
    each = [frames.misfit(5, near[k : k + 1], about[k : k + 1]) for k in range(len(near))]
    assert frames.misfit(5, near, about) == pytest.approx(min(each), rel=1e-12)


@given(seeds)
@settings(max_examples=20)
def test_a_reversed_frame_fits_by_its_opposite_pixels(seed):
    views = images(np.random.default_rng(seed), LOG_ODDS_INTERVAL)
    views[8] = views[3].reshape(-1)[PIXELS.opposite].reshape(SHAPE)
    frames = touched(views)
    turned = frames.misfit(8, np.array([3]), np.array([True]))
    assert turned == frames.misfit(8, *alone(8))
    for k in (0, 1, 2):
        about = frames.misfit(8, np.array([k]), np.array([True]))
        there = frames.misfit(3, *alone(k))
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
    assert numb.misfit(5, *alone(6)) == pytest.approx(np.log(2))


@pytest.mark.parametrize("kind", ["touch", "views", "labels"])
def test_without_neighbours_the_misfit_is_neutral(kind):
    views = images(np.random.default_rng(0), LOG_ODDS_INTERVAL)
    frames = {"touch": touched(views), "views": viewed(views), "labels": labelled([1] * 5)}[kind]
    none = np.zeros(0, int)
    assert frames.misfit(3, none, none.astype(bool)) == (
        NEUTRAL_IMAGE_MISFIT if isinstance(frames, WhiskerAppearance) else NEUTRAL_MISFIT
    )


def test_whiskers_without_a_flag_count_as_alive():
    plain = observation(Odometry(0.1, 0.0, 0.0, 1.0), np.ones((3, 6, 2)))
    assert plain.alive.shape == (0,)
    assert live_pixels(plain).all()
    assert live_pixels(plain).shape == (3, 6, 2)
    partial = plain._replace(alive=np.arange(18) != 7)
    assert np.array_equal(np.argwhere(~live_pixels(partial)), [[1, 1, 0], [1, 1, 1]])


# Views


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
        assert frames.misfit(frame, near, stream.random(4) < 0.5) == pytest.approx(expected, rel=1e-12)
    assert frames.misfit(11, *alone(11)) == 0


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


# Given ids


def test_ids_fit_frames_with_the_same_id():
    frames = labelled([4, 5, 4, 6])
    assert frames.misfit(2, *alone(0)) == 0
    assert frames.misfit(2, *alone(1)) == 1
    assert frames.misfit(2, np.array([1, 3, 0]), np.zeros(3, bool)) == 0
    assert frames.metric().scale == frames.metric().angle == 0
    assert frames.learn(SILENT, no_pairs) == NO_ESTIMATE


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
def test_a_restored_appearance_continues_as_if_uninterrupted(kind, stop):
    stream = np.random.default_rng(0)
    views, label = images(stream, 120), stream.integers(0, 9, 120)
    errors = stream.uniform(0.1, 0.5, (120, 20))
    turn, pairs = (
        stream.normal(0, 0.2, 120),
        ConfirmedPairs(np.arange(20, 30), np.arange(10), np.arange(10) % 2 == 0),
    )

    def follow(frames, rows):
        estimates = []
        for k in rows:
            frames.append(seen(views[k], label=int(label[k])), turn[k], 0.1)
            estimates.append(frames.learn(SimpleNamespace(background=errors[k]), lambda: pairs))
        return estimates

    whole = fresh(kind)
    estimates = follow(whole, range(120))
    first = fresh(kind)
    assert follow(first, range(stop)) == estimates[:stop]
    saved = first.arrays()
    follow(first, range(stop, 100))  # the saved arrays are copies
    second = fresh(kind)
    follow(second, range(5))  # and replace the whole state
    second.restore(saved)
    assert follow(second, range(stop, 120)) == estimates[stop:]
    assert second.arrays().keys() == whole.arrays().keys()
    for name, rows in whole.arrays().items():
        assert np.array_equal(rows, second.arrays()[name]), name
    for one, two in zip(whole.metric(), second.metric(), strict=True):
        assert np.array_equal(one, two)
    near, about = np.arange(10), np.arange(10) % 2 == 0
    assert whole.misfit(100, near, about) == second.misfit(100, near, about)
    assert (whole.metric().likeness.size > 0) == (kind == "touch")
    assert (whole.metric().scale > 0) == (kind != "labels")


def test_a_pixel_of_value_1_has_the_highest_level():
    frames = touched(np.ones((LOG_ODDS_INTERVAL, *SHAPE)))
    assert (frames.arrays()["level"] == HEIGHTS).all()


@pytest.mark.parametrize(("columns", "angle"), [(6, np.pi), (22, np.pi), (5, 0.0)])
def test_only_an_even_number_of_columns_is_compared_as_seen_from_behind(columns, angle):
    config = RecallBackendConfig.model_validate({"recall": {"sector_fov": "whiskers"}})
    assert RecallBackend(config, (4, columns, 1)).new_map().feedback().angle == angle


def test_keyframes_of_views_are_not_merged():
    config = RecallBackendConfig.model_validate({"keyframes": {"merge_stood": 4}})
    assert RecallBackend(config, SHAPE).new_map().config.merge_stood == 0
