"""Scores of cells: information, sparsity, coherence, fields, borders, heading, and their table."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluation.cells import head_direction
from evaluation.cells.analysis import analyse_cells, write_scores
from evaluation.cells.fields import (
    border_score,
    find_fields,
    largest_field,
    score_borders,
    wall_coverage,
    wall_distance,
)
from evaluation.cells.information import (
    conjunctive_information,
    information,
    information_above_mean,
    information_rate,
    mean_rate,
    selectivity,
    sparsity,
)
from evaluation.cells.rate_map import arena_edges, bin_activity, coherence, neighbour_means
from evaluation.cells.recording import CellRecording
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tests.evaluation.cells.box_walk import SHAPE, mixed_cells, random_walk, sheet_recording

SEEDS = st.integers(0, 10**6)
SECONDS = np.ones((20, 20))
ANGLES = 2 * np.pi * np.arange(36) / 36
WALK = random_walk()


def scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rates [4, 6, 7] with bins without a rate, and seconds [6, 7]."""
    draw = stream(seed, "scene")
    rates = draw.exponential(1.0, (4, 6, 7))
    rates[:, draw.random((6, 7)) < 0.2] = np.nan
    return rates, draw.exponential(2.0, (6, 7)) + 0.01


@given(SEEDS, st.floats(1e-6, 1e6))
def test_scores_do_not_depend_on_the_scale_of_rates_and_times(seed: int, scale: float) -> None:
    rates, seconds = scene(seed)
    for score in (information, information_above_mean, sparsity, selectivity, coherence):
        assert_allclose(score(rates * scale, seconds * 3), score(rates, seconds), rtol=1e-9, atol=1e-12)
    assert_allclose(information_rate(rates * scale, seconds), information_rate(rates, seconds) * scale)


def test_flat_single_and_silent_cells_have_known_scores() -> None:
    """Flat at 3; 5 in one of eight bins; without activity."""
    rates = np.zeros((3, 2, 4))
    rates[0], rates[1, 0, 3] = 3.0, 5.0
    for score, expected in (
        (information, [0, 3, np.nan]),
        (information_above_mean, [0, 3, np.nan]),
        (information_rate, [0, 3 * 5 / 8, np.nan]),
        (sparsity, [1, 1 / 8, np.nan]),
        (selectivity, [1, 8, np.nan]),
        (mean_rate, [3, 5 / 8, 0]),
        (head_direction.peak_rate, [3, 5, 0]),
    ):
        assert_allclose(score(rates, np.ones((2, 4))), expected, atol=1e-15)
    assert np.isnan(coherence(rates, np.ones((2, 4)))[[0, 2]]).all()


def test_neighbours_outside_and_without_a_rate_do_not_count() -> None:
    rates = np.arange(9.0).reshape(1, 3, 3)
    assert_allclose(neighbour_means(rates)[0, 0, 0], (1 + 3 + 4) / 3)
    rates[0, 1, 1] = np.nan
    assert_allclose(neighbour_means(rates)[0, 0, 0], (1 + 3) / 2)
    rates = scene(1)[0]
    known = np.isfinite(rates[0]) & np.isfinite(neighbour_means(rates)[0])
    correlation = np.corrcoef(rates[0][known], neighbour_means(rates)[0][known])[0, 1]
    assert_allclose(coherence(rates, np.ones((6, 7)))[0], np.arctanh(correlation))


def test_conjunctive_information_of_products_is_the_smaller_of_the_two() -> None:
    place, turn = stream(0, "place").random((5, 6)), stream(0, "turn").random(8)
    seconds = np.multiply.outer(np.ones(8), 0.5 + stream(0, "time").random((5, 6)))
    joint = np.stack([np.multiply.outer(turn, place), np.multiply.outer(np.ones(8), place)])
    alone = information(place[None], seconds[0])[0], information(turn[None], np.ones(8))[0]
    assert_allclose(conjunctive_information(joint, seconds), [min(alone), 0], atol=1e-12)


def blocks(*corners: tuple[int, int, int, int, float]) -> np.ndarray:
    """[1, 20, 20] rectangles (top, left, height, width, rate) on zeros."""
    rates = np.zeros((1, 20, 20))
    for top, left, height, width, rate in corners:
        rates[0, top : top + height, left : left + width] = rate
    return rates


