"""Laws of the likelihood of whisker images: levels, and slow sums over the pixels for background, variation
and log-odds."""

from __future__ import annotations

import math

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

SIZE = 18
GROUP = pixel_layout((3, 6, 1)).group
seeds = st.integers(0, 10_000)
share = st.floats(0.001, 0.999)
visits = st.builds(Variation, share, share, st.floats(0.005, 1.0), share)


def images(seed, count=60, touching=0.4, dead=0.1):
    """[count, SIZE] levels: silent, touching and dead pixels."""
    stream = np.random.default_rng(seed)
    level = stream.integers(1, DEAD, (count, SIZE)) * (stream.random((count, SIZE)) < touching)
    return np.where(stream.random((count, SIZE)) < dead, DEAD, level)


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


# Pixels and levels


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


@given(st.lists(st.floats(-1, 2), min_size=1, max_size=20), seeds)
def test_levels_are_thirtieths_rounded_up_and_negative_values_are_silent(values, seed):
    view, alive = np.array(values), np.random.default_rng(seed).random(len(values)) < 0.7
    expected = [min(max(math.ceil(value * 30), 0), 30) for value in values]
    assert pixel_levels(view, alive).tolist() == np.where(alive, expected, 31).tolist()
    assert (HEIGHTS, DEAD, LEVELS) == (30, 31, 32)


@given(seeds)
def test_levels_are_the_same_on_the_host_and_in_the_kernel(seed):
    stream = np.random.default_rng(seed)
    view, alive = stream.random(SIZE) * (stream.random(SIZE) < 0.5), stream.random(SIZE) < 0.8
    levels = pixel_levels(jnp.asarray(view), jnp.asarray(alive, float))
    assert np.array_equal(pixel_levels(view, alive), np.asarray(levels))
    single = pixel_levels(jnp.asarray(view, jnp.float32), jnp.asarray(alive, jnp.float32))
    assert single.dtype == jnp.float32
    assert np.abs(np.asarray(single) - np.asarray(levels)).max() <= 1  # rounding, at a border between levels


# Slow sums


@given(seeds, st.integers(0, 20), st.floats(0, 1), st.floats(0, 1))
def test_the_background_counts_by_ring_and_channel_what_is_not_dead(seed, count, touching, dead):
    """As if there had been four more pixels, one of them in contact, and one more of each height."""
    level = images(seed, count, touching, dead)
    found = estimate_background(level, GROUP)
    for group in range(3):
        seen = [n for n in level[:, group == GROUP].ravel().tolist() if n != DEAD]
        contact = [n for n in seen if n > 0]
        assert found[0][group] == pytest.approx((len(contact) + 1) / (len(seen) + 4))
        heights = np.array([contact.count(n) + 1 for n in range(1, 31)])
        assert found[1][group] == pytest.approx(heights / (len(contact) + 30))


def variation_by_loops(now, then):
    """Shares and heights of the pixels of pairs, and of a prior of twenty half pairs; an outlier may have any
    height, others differ by an exponential distribution."""
    pixels = [
        (a, b) for a, b in zip(now.ravel().tolist(), then.ravel().tolist(), strict=True) if DEAD not in (a, b)
    ]
    weight = 20 * now.shape[1] / 2
    silent, touching = [a for a, b in pixels if b == 0], [a for a, b in pixels if b > 0]
    appears = (sum(a > 0 for a in silent) + weight * PRIOR.appears) / (len(silent) + weight)
    vanishes = (touching.count(0) + weight * PRIOR.vanishes) / (len(touching) + weight)
    apart = [abs(a - b) / 30 for a, b in pixels if a > 0 and b > 0]
    width, outliers = PRIOR.width, PRIOR.outliers
    for _ in range(20):
        loose = [
            outliers / (outliers + (1 - outliers) * math.exp(-off / width) / (2 * width)) for off in apart
        ]
        outliers = (sum(loose) + weight * PRIOR.outliers) / (len(apart) + weight)
        off = sum((1 - part) * off for part, off in zip(loose, apart, strict=True))
        width = (off + weight * PRIOR.width) / (len(apart) - sum(loose) + weight)
    return Variation(appears, vanishes, width, outliers)


@given(seeds, st.integers(0, 40), st.floats(0, 1))
def test_the_variation_is_estimated_from_pairs_and_a_prior(seed, count, dead):
    then, stream = images(seed, count, dead=dead), np.random.default_rng(seed)
    again = visited_again(np.where(then == DEAD, 0, then), PRIOR, stream)
    now = np.where(stream.random(then.shape) < 0.1, DEAD, again)
    assert estimate_variation(now, then) == pytest.approx(variation_by_loops(now, then), rel=1e-9)
    none = estimate_variation(then[:0], then[:0])
    assert none == pytest.approx(PRIOR, rel=1e-12)


@given(seeds, visits)
def test_odds_follow_from_one_distribution(seed, visits):
    """Given an earlier level, probabilities of the levels at the same place sum to 1; a dead pixel carries no
    evidence."""
    stream = np.random.default_rng(seed)
    touching, heights = stream.uniform(0.02, 0.98, 3), stream.dirichlet(np.full(HEIGHTS, 0.5), 3) + 1e-9
    heights = heights / heights.sum(axis=1, keepdims=True)
    log = log_odds_table((touching, heights), visits)
    assert log.shape == (3, LEVELS, LEVELS)
    assert not log[:, DEAD].any()
    assert not log[:, :, DEAD].any()
    near = np.array([[math.exp(-abs(a - b) / 30 / visits.width) for b in range(30)] for a in range(30)])
    near = near / near.sum(axis=0)
    for group in range(3):
        background = np.concatenate([[1 - touching[group]], touching[group] * heights[group]])
        again = background[:, None] * np.exp(log[group, :DEAD, :DEAD])
        assert np.allclose(again.sum(axis=0), 1, rtol=1e-9)
        assert again[0, 0] == pytest.approx(1 - visits.appears)
        assert again[0, 1:] == pytest.approx(np.full(30, visits.vanishes))
        mixed = (1 - visits.outliers) * near + visits.outliers * heights[group][:, None]
        assert np.allclose(again[1:, 1:], (1 - visits.vanishes) * mixed, rtol=1e-6)
        assert np.allclose(again[1:, 0], visits.appears * heights[group], rtol=1e-6)
