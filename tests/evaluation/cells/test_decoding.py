"""Decoded places, drift of the packet and phase of the sheet, of known cells and a perfect sheet."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.special import gammaln, xlogy

from evaluation.cells import sheet_phase
from evaluation.cells.decoding import decode_positions, log_posterior, packet_drift, truth_in_sheet
from evaluation.cells.recording import CellRecording
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
from tests.evaluation.cells.box_walk import SHAPE, Walk, place_cells, random_walk, sheet_recording

WALK = random_walk()
WIDE = Walk(WALK.time, WALK.truth * np.array([1.6, 1.6, 1.0]))
CELLS = stream(0, "cells").choice(np.prod(SHAPE), 60, replace=False)
NONE = np.zeros(0, int)


def recording() -> CellRecording:
    centres = stream(0, "centres").random((50, 2))
    activity = place_cells(WALK.truth[:, :2], centres).astype(np.float32)
    return sheet_recording(WALK, NONE)._replace(cell=np.arange(50), activity=activity)


def test_place_cells_tell_the_place_to_within_a_bin() -> None:
    found = decode_positions(recording())
    assert len(found.time) == 1200
    assert_allclose(found.time[:2], [0.225, 0.725])
    assert found.median == np.median(found.error) < 0.05
    assert_allclose(found.error, np.linalg.norm(found.decoded - found.truth, axis=1))
    # Two independent points of a unit square are 0.51 m apart in the median.
    assert 0.35 < np.median(found.control) < 0.6
    assert found.control.min() > 3 * found.median


def test_unknown_poses_are_left_out_and_neither_scale_nor_seed_changes_what_is_decoded() -> None:
    one = recording()
    one.truth[3000:5000] = np.nan
    found, other = decode_positions(one), decode_positions(one, shifts=5, seed=1)
    scaled = decode_positions(one._replace(activity=one.activity * np.float32(1 / 1024)))
    assert len(found.time) == 1000
    assert not ((found.time > 150) & (found.time < 249)).any()
    assert found.median < 0.05
    assert (found.decoded == scaled.decoded).all()
    assert (found.control == scaled.control).all()
    assert (found.decoded == other.decoded).all()
    assert (other.control != found.control[:5]).any()


def test_the_posterior_is_that_of_poisson_cells() -> None:
    rates = stream(0, "rates").random((3, 2, 4)) + 0.1
    rates[:, 1, 3] = np.nan
    counts, seconds = np.array([[2, 0, 1], [0, 4, 0]]), np.array([0.5, 2.0])
    prior = np.log(np.arange(1.0, 9.0).reshape(2, 4) / 36)
    found = log_posterior(counts, seconds, rates, prior)
    mean = rates[None] * seconds[:, None, None, None]
    each = xlogy(counts[:, :, None, None], mean) - mean - gammaln(counts + 1.0)[:, :, None, None]
    known = np.isfinite(rates[0])
    assert np.isneginf(found[:, ~known]).all()
    difference = (found - each.sum(axis=1) - prior)[:, known]
    assert_allclose(difference, difference[:, :1] * np.ones(7), atol=1e-12)


def test_drift_is_followed_beyond_the_side_of_the_torus_where_the_truth_is_known() -> None:
    assert_allclose(packet_drift(sheet_recording(WIDE, NONE)), 0, atol=1e-9)
    ramp = np.linspace(0, 1, len(WIDE.time))[:, None] * np.array([3.0, -2.5, 20.0])
    assert_allclose(packet_drift(sheet_recording(WIDE, NONE, ramp)), ramp, atol=1e-9)
    one = sheet_recording(WIDE, NONE)
    one.truth[:10] = one.truth[200:400, 1] = np.nan
    known = np.isfinite(one.truth).all(axis=1, keepdims=True)
    assert_allclose(packet_drift(one), np.where(known, 0, [np.nan] * 3), atol=1e-9)


@given(st.floats(-4, 4), st.floats(-4, 4), st.floats(-7, 7))
def test_the_frame_of_the_truth_does_not_matter(x: float, y: float, turn: float) -> None:
    one = sheet_recording(Walk(WIDE.time[:500], WIDE.truth[:500]), NONE)
    elsewhere = one._replace(truth=compose(np.array([x, y, turn]), one.truth))
    assert_allclose(truth_in_sheet(elsewhere)[:, :2], truth_in_sheet(one)[:, :2], atol=1e-9)
    assert_allclose(packet_drift(elsewhere), 0, atol=1e-8)


def test_cells_of_a_perfect_sheet_fire_at_their_place_and_shuffled_ones_do_not() -> None:
    one = sheet_recording(WIDE, CELLS)
    side = one.torus_sides[:2]
    assert side == pytest.approx((1.05, 1.05))
    assert_allclose(one.packet_pose[0], truth_in_sheet(one)[0] % [*side, 2 * np.pi])
    phase = sheet_phase.map_phases(*sheet_phase.folded_maps(one))
    correlation, offset, residual = sheet_phase.compare_phases(
        sheet_phase.sheet_phases(CELLS, SHAPE), phase, side
    )
    assert (correlation > 0.98).all()
    assert (abs(offset) < 0.01).all()
    assert (residual < 0.03).all()
    other = stream(2, "shuffle").permutation(sheet_phase.sheet_phases(CELLS, SHAPE))
    correlation, _, residual = sheet_phase.compare_phases(other, phase, side)
    assert (abs(correlation) < 0.3).all()
    assert (residual > 0.2).all()


def test_phases_of_a_cell_and_of_a_map() -> None:
    """Cells are in the order heading, y, x; a silent one has no phase."""
    cell = np.array([5 * 21 * 21 + 7 * 21 + 3])
    assert_allclose(sheet_phase.sheet_phases(cell, SHAPE), 2 * np.pi * np.array([[3 / 21, 7 / 21]]))
    rates = np.zeros((2, 5, 5))
    rates[1, 2, 1] = 1.0
    phase = sheet_phase.map_phases(rates, np.ones((5, 5)))
    assert_allclose(phase, 2 * np.pi * np.array([[np.nan, np.nan], [0.2, 0.4]]))


@given(st.integers(0, 1000), st.floats(-7, 7))
def test_circular_correlation_is_the_sum_over_pairs(seed: int, offset: float) -> None:
    a, b = stream(seed, "angles").uniform(0, 2 * np.pi, (2, 12))
    pair_a, pair_b = (np.sin(each[:, None] - each) for each in (a, b))
    pairs = (pair_a * pair_b).sum() / np.sqrt((pair_a**2).sum() * (pair_b**2).sum())
    assert_allclose(sheet_phase.circular_correlation(a, b), pairs, atol=1e-9)
    assert_allclose(sheet_phase.circular_correlation(a, a + offset), 1, atol=1e-9)
    assert_allclose(sheet_phase.circular_correlation(a, offset - a), -1, atol=1e-9)


def test_unfit_recordings_are_refused() -> None:
    one = sheet_recording(WIDE, NONE)
    with pytest.raises(InputError, match="four blocks"):
        decode_positions(recording(), block=200.0)
    with pytest.raises(InputError, match="no known pose"):
        packet_drift(one._replace(truth=np.full_like(one.truth, np.nan)))
    with pytest.raises(InputError, match="equal lengths"):
        packet_drift(one._replace(packet=one.packet[:-1]))
    with pytest.raises(InputError, match="equal lengths"):
        sheet_phase.folded_maps(one._replace(activity=one.activity[:-1]))
