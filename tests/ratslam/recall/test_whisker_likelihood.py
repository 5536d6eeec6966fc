"""Laws of the likelihood of whisker images: levels, background, variation and the table of log-odds."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.recall.whisker_likelihood import (
    DEAD,
    HEIGHTS,
    LEVELS,
    PRIOR,
    Variation,
    estimate_background,
    estimate_variation,
    log_odds_table,
    pixel_layout,
    pixel_levels,
)
from tactile.whisker_geometry import HeadConfig, ur10_head

SHAPES = [(3, 6, 1), (3, 6, 2), (1, 4, 1), (2, 2, 3)]
SIZE = 18
seeds = st.integers(0, 10_000)
share = st.floats(0.001, 0.999)
visits = st.builds(Variation, share, share, st.floats(0.005, 1.0), share)


def images(seed, count=60, size=SIZE, touching=0.4, dead=0.1):
    """[count, size] levels: silent, touching and dead pixels."""
    stream = np.random.default_rng(seed)
    level = stream.integers(1, DEAD, (count, size)) * (stream.random((count, size)) < touching)
    return np.where(stream.random((count, size)) < dead, DEAD, level)


def common(seed, groups=3):
    """A possible background with rare and common heights."""
    stream = np.random.default_rng(seed)
    return stream.uniform(0.02, 0.98, groups), stream.dirichlet(np.full(HEIGHTS, 0.5), groups) + 1e-9


def of_background(known, group):
    """[DEAD] probability of each level over all places."""
    touching, heights = (each[group] for each in known)
    heights = heights / heights.sum()
    return np.concatenate([[1 - touching], touching * heights])


def visited_again(then, visits, stream):
    """[P, D] the images of the next visits, pixel by pixel as a `Variation` says."""
    heights = np.arange(1, DEAD)
    near = np.exp(-np.abs(heights[:, None] - heights) / (HEIGHTS * visits.width))
    cumulated = np.cumsum(near / near.sum(axis=0), axis=0)
    drawn = stream.random(then.shape)
    close = 1 + (drawn[..., None] > cumulated.T[np.maximum(then, 1) - 1]).sum(axis=-1)
    far = stream.integers(1, DEAD, then.shape)
    again = np.where(stream.random(then.shape) < visits.outliers, far, np.minimum(close, HEIGHTS))
    touched = np.where(stream.random(then.shape) < visits.vanishes, 0, again)
    appeared = np.where(stream.random(then.shape) < visits.appears, far, 0)
    return np.where(then == 0, appeared, touched)


# PixelLayout


@pytest.mark.parametrize("shape", SHAPES)
def test_two_half_turns_are_the_identity(shape):
    known = pixel_layout(shape)
    behind = known.opposite
    assert np.array_equal(behind[behind], np.arange(known.group.size))
    assert (behind != np.arange(known.group.size)).all()
    assert np.array_equal(known.group[behind], known.group)


@given(st.tuples(st.integers(1, 4), st.integers(1, 9), st.integers(1, 3)))
def test_pixels_of_a_ring_and_channel_are_one_group(shape):
    rows, columns, channels = shape
    known = pixel_layout(shape)
    group = known.group.reshape(shape)
    assert (group == group[:, :1]).all()
    assert len(np.unique(group)) == rows * channels == group.max() + 1
    assert np.array_equal(np.sort(known.opposite), np.arange(rows * columns * channels))
    assert np.array_equal(known.group[known.opposite], known.group)


@pytest.mark.parametrize("columns", [2, 4, 6, 8])
def test_the_opposite_pixel_is_that_of_the_opposite_whisker(columns):
    head = ur10_head(HeadConfig(whiskers=columns, first_deg=17.0))
    behind = pixel_layout((*head.shape, 1)).opposite
    assert np.allclose(head.rest[behind, :2], -head.rest[:, :2], atol=1e-12)
    assert np.allclose(head.base[behind, 2], head.base[:, 2])


# Levels


@given(st.lists(st.floats(0, 5), min_size=1, max_size=20), seeds)
def test_every_value_has_a_level(values, seed):
    view = np.array(values)
    alive = np.random.default_rng(seed).random(view.shape) < 0.7
    level = pixel_levels(view, alive)
    assert (level == np.rint(level)).all()
    assert (level[~alive] == DEAD).all()
    assert ((level[alive] > 0) == (view[alive] > 0)).all()
    assert (level[alive] <= HEIGHTS).all()
    assert (level[alive & (view >= 1)] == HEIGHTS).all()


def test_a_negative_value_is_silent():
    assert (pixel_levels(np.array([-1e-9, -0.5, -3.0]), np.ones(3)) == 0).all()


@given(st.floats(0, 1), st.floats(0, 1))
def test_levels_rise_with_the_value(low, high):
    low, high = pixel_levels(np.array(sorted([low, high])), np.ones(2))
    assert low <= high


@given(seeds)
def test_levels_are_the_same_on_the_host_and_in_the_kernel(seed):
    stream = np.random.default_rng(seed)
    view, alive = stream.random(SIZE) * (stream.random(SIZE) < 0.5), stream.random(SIZE) < 0.8
    levels = pixel_levels(jnp.asarray(view), jnp.asarray(alive, float))
    assert np.array_equal(pixel_levels(view, alive), np.asarray(levels))
    single = pixel_levels(jnp.asarray(view, jnp.float32), jnp.asarray(alive, jnp.float32))
    assert single.dtype == jnp.float32
    assert np.abs(np.asarray(single) - np.asarray(levels)).max() <= 1  # rounding, at a border between levels


# Background


def test_without_images_all_heights_are_alike():
    touching, heights = estimate_background(np.zeros((0, SIZE), int), pixel_layout((3, 6, 1)).group)
    assert np.allclose(heights, 1 / HEIGHTS)
    assert ((touching > 0) & (touching < 1)).all()


@given(seeds, st.floats(0, 1), st.floats(0, 1))
def test_the_background_is_a_distribution(seed, touching, dead):
    level = images(seed, 20, touching=touching, dead=dead)
    found, heights = estimate_background(level, pixel_layout((3, 6, 1)).group)
    assert ((found > 0) & (found < 1)).all()
    assert (heights > 0).all()
    assert np.allclose(heights.sum(axis=1), 1)


def test_the_background_is_counted_by_ring_and_channel():
    group = pixel_layout((3, 6, 1)).group
    rates = np.array([0.1, 0.5, 0.9])
    stream = np.random.default_rng(0)
    level = stream.choice([3, 20], (4000, SIZE), p=[0.25, 0.75]) * (
        stream.random((4000, SIZE)) < rates[group]
    )
    touching, heights = estimate_background(level, group)
    assert np.allclose(touching, rates, atol=0.01)
    assert np.allclose(heights[:, [2, 19]], [0.25, 0.75], atol=0.02)


@given(seeds)
def test_neither_order_nor_dead_images_matter_to_the_background(seed):
    level, group = images(seed), pixel_layout((3, 6, 1)).group
    known = estimate_background(level, group)
    shuffled = np.random.default_rng(seed).permutation(level)
    silenced = np.concatenate([shuffled, np.full((7, SIZE), DEAD)])
    for other in (shuffled, silenced):
        for one, two in zip(known, estimate_background(other, group), strict=True):
            assert np.array_equal(one, two)


# Variation


def test_without_pairs_there_is_the_prior():
    none = np.zeros((0, SIZE), int)
    assert estimate_variation(none, none) == pytest.approx(PRIOR, rel=1e-12)
    dead = np.full((50, SIZE), DEAD)
    assert estimate_variation(dead, images(0, 50)) == pytest.approx(PRIOR, rel=1e-12)
    assert estimate_variation(images(0, 50), dead) == pytest.approx(PRIOR, rel=1e-12)


KINDS = [
    Variation(0.02, 0.3, 0.03, 0.1),
    Variation(0.15, 0.05, 0.05, 0.3),
    Variation(0.3, 0.5, 0.12, 0.02),
    PRIOR,
]


@pytest.mark.parametrize("true", KINDS)
def test_many_pairs_determine_the_variation(true):
    stream = np.random.default_rng(1)
    then = images(2, 6000, touching=0.5, dead=0)
    found = estimate_variation(visited_again(then, true, stream), then)
    assert found.appears == pytest.approx(true.appears, abs=0.01)
    assert found.vanishes == pytest.approx(true.vanishes, abs=0.01)
    # Heights are limited, so that wide variations appear narrower, with some outliers.
    assert 0.65 * true.width < found.width < 1.1 * true.width
    assert found.outliers == pytest.approx(true.outliers, abs=0.12)


def test_the_estimate_grows_with_the_variation():
    then = images(2, 3000, touching=0.5, dead=0)
    for name, rates in {"width": (0.02, 0.05, 0.1, 0.2), "outliers": (0.02, 0.1, 0.3, 0.6)}.items():
        estimates = []
        for rate in rates:
            again = visited_again(then, PRIOR._replace(**{name: rate}), np.random.default_rng(1))
            estimates.append(getattr(estimate_variation(again, then), name))
        assert estimates == sorted(estimates), name


@pytest.mark.parametrize("true", KINDS[:3])
def test_the_estimate_predicts_new_visits_better_than_the_prior(true):
    stream, group = np.random.default_rng(3), pixel_layout((3, 6, 1)).group
    then = images(4, 2000, dead=0)
    now = visited_again(then, true, stream)
    seen, new = slice(1000), slice(1000, None)
    known = estimate_background(then, group)
    before, learnt = (
        log_odds_table(known, variation)[group, now[new], then[new]].sum(axis=1).mean()
        for variation in (PRIOR, estimate_variation(now[seen], then[seen]))
    )
    assert learnt > before + 0.1


def test_the_prior_loses_weight_with_more_pairs():
    then = images(0, 400, dead=0)
    found = [
        estimate_variation(then[:count], then[:count]) for count in (0, 5, 20, 100, 400)
    ]  # no visit differs
    for name in Variation._fields:
        values = [getattr(v, name) for v in found]
        assert values == sorted(values, reverse=True), name
        assert 0 < values[-1] < 0.3 * values[0], name


@given(seeds)
def test_neither_order_nor_dead_pixels_matter_to_the_variation(seed):
    stream = np.random.default_rng(seed)
    then = images(seed, 30)
    now = np.where(then == DEAD, DEAD, visited_again(np.minimum(then, HEIGHTS), PRIOR, stream))
    found = estimate_variation(now, then)
    order = stream.permutation(len(then))
    assert estimate_variation(now[order], then[order]) == pytest.approx(found, rel=1e-12)
    column = stream.permutation(SIZE)
    assert estimate_variation(now[:, column], then[:, column]) == pytest.approx(found, rel=1e-12)
    noise = images(seed + 1, 30, dead=0)
    assert estimate_variation(np.where(then == DEAD, noise, now), then) == pytest.approx(found, rel=1e-12)
    assert estimate_variation(now, np.where(now == DEAD, noise, then)) == pytest.approx(found, rel=1e-12)


@given(seeds, st.integers(0, 40))
def test_estimates_are_always_valid_variations(seed, count):
    found = estimate_variation(images(seed, count), images(seed + 1, count))
    assert np.isfinite(found).all()
    assert all(0 < value < 1 for value in found)


# The table


@given(seeds, visits)
def test_odds_follow_from_one_distribution(seed, visits):
    """Given an earlier level, the probabilities of the levels at the same place sum to 1."""
    touching, heights = common(seed)
    known = touching, heights / heights.sum(axis=1, keepdims=True)
    log = log_odds_table(known, visits)
    assert log.shape == (3, LEVELS, LEVELS)
    for group in range(3):
        again = of_background(known, group)[:, None] * np.exp(log[group, :DEAD, :DEAD])
        assert np.allclose(again.sum(axis=0), 1, rtol=1e-9)


@given(seeds, visits)
def test_odds_favour_the_true_case_on_average(seed, visits):
    """Their mean is positive for pairs of one place and negative for pairs of two."""
    touching, heights = common(seed)
    known = touching, heights / heights.sum(axis=1, keepdims=True)
    log = log_odds_table(known, visits)[:, :DEAD, :DEAD]
    for group in range(3):
        anywhere = of_background(known, group)[:, None]
        here = anywhere * np.exp(log[group])
        assert ((here * log[group]).sum(axis=0) > -1e-9).all()
        assert ((anywhere * log[group]).sum(axis=0) < 1e-9).all()


@given(seeds, visits)
def test_a_dead_pixel_carries_no_evidence(seed, visits):
    log = log_odds_table(common(seed), visits)
    assert not log[:, DEAD].any()
    assert not log[:, :, DEAD].any()
    assert np.isfinite(log).all()


@pytest.mark.parametrize("touching", [0.15, 0.4, 0.7])
def test_the_likeliest_earlier_level_is_the_present_one(touching):
    known = np.array([touching]), np.full((1, HEIGHTS), 1 / HEIGHTS)
    log = log_odds_table(known, PRIOR)[0]
    assert (log[:DEAD, :DEAD].argmax(axis=1) == np.arange(DEAD)).all()
    assert (np.diag(log)[:DEAD] > 0).all()
    assert (log[0, 1:DEAD] < 0).all()
    assert (log[1:DEAD, 0] < 0).all()


def test_heights_that_are_all_outliers_leave_only_contact():
    known = common(0)
    log = log_odds_table(known, PRIOR._replace(outliers=1.0))[:, 1:DEAD, 1:DEAD]
    expected = np.log((1 - PRIOR.vanishes) / known[0])[:, None, None]
    assert np.allclose(log, expected)


def test_a_rare_height_carries_more_evidence_than_a_common_one():
    heights = np.full(HEIGHTS, 0.2 / (HEIGHTS - 1))
    heights[25] = 0.8
    log = log_odds_table((np.array([0.4]), heights[None]), PRIOR)[0]
    assert log[6, 6] > log[26, 26]


def test_pixels_that_never_vary_carry_the_most_evidence():
    known = common(0)
    strict, loose = (log_odds_table(known, Variation(rate, rate, 0.05, rate)) for rate in (0.01, 0.2))
    level = np.arange(DEAD)
    assert (strict[:, level, level] > loose[:, level, level]).all()
    assert (strict[:, 0, 1:DEAD] < loose[:, 0, 1:DEAD]).all()
