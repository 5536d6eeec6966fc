"""The figure of two boxes: laws of the alignment, and a short session."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.papers.cells.boxes import (
    FIGURE,
    align_maps,
    correlate_shifts,
    fit_maps,
    lay_on_torus,
    measure_boxes,
)
from evaluation.papers.cells.rat_sessions import EVERY, RatSessions, column_activity
from evaluation.papers.figure import Task

BINS = 21
CENTRES = np.random.default_rng(0).uniform(0, BINS, (40, 2))
"""Of the fields of 40 cells on the torus, bins."""


def fields(angle, shift, side=20):
    """Maps of a box turned by an angle and shifted on the torus, of cells with one field on it."""
    at = np.arange(side) - (side - 1) / 2
    x, y = np.meshgrid(at, at)
    u = np.cos(angle) * x - np.sin(angle) * y + (side - 1) / 2 + shift[0]
    v = np.sin(angle) * x + np.cos(angle) * y + (side - 1) / 2 + shift[1]
    off = np.stack([u, v], axis=-1) - CENTRES[:, None, None]
    off -= BINS * np.round(off / BINS)
    return np.exp(-(off**2).sum(axis=-1) / (2 * 2.0**2))


def test_a_map_equals_itself_without_turn_and_shift():
    maps = fields(0.0, (0, 0))
    maps[:, 3, 4] = np.nan
    angle, shift, correlation = align_maps(maps, maps, BINS, np.radians([0, 90, 180, 270]))
    assert (angle, shift) == (0.0, (0, 0))
    np.testing.assert_allclose(correlation, 1.0, atol=1e-9)


@settings(max_examples=8)
@given(st.sampled_from([0, 45, 90, 165, 270]), st.integers(0, 20), st.integers(0, 20))
def test_a_common_turn_and_shift_is_found_and_undone(degrees, x, y):
    turned = fields(np.radians(degrees), (x, y))
    angle, shift, correlation = align_maps(
        fields(0.0, (0, 0)), turned, BINS, np.radians(np.arange(0, 360, 15))
    )
    assert abs(np.degrees(angle) - degrees) <= 15
    off = (np.array(shift) - [x, y] + BINS // 2) % BINS - BINS // 2
    assert np.abs(off).max() <= 1
    assert np.nanmean(correlation) > 0.95


def test_correlations_of_shifts_are_those_of_numpy():
    rng = np.random.default_rng(1)
    first, second = rng.random((2, 3, 7, 7))
    first[:, 2, 5] = np.nan
    found = correlate_shifts(first, second)
    for y, x in ((0, 0), (3, 6)):
        moved = np.roll(second, (y, x), axis=(1, 2))
        for cell in range(3):
            known = np.isfinite(first[cell])
            expected = np.corrcoef(first[cell][known], moved[cell][known])[0, 1]
            np.testing.assert_allclose(found[cell, y, x], expected)


def test_a_flat_map_has_no_correlation():
    found = correlate_shifts(np.ones((1, 7, 7)), np.random.default_rng(2).random((1, 7, 7)))
    assert np.isnan(found).all()


def test_laying_keeps_the_bins_of_a_box_that_is_not_turned():
    maps = np.random.default_rng(3).random((2, 5, 6))
    laid = lay_on_torus(maps, 8, 0.0)
    np.testing.assert_array_equal(laid[:, :5, :6], maps)
    assert np.isnan(laid[:, 5:]).all()


def test_shuffled_identities_are_far_below_the_cells_themselves():
    fits, _, _ = fit_maps(fields(0.0, (0, 0)), fields(np.radians(75), (4, 17)), BINS)
    assert np.nanmean(fits["best"]) > 0.95
    assert abs(np.nanmean(fits["still"])) < 0.25
    assert abs(np.nanmean(fits["shuffled still"])) < 0.25
    assert np.nanmean(fits["shuffled best"]) < 0.35


def test_columns_are_places_with_headings_all_the_way_round():
    config = RatSessions.of_columns(5, 0).config
    chosen = np.array(config.cells.chosen).reshape(5, -1, 3)
    assert (chosen[..., :2] == chosen[:, :1, :2]).all()
    assert len(np.unique(chosen[:, 0, :2], axis=0)) == 5
    np.testing.assert_array_equal(chosen[0, :, 2], np.arange(0, config.pose_cells.cells_heading, EVERY))
    activity = np.arange(2.0 * chosen.shape[0] * chosen.shape[1]).reshape(2, -1)
    summed, single = column_activity(activity, 5)
    assert summed.sum() == activity.sum()
    assert set(single[0]) <= set(activity[0])
    assert single.shape == (2, 5)


@pytest.mark.soak
def test_a_short_session_gives_table_and_picture(tmp_path):
    result = measure_boxes(Task(41009, 1), seconds=12.0, columns=8)
    _, side, torus = result
    assert side < torus
    text = "\n".join(FIGURE.table(result))
    assert "A with B, best common turn and shift" in text
    FIGURE.draw(result, tmp_path / "boxes.png")
    assert (tmp_path / "boxes.png").stat().st_size > 10_000
