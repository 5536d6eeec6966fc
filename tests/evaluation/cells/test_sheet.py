"""Drift of the packet and phase of the sheet, for a perfect sheet and known errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluation.cells.decoding import packet_drift, truth_in_sheet
from evaluation.cells.sheet_phase import (
    circular_correlation,
    compare_phases,
    folded_maps,
    map_phases,
    sheet_phases,
)
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
from tests.evaluation.cells.box_walk import CELL_SIZE, SHAPE, Walk, random_walk, sheet_recording

CELLS = stream(0, "cells").choice(np.prod(SHAPE), 60, replace=False)
WALK = random_walk()
WIDE = Walk(WALK.time, WALK.truth * np.array([1.6, 1.6, 1.0]))
NONE = np.zeros(0, int)


def test_perfect_packet_does_not_drift() -> None:
    drift = packet_drift(sheet_recording(WIDE, NONE))
    assert_allclose(drift, 0, atol=1e-9)


def test_drift_is_followed_beyond_the_side_of_the_torus() -> None:
    ramp = np.linspace(0, 1, len(WIDE.time))[:, None] * np.array([3.0, -2.5, 20.0])
    drift = packet_drift(sheet_recording(WIDE, NONE, ramp))
    assert_allclose(drift, ramp, atol=1e-9)


@settings(derandomize=True, max_examples=20, deadline=None)
@given(st.floats(-4, 4), st.floats(-4, 4), st.floats(-7, 7))
def test_frame_of_the_truth_does_not_matter(x: float, y: float, turn: float) -> None:
    recording = sheet_recording(Walk(WIDE.time[:500], WIDE.truth[:500]), NONE)
    elsewhere = recording._replace(truth=compose(np.array([x, y, turn]), recording.truth))
    assert_allclose(truth_in_sheet(elsewhere)[:, :2], truth_in_sheet(recording)[:, :2], atol=1e-9)
    assert_allclose(packet_drift(elsewhere), 0, atol=1e-8)


def test_drift_is_unknown_where_the_truth_is() -> None:
    recording = sheet_recording(WIDE, NONE)
    recording.truth[:10] = recording.truth[200:400] = np.nan
    drift = packet_drift(recording)
    assert (np.isnan(drift).any(axis=1) == np.isnan(recording.truth).any(axis=1)).all()
    assert_allclose(drift[np.isfinite(drift)], 0, atol=1e-9)


def test_bad_recordings_give_one_clear_error() -> None:
    recording = sheet_recording(WIDE, NONE)
    with pytest.raises(InputError, match="no known pose"):
        packet_drift(recording._replace(truth=np.full_like(recording.truth, np.nan)))
    with pytest.raises(InputError, match="equal lengths"):
        packet_drift(recording._replace(packet=recording.packet[:-1]))
    with pytest.raises(InputError, match="equal lengths"):
        folded_maps(recording._replace(activity=recording.activity[:-1]))


def test_cells_of_a_perfect_sheet_fire_at_their_place() -> None:
    recording = sheet_recording(WIDE, CELLS)
    side = recording.torus_sides[:2]
    assert side == pytest.approx((1.05, 1.05))
    assert_allclose(recording.packet_pose[0], truth_in_sheet(recording)[0] % [*side, 2 * np.pi])
    correlation, offset, residual = compare_phases(
        sheet_phases(CELLS, SHAPE), map_phases(*folded_maps(recording)), side
    )
    assert (correlation > 0.98).all()
    assert (abs(offset) < 0.01).all()
    assert (residual < 0.03).all()


def test_shuffled_cells_have_no_phase() -> None:
    recording = sheet_recording(WIDE, CELLS)
    phase = map_phases(*folded_maps(recording))
    other = stream(2, "shuffle").permutation(sheet_phases(CELLS, SHAPE))
    correlation, _, residual = compare_phases(other, phase, recording.torus_sides[:2])
    assert (abs(correlation) < 0.3).all()
    assert (residual > 0.2).all()


def test_index_order_is_heading_y_x() -> None:
    cell = np.array([5 * 21 * 21 + 7 * 21 + 3])
    assert_allclose(sheet_phases(cell, SHAPE), 2 * np.pi * np.array([[3 / 21, 7 / 21]]))
    assert pytest.approx(1.05) == CELL_SIZE * 21


def test_silent_cells_do_not_count() -> None:
    rates = np.zeros((2, 5, 5))
    rates[1, 2, 1] = 1.0
    phase = map_phases(rates, np.ones((5, 5)))
    assert np.isnan(phase[0]).all()
    assert_allclose(phase[1], 2 * np.pi * np.array([0.2, 0.4]))


@settings(derandomize=True, max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(-7, 7))
def test_circular_correlation_is_the_sum_over_pairs(seed: int, offset: float) -> None:
    a, b = stream(seed, "angles").uniform(0, 2 * np.pi, (2, 12))
    pair_a, pair_b = (np.sin(each[:, None] - each) for each in (a, b))
    pairs = (pair_a * pair_b).sum() / np.sqrt((pair_a**2).sum() * (pair_b**2).sum())
    assert_allclose(circular_correlation(a, b), pairs, atol=1e-9)
    assert_allclose(circular_correlation(a, a + offset), 1, atol=1e-9)
    assert_allclose(circular_correlation(a, offset - a), -1, atol=1e-9)
