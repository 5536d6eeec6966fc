"""Laws of every kind of appearance of keyframes: odds of equal views, no neighbours, restored state."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ratslam.mapping.appearance import (
    LOG_ODDS_INTERVAL,
    NEUTRAL_IMAGE_MISFIT,
    NEUTRAL_MISFIT,
    LabelAppearance,
    ViewAppearance,
    WhiskerAppearance,
)
from ratslam.mapping.ground import learn_gain_odds
from ratslam.recall.observation_model import label_gains
from tests.ratslam.mapping.appearance_cases import (
    PIXELS,
    SIZE,
    TEMPER,
    images,
    labelled,
    seen,
    touched,
    viewed,
)


@pytest.mark.parametrize("kind", ["touch", "views", "ids"])
def test_equal_views_are_likelier_of_one_place(kind):
    """The log-odds of one place fall with the misfits of the views, and are above 0 for equal ones."""
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
    order = [frames.misfits(7, np.arange(100), ahead), odds[7]]
    assert (np.diff(order[1][np.argsort(order[0], kind="stable")]) <= 0).all()


def test_an_id_tells_a_true_pose_from_a_false_one_before_any_was_counted():
    usual = ((2.0, 1.0), (0.5, 1.0))
    assert viewed(images(np.random.default_rng(0), 50)).gain_prior(usual) == usual
    for count in (3, 30, 300):
        prior = labelled(range(count)).gain_prior(usual)
        (true, _), (false, _) = prior
        assert (true, false) == label_gains(count)
        odds, none = learn_gain_odds(np.zeros(0), np.zeros(0), prior), np.zeros(0)
        assert odds.of(true) > 2 > -2 > odds.of(false)
        assert odds.expected > 2 > learn_gain_odds(none, none, usual).expected


@pytest.mark.parametrize("kind", ["touch", "views", "labels"])
def test_without_neighbours_the_misfit_is_neutral(kind):
    views = images(np.random.default_rng(0), LOG_ODDS_INTERVAL)
    frames = {"touch": touched(views), "views": viewed(views), "labels": labelled([1] * 5)}[kind]
    none = np.zeros(0, int)
    assert frames.least_misfit(3, none, none.astype(bool)) == (
        NEUTRAL_IMAGE_MISFIT if isinstance(frames, WhiskerAppearance) else NEUTRAL_MISFIT
    )


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
        np.column_stack([np.arange(20, 30), np.arange(10), np.arange(10) % 2 == 0]),
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
    assert whole.least_misfit(100, near, about) == second.least_misfit(100, near, about)
    assert (whole.metric().likeness.size > 0) == (kind == "touch")
    assert (whole.metric().scale > 0) == (kind != "labels")
