"""The compiled comparisons of views and poses, against NumPy."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.appearance import mean_differences, near_facing, summed_log_odds

seeds = st.integers(0, 10_000)


@given(seeds)
def test_mean_differences_are_those_of_numpy(seed):
    stream = np.random.default_rng(seed)
    views, (a, b) = stream.random((12, 5)), stream.integers(0, 12, (2, 30))
    assert np.allclose(mean_differences(views, a, b), np.abs(views[a] - views[b]).mean(axis=1), atol=1e-14)


@given(seeds)
def test_log_odds_are_summed_over_the_pixels(seed):
    stream = np.random.default_rng(seed)
    table, group = stream.normal(size=(3, 4, 4)), stream.integers(0, 3, 6)
    levels, opposite = stream.integers(0, 4, (10, 6)), stream.permutation(6)
    (a, b), reversed = stream.integers(0, 10, (2, 20)), stream.random(20) < 0.5
    other = np.where(reversed[:, None], levels[b][:, opposite], levels[b])
    expected = table[group, levels[a], other].sum(axis=1)
    assert np.allclose(summed_log_odds(table, group, levels, opposite, a, b, reversed), expected, atol=1e-12)


@given(seeds, st.integers(0, 5), st.floats(0.1, 2.0), st.floats(0.1, 0.99))
def test_near_keyframes_are_older_within_the_radius_and_face_along_one_line(seed, guard, radius, facing):
    stream = np.random.default_rng(seed)
    poses = stream.uniform(-1, 1, (15, 3)) * [1, 1, np.pi]
    frames = np.unique(stream.integers(0, 15, 8))
    found = near_facing(poses, frames, guard, radius, facing)
    for row, frame in enumerate(frames):
        for other in range(15):
            near = np.hypot(*(poses[other] - poses[frame])[:2]) < radius
            cosine = np.cos(poses[other, 2] - poses[frame, 2])
            expected = np.sign(cosine) * (other < frame - guard and near and abs(cosine) > facing)
            assert found[row, other] == expected
