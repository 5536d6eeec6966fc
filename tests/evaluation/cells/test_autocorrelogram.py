"""The autocorrelogram: against the sum of its definition and against opexebo."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.cells.grid_score import autocorrelogram
from tactile.base.errors import InputError
from tests.evaluation.cells.lattice_maps import mixed_maps


def correlate(image: np.ndarray, lag: tuple[int, int]) -> float:
    """Pearson correlation over the common bins, bin by bin."""
    pairs = [
        (image[y, x], image[y + lag[0], x + lag[1]])
        for y, x in np.ndindex(image.shape)
        if 0 <= y + lag[0] < image.shape[0] and 0 <= x + lag[1] < image.shape[1]
    ]
    left, right = np.array([pair for pair in pairs if np.isfinite(pair).all()]).T
    return float(np.corrcoef(left, right)[0, 1])


@given(seed=st.integers(0, 10**6), holes=st.integers(0, 12))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_it_is_the_pearson_correlation_over_common_visited_bins(seed, holes):
    rng = np.random.default_rng(seed)
    image = rng.random((8, 9))
    image.ravel()[rng.choice(72, holes, replace=False)] = np.nan
    result = autocorrelogram(image[None])[0]
    assert result.shape == (13, 15)
    for lag in ((0, 0), (1, -2), (-3, 4), (0, 5), (2, 1)):
        assert result[6 + lag[0], 7 + lag[1]] == pytest.approx(correlate(image, lag), abs=1e-9)


@given(seed=st.integers(0, 10**6), scale=st.floats(1e-3, 1e3), offset=st.floats(0, 10))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_it_is_symmetric_and_independent_of_scale_and_offset(seed, scale, offset):
    maps = mixed_maps(4, (12, 10), seed)
    result = autocorrelogram(maps)
    np.testing.assert_allclose(result, result[:, ::-1, ::-1], atol=1e-9)
    np.testing.assert_allclose(result[:, result.shape[1] // 2, result.shape[2] // 2], 1, atol=1e-9)
    np.testing.assert_allclose(autocorrelogram(maps[::4] * scale + offset), result[::4], atol=1e-6)


def test_lags_with_few_common_bins_and_flat_maps_have_no_correlation():
    image = np.random.default_rng(0).random((20, 20))
    half = image.copy()
    half[:, 10:] = np.nan
    result = autocorrelogram(np.array([image, half, np.full((20, 20), 3.0), np.full((20, 20), np.nan)]))
    assert np.isfinite(result[0]).all()
    assert np.isnan(result[1][:, [0, 34]]).all()
    assert np.isfinite(result[1][:, 10:25]).all()
    assert np.isnan(result[2:]).all()


@pytest.mark.parametrize("shape", [(20, 20), (21, 17), (9, 14)])
def test_it_equals_opexebo(shape):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        opexebo = pytest.importorskip("opexebo")
    maps = mixed_maps(12, shape, seed=1)
    expected = np.array([opexebo.analysis.autocorrelation(image) for image in maps])
    np.testing.assert_allclose(autocorrelogram(maps), expected, atol=1e-6, rtol=0)
    maps[:, 3:6, 2] = np.nan
    expected = np.array([opexebo.analysis.autocorrelation(image) for image in maps])
    np.testing.assert_allclose(autocorrelogram(np.nan_to_num(maps)), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", [(20, 20), (3, 0, 20)])
def test_no_batch_of_maps_is_an_error(shape):
    with pytest.raises(InputError, match="maps"):
        autocorrelogram(np.zeros(shape))