def test_fields_of_blocks() -> None:
    """The third block of the first map is too small, the last at the very share of the peak."""
    first = blocks((2, 2, 4, 4, 1.0), (10, 10, 3, 5, 0.5), (18, 0, 2, 4, 0.9), (16, 10, 3, 3, 0.2))
    rates = np.concatenate([first, blocks(), blocks((0, 0, 20, 20, 2.0))])
    fields = find_fields(rates)
    assert fields.cell.tolist() == [0, 0, 0, 2]
    assert fields.bins.tolist() == [16, 15, 9, 400]
    assert fields.peak.tolist() == [1.0, 0.5, 0.2, 2.0]
    assert np.unique(fields.label[0]).tolist() == [0, 1, 2, 3]
    assert fields.number.tolist() == [3, 0, 1]
    assert fields.largest.tolist() == largest_field(rates, SECONDS).tolist() == [16, 0, 400]
    with pytest.raises(InputError, match=r"\[cells, H, W\]"):
        find_fields(SECONDS)


def test_fields_touch_by_sides_and_not_by_corners_cells_or_bins_without_a_rate() -> None:
    corner = blocks((0, 0, 3, 3, 1.0), (3, 3, 3, 3, 1.0))
    assert len(find_fields(corner).cell) == 2
    assert len(find_fields(np.concatenate([corner, corner])).cell) == 4
    assert len(find_fields(blocks((0, 0, 3, 3, 1.0), (3, 2, 3, 3, 1.0))).cell) == 1
    parted = blocks((0, 0, 5, 11, 1.0))
    parted[0, :, 5] = np.nan
    assert find_fields(parted).bins.tolist() == [25, 25]


def test_border_scores_of_blocks() -> None:
    wall, deep = blocks((0, 0, 20, 1, 1.0)), blocks((0, 0, 20, 10, 1.0))
    score = border_score(np.concatenate([wall, deep, blocks((8, 8, 4, 4, 1.0)), blocks()]), SECONDS)
    assert_allclose(wall_distance(wall, find_fields(wall)), 2 * 1 / 20)
    assert_allclose(score[0], (1 - 0.1) / (1 + 0.1))
    assert 0 < score[1] < score[0]
    assert_allclose(score[2:], -1)


@pytest.mark.parametrize("turns", range(4))
def test_walls_are_alike(turns: int) -> None:
    straight = blocks((0, 0, 14, 2, 1.0), (5, 12, 4, 4, 0.8))
    rates = np.rot90(straight, turns, axes=(1, 2))
    fields = find_fields(rates)
    assert_allclose(wall_coverage(rates, fields), 14 / 20)
    assert_allclose(wall_distance(rates, fields), wall_distance(straight, find_fields(straight)))
    assert_allclose(score_borders(rates, fields), border_score(straight, SECONDS))


def test_unvisited_bins_beside_a_wall_are_replaced_by_the_next() -> None:
    rates = blocks((0, 0, 20, 3, 1.0))
    rates[0, 5:9, 0] = np.nan
    assert_allclose(wall_coverage(rates, find_fields(rates)), 1)
    rates[0, 12, :] = np.nan  # parts the field: 12 and 7 of the 19 lines that have a rate
    assert_allclose(wall_coverage(rates, find_fields(rates)), 12 / 19)


@given(st.integers(0, 35), st.floats(0.1, 8.0))
def test_turning_the_curve_turns_the_direction_alone(by: int, sharpness: float) -> None:
    curve, seconds = np.exp(sharpness * (np.cos(ANGLES - 0.2) - 1))[None], np.ones(36)
    turned = np.roll(curve, by, axis=1)
    assert_allclose(
        head_direction.mean_vector_length(turned, seconds), head_direction.mean_vector_length(curve, seconds)
    )
    moved = head_direction.preferred_direction(turned, seconds) - 0.2 - 2 * np.pi * by / 36
    assert_allclose(np.exp(1j * moved), 1, atol=1e-9)


