"""Decoding of position from place cells, and its control."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import gammaln, xlogy

from evaluation.cells.decoding import decode_positions, log_posterior
from evaluation.cells.recording import CellRecording
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tests.evaluation.cells.box_walk import place_cells, random_walk, sheet_recording

WALK = random_walk()


def _recording() -> CellRecording:
    centres = stream(0, "centres").random((50, 2))
    activity = place_cells(WALK.truth[:, :2], centres).astype(np.float32)
    return sheet_recording(WALK, np.zeros(0, int))._replace(cell=np.arange(50), activity=activity)


def test_place_cells_tell_the_place_to_within_a_bin() -> None:
    found = decode_positions(_recording())
    assert len(found.time) == 1200
    assert_allclose(found.time[:2], [0.225, 0.725])
    assert found.median < 0.05
    assert_allclose(found.error, np.linalg.norm(found.decoded - found.truth, axis=1))
    # Two independent points of a unit square are 0.51 m apart in the median.
    assert 0.35 < np.median(found.control) < 0.6
    assert found.control.min() > 3 * found.median


def test_scale_of_activity_does_not_matter_for_a_flat_prior() -> None:
    recording = _recording()
    scaled = recording._replace(activity=recording.activity * np.float32(1 / 1024))
    assert (decode_positions(scaled).decoded == decode_positions(recording).decoded).all()


def test_activity_without_tuning_decodes_no_better_than_its_control() -> None:
    recording = _recording()
    shuffled = stream(1, "shuffle").permutation(recording.activity)
    found = decode_positions(recording._replace(activity=shuffled))
    assert found.median > 0.3
    low, high = np.quantile(found.control, [0, 1])
    assert low - 0.05 < found.median < high + 0.05


def test_unknown_poses_are_left_out() -> None:
    recording = _recording()
    recording.truth[3000:5000] = np.nan
    found = decode_positions(recording)
    assert len(found.time) == 1000
    assert not ((found.time > 150) & (found.time < 249)).any()
    assert found.median < 0.05


def test_seed_sets_the_control_alone() -> None:
    a, b, c = (decode_positions(_recording(), shifts=5, seed=seed) for seed in (0, 0, 1))
    assert (a.control == b.control).all()
    assert (a.control != c.control).any()
    assert a.median == c.median


def test_posterior_is_that_of_poisson_cells() -> None:
    rates = stream(0, "rates").random((3, 2, 4)) + 0.1
    rates[:, 1, 3] = np.nan
    counts, seconds = np.array([[2, 0, 1], [0, 4, 0]]), np.array([0.5, 2.0])
    prior = np.log(np.arange(1.0, 9.0).reshape(2, 4) / 36)
    found = log_posterior(counts, seconds, rates, prior)
    mean = rates[None] * seconds[:, None, None, None]
    each = xlogy(counts[:, :, None, None], mean) - mean - gammaln(counts + 1.0)[:, :, None, None]
    expected = each.sum(axis=1) + prior
    known = np.isfinite(rates[0])
    assert np.isneginf(found[:, ~known]).all()
    difference = (found - expected)[:, known]
    assert_allclose(difference, difference[:, :1] * np.ones(7), atol=1e-12)


def test_short_recordings_are_refused() -> None:
    with pytest.raises(InputError, match="four blocks"):
        decode_positions(_recording(), block=200.0)
    with pytest.raises(InputError, match="no known pose"):
        decode_positions(_recording()._replace(truth=np.full_like(WALK.truth, np.nan)))