def test_headings_without_tuning_and_with_one_direction() -> None:
    curves = np.zeros((3, 36))
    curves[0, 9], curves[1] = 4.0, 2.0
    uneven = 1 + 10 * (ANGLES < 1.0)
    assert_allclose(head_direction.mean_vector_length(curves, uneven), [1, 0, np.nan], atol=1e-12)
    assert_allclose(head_direction.preferred_direction(curves, np.ones(36))[[0, 2]], [np.pi / 2, np.nan])
    assert_allclose(head_direction.rayleigh_p(curves[1:2], uneven), 1)


def test_rayleigh_z_is_spikes_times_squared_length() -> None:
    curve, seconds = (1 + 0.3 * np.cos(ANGLES))[None], np.full(36, 2.0)
    assert_allclose(head_direction.rayleigh_z(curve, seconds), 72 * 0.15**2)
    # Zar 1999, p. 617; exp(-z) to first order in 1 / N.
    exact = np.exp(np.sqrt(1 + 4 * 72 + 4 * (72**2 - (72 * 0.15) ** 2)) - (1 + 2 * 72))
    assert_allclose(head_direction.rayleigh_p(curve, seconds), exact)
    assert_allclose(head_direction.rayleigh_p(curve, seconds), np.exp(-72 * 0.15**2), rtol=0.03)


def recording() -> CellRecording:
    """Six place cells, two direction cells, a cell along a wall and one always active."""
    activity = mixed_cells(WALK).astype(np.float32)
    return sheet_recording(WALK, np.zeros(0, int))._replace(cell=np.arange(10), activity=activity)


def test_scores_tell_the_kinds_of_cells_apart_and_are_written_exactly(tmp_path: Path) -> None:
    scores = analyse_cells(recording())
    assert scores.cell.tolist() == list(range(10))
    assert (scores.fields[:6] == 1).all()
    assert (scores.information[:6] > 0.8).all()
    # A von Mises curve of sharpness 4 has I1(4)/I0(4) = 0.8635.
    assert_allclose(scores.vector_length[6:8], 0.8635, atol=0.01)
    assert_allclose(scores.direction[6:8], [0.5, 4.0], atol=0.03)
    assert (scores.coherence[:6] > 1.2).all()
    assert scores.border.argmax() == 8
    assert scores.rayleigh_p[6] < 1e-9
    assert_allclose(scores.field_area[9], (arena_edges(WALK.truth, 2)[0][[0, -1]] @ [-1, 1]) ** 2, rtol=0.02)
    assert (scores.conjunctive == np.minimum(scores.information, scores.heading_information)).all()
    write_scores(tmp_path / "cells.csv", scores)
    with (tmp_path / "cells.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == scores._fields
    for name, column in zip(scores._fields, scores, strict=True):
        assert np.array_equal([float(row[name]) for row in rows], column, equal_nan=True)


def test_gain_turns_activity_into_spikes() -> None:
    cells, place = np.prod(SHAPE), 5 * 441 + 7 * 21 + 3
    activity = np.full((len(WALK.time), 1), 1 / cells)
    for gain, rate in ((None, 1.0), (2.5 * cells, 2.5)):
        scores = analyse_cells(recording()._replace(cell=np.array([place]), activity=activity), gain)
        assert_allclose([scores.mean_rate[0], scores.peak_rate[0], scores.heading_peak[0]], rate)
        sheet = scores.sheet_x[0], scores.sheet_y[0], scores.sheet_heading[0]
        assert_allclose(sheet, [3 * 0.05, 7 * 0.05, 5 * 2 * np.pi / 36])


def test_all_cells_from_sums_are_scored_as_from_time_series() -> None:
    one = recording()._replace(shape=(5, 1, 2))
    sums = bin_activity(WALK.time, WALK.truth, one.activity, *arena_edges(WALK.truth))
    none = one._replace(cell=one.cell[:0], activity=one.activity[:, :0])
    chosen, whole = analyse_cells(one), analyse_cells(none._replace(sums=sums))
    for name, a, b in zip(chosen._fields, chosen, whole, strict=True):
        assert_allclose(a, b, atol=1e-12, err_msg=name)
    with pytest.raises(InputError, match="no cells"):
        analyse_cells(none)
    with pytest.raises(InputError, match="one column"):
        analyse_cells(one._replace(activity=one.activity[:, :5]))
