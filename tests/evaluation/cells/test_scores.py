"""Scores of cells: lattices, information, sparsity, coherence, fields, borders, heading, and their table."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluation.cells import fields as field_maps
from evaluation.cells import grid_score as scores
from evaluation.cells import head_direction
from evaluation.cells import information as informing
from evaluation.cells.analysis import analyse_cells, write_scores
from evaluation.cells.fields import border_score, find_fields, wall_coverage, wall_distance
from evaluation.cells.grid_score import HEXAGONAL, SQUARE, autocorrelogram, lattice_scores, measure_lattice
from evaluation.cells.information import (
    information,
    information_above_mean,
    information_rate,
    selectivity,
    sparsity,
)
from evaluation.cells.rate_map import arena_edges, bin_activity, coherence, neighbour_means
from evaluation.cells.recording import CellRecording
from evaluation.papers.cells.agreement import grid_score, quiet
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tests.evaluation.cells import box_walk
from tests.evaluation.cells.box_walk import SHAPE, lattice_map, mixed_cells, mixed_maps, sheet_recording

SEEDS = st.integers(0, 10**6)
SECONDS = np.ones((20, 20))
ANGLES = 2 * np.pi * np.arange(36) / 36
WALK = box_walk.random_walk()


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


def test_flat_single_and_silent_cells_have_known_scores_and_only_neighbours_with_a_rate_count() -> None:
    """Flat at 3; 5 in one of eight bins; without activity."""
    rates = np.zeros((3, 2, 4))
    rates[0], rates[1, 0, 3] = 3.0, 5.0
    for score, expected in (
        (information, [0, 3, np.nan]),
        (information_above_mean, [0, 3, np.nan]),
        (information_rate, [0, 3 * 5 / 8, np.nan]),
        (sparsity, [1, 1 / 8, np.nan]),
        (selectivity, [1, 8, np.nan]),
        (informing.mean_rate, [3, 5 / 8, 0]),
        (head_direction.peak_rate, [3, 5, 0]),
    ):
        assert_allclose(score(rates, np.ones((2, 4))), expected, atol=1e-15)
    assert np.isnan(coherence(rates, np.ones((2, 4)))[[0, 2]]).all()
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
    assert_allclose(informing.conjunctive_information(joint, seconds), [min(alone), 0], atol=1e-12)


def blocks(*corners: tuple[int, int, int, int, float]) -> np.ndarray:
    """[1, 20, 20] rectangles (top, left, height, width, rate) on zeros."""
    rates = np.zeros((1, 20, 20))
    for top, left, height, width, rate in corners:
        rates[0, top : top + height, left : left + width] = rate
    return rates


def test_fields_of_blocks_touch_by_sides_and_not_by_corners_cells_or_bins_without_a_rate() -> None:
    """The third block of the first map is too small, the last at the very share of the peak."""
    first = blocks((2, 2, 4, 4, 1.0), (10, 10, 3, 5, 0.5), (18, 0, 2, 4, 0.9), (16, 10, 3, 3, 0.2))
    rates = np.concatenate([first, blocks(), blocks((0, 0, 20, 20, 2.0))])
    fields = find_fields(rates)
    assert fields.cell.tolist() == [0, 0, 0, 2]
    assert fields.bins.tolist() == [16, 15, 9, 400]
    assert fields.peak.tolist() == [1.0, 0.5, 0.2, 2.0]
    assert np.unique(fields.label[0]).tolist() == [0, 1, 2, 3]
    assert fields.number.tolist() == [3, 0, 1]
    assert fields.largest.tolist() == field_maps.largest_field(rates, SECONDS).tolist() == [16, 0, 400]
    with pytest.raises(InputError, match=r"\[cells, H, W\]"):
        find_fields(SECONDS)
    corner = blocks((0, 0, 3, 3, 1.0), (3, 3, 3, 3, 1.0))
    assert len(find_fields(corner).cell) == 2
    assert len(find_fields(np.concatenate([corner, corner])).cell) == 4
    assert len(find_fields(blocks((0, 0, 3, 3, 1.0), (3, 2, 3, 3, 1.0))).cell) == 1
    parted = blocks((0, 0, 5, 11, 1.0))
    parted[0, :, 5] = np.nan
    assert find_fields(parted).bins.tolist() == [25, 25]


def test_border_scores_of_blocks_and_beside_unvisited_bins() -> None:
    wall, deep = blocks((0, 0, 20, 1, 1.0)), blocks((0, 0, 20, 10, 1.0))
    score = border_score(np.concatenate([wall, deep, blocks((8, 8, 4, 4, 1.0)), blocks()]), SECONDS)
    assert_allclose(wall_distance(wall, find_fields(wall)), 2 * 1 / 20)
    assert_allclose(score[0], (1 - 0.1) / (1 + 0.1))
    assert 0 < score[1] < score[0]
    assert_allclose(score[2:], -1)
    rates = blocks((0, 0, 20, 3, 1.0))
    rates[0, 5:9, 0] = np.nan
    assert_allclose(wall_coverage(rates, find_fields(rates)), 1)
    rates[0, 12, :] = np.nan  # parts the field: 12 and 7 of the 19 lines that have a rate
    assert_allclose(wall_coverage(rates, find_fields(rates)), 12 / 19)


@pytest.mark.parametrize("turns", range(4))
def test_walls_are_alike(turns: int) -> None:
    straight = blocks((0, 0, 14, 2, 1.0), (5, 12, 4, 4, 0.8))
    rates = np.rot90(straight, turns, axes=(1, 2))
    fields = find_fields(rates)
    assert_allclose(wall_coverage(rates, fields), 14 / 20)
    assert_allclose(wall_distance(rates, fields), wall_distance(straight, find_fields(straight)))
    assert_allclose(field_maps.score_borders(rates, fields), border_score(straight, SECONDS))


@given(st.integers(0, 35), st.floats(0.1, 8.0))
def test_turning_the_curve_turns_the_direction_alone(by: int, sharpness: float) -> None:
    curve, seconds = np.exp(sharpness * (np.cos(ANGLES - 0.2) - 1))[None], np.ones(36)
    turned = np.roll(curve, by, axis=1)
    lengths = [head_direction.mean_vector_length(one, seconds) for one in (turned, curve)]
    assert_allclose(*lengths)
    moved = head_direction.preferred_direction(turned, seconds) - 0.2 - 2 * np.pi * by / 36
    assert_allclose(np.exp(1j * moved), 1, atol=1e-9)


def test_headings_without_tuning_with_one_direction_and_their_significance() -> None:
    curves = np.zeros((3, 36))
    curves[0, 9], curves[1] = 4.0, 2.0
    uneven = 1 + 10 * (ANGLES < 1.0)
    assert_allclose(head_direction.mean_vector_length(curves, uneven), [1, 0, np.nan], atol=1e-12)
    assert_allclose(head_direction.preferred_direction(curves, np.ones(36))[[0, 2]], [np.pi / 2, np.nan])
    assert_allclose(head_direction.rayleigh_p(curves[1:2], uneven), 1)
    curve, seconds = (1 + 0.3 * np.cos(ANGLES))[None], np.full(36, 2.0)
    assert_allclose(head_direction.rayleigh_z(curve, seconds), 72 * 0.15**2)
    # Zar 1999, p. 617; exp(-z) to first order in 1 / N.
    exact = np.exp(np.sqrt(1 + 4 * 72 + 4 * (72**2 - (72 * 0.15) ** 2)) - (1 + 2 * 72))
    assert_allclose(head_direction.rayleigh_p(curve, seconds), exact)
    assert_allclose(head_direction.rayleigh_p(curve, seconds), np.exp(-72 * 0.15**2), rtol=0.03)


def recording() -> CellRecording:
    activity = mixed_cells(WALK).astype(np.float32)
    return sheet_recording(WALK, np.zeros(0, int))._replace(cell=np.arange(10), activity=activity)


def test_scores_tell_the_kinds_of_cells_apart_and_are_written_exactly(tmp_path: Path) -> None:
    scores = analyse_cells(recording())
    assert scores.cell.tolist() == list(range(10))
    assert (scores.fields[:6] == 1).all()
    assert scores.information[:6].min() > 0.8
    # A von Mises curve of sharpness 4 has I1(4)/I0(4) = 0.8635.
    assert_allclose(scores.vector_length[6:8], 0.8635, atol=0.01)
    assert_allclose(scores.direction[6:8], [0.5, 4.0], atol=0.03)
    assert (scores.coherence[:6] > 1.2).all()
    assert scores.border.argmax() == 8
    assert scores.rayleigh_p[6] < 1e-9
    assert_allclose(scores.field_area[9], (arena_edges(WALK.truth, 2)[0][[0, -1]] @ [-1, 1]) ** 2, rtol=0.02)
    assert (scores.conjunctive == np.minimum(scores.information, scores.heading_information)).all()
    write_scores(tmp_path / "cells.csv", scores)
    rows = list(csv.DictReader((tmp_path / "cells.csv").read_text(encoding="utf-8").splitlines()))
    assert tuple(rows[0]) == scores._fields
    for name, column in zip(scores._fields, scores, strict=True):
        assert np.array_equal([float(row[name]) for row in rows], column, equal_nan=True)


def test_gain_turns_activity_into_spikes_and_sums_are_scored_as_time_series() -> None:
    cells, place = np.prod(SHAPE), 5 * 441 + 7 * 21 + 3
    activity = np.full((len(WALK.time), 1), 1 / cells)
    for gain, rate in ((None, 1.0), (2.5 * cells, 2.5)):
        scores = analyse_cells(recording()._replace(cell=np.array([place]), activity=activity), gain)
        assert_allclose([scores.mean_rate[0], scores.peak_rate[0], scores.heading_peak[0]], rate)
        sheet = scores.sheet_x[0], scores.sheet_y[0], scores.sheet_heading[0]
        assert_allclose(sheet, [3 * 0.05, 7 * 0.05, 5 * 2 * np.pi / 36])
    one = recording()._replace(shape=(5, 1, 2))
    sums = bin_activity(WALK.time, WALK.truth, one.activity, *arena_edges(WALK.truth))
    none = one._replace(cell=one.cell[:0], activity=one.activity[:, :0])
    chosen, whole = analyse_cells(one), analyse_cells(none._replace(sums=sums))
    for name, a, b in zip(chosen._fields, chosen, whole, strict=True):
        assert name == "speed" or np.allclose(a, b, atol=1e-12, equal_nan=True), name
    assert np.isnan(whole.speed).all()
    many = sums._replace(place=np.tile(sums.place, (30, 1, 1)), heading=np.tile(sums.heading, (30, 1)))
    again = analyse_cells(none._replace(shape=(300, 1, 1), sums=many), gain=10)
    for name in ("peak_rate", "grid", "heading_information"):
        assert_allclose(getattr(again, name), np.tile(getattr(chosen, name), 30), atol=1e-12)
    with pytest.raises(InputError, match="no cells"):
        analyse_cells(none)
    with pytest.raises(InputError, match="one column"):
        analyse_cells(one._replace(activity=one.activity[:, :5]))


@pytest.mark.parametrize("score", [information, sparsity, selectivity, coherence, head_direction.peak_rate])
def test_a_map_with_known_bins_of_its_own_is_scored_as_alone(score):
    maps = np.random.default_rng(0).random((3, 20, 20))
    maps[0, 3, 4] = maps[1, 7, :] = np.nan
    alone = [score(each[None], SECONDS)[0] for each in maps]
    assert_allclose(score(maps, SECONDS), alone, atol=1e-12)


@given(SEEDS, st.integers(0, 12))
def test_an_autocorrelogram_is_the_correlation_over_common_visited_bins(seed, holes):
    rng = np.random.default_rng(seed)
    image = rng.random((8, 9))
    image.ravel()[rng.choice(72, holes, replace=False)] = np.nan
    result = autocorrelogram(image[None])[0]
    assert result.shape == (13, 15)
    for dy, dx in ((0, 0), (1, -2), (-3, 4), (0, 5), (2, 1)):
        one = image[max(-dy, 0) : 8 - max(dy, 0), max(-dx, 0) : 9 - max(dx, 0)].ravel()
        other = image[max(dy, 0) : 8 + min(dy, 0), max(dx, 0) : 9 + min(dx, 0)].ravel()
        known = np.isfinite(one + other)
        expected = np.corrcoef(one[known], other[known])[0, 1]
        assert result[6 + dy, 7 + dx] == pytest.approx(expected, abs=1e-9)


def test_lags_with_few_common_bins_and_flat_maps_have_no_correlation_and_the_centre_a_radius():
    image = np.random.default_rng(0).random((20, 20))
    half = image.copy()
    half[:, 10:] = np.nan
    result = autocorrelogram(np.array([image, half, np.full((20, 20), 3.0), np.full((20, 20), np.nan)]))
    assert np.isfinite(result[0]).all()
    assert np.isfinite(result[1][:, 10:25]).all()
    assert np.isnan(result[1][:, [0, 34]]).all()
    assert np.isnan(result[2:]).all()
    y, x = np.mgrid[-17:18, -17:18]
    widths = np.array([1.5, 3.0, 5.0])
    radii = scores.centre_radii(np.exp(-(x**2 + y**2) / 2 / widths[:, None, None] ** 2))
    np.testing.assert_allclose(radii, np.floor(np.sqrt(2 * np.log(1 / 0.2)) * widths), atol=1)


@pytest.mark.parametrize("shape", [(20, 20), (17, 21), (12, 13)])
def test_autocorrelograms_and_grid_scores_equal_those_of_opexebo(shape):
    with quiet():
        opexebo = pytest.importorskip("opexebo")
    maps = mixed_maps(12, shape, seed=2)
    found = autocorrelogram(maps)
    expected = np.array([grid_score(opexebo, image) for image in found])
    np.testing.assert_allclose(lattice_scores(found), expected, atol=1e-6, rtol=0)
    assert np.isfinite(expected).mean() > 0.7
    maps[0, 3:6, 2] = np.nan
    theirs = np.array([opexebo.analysis.autocorrelation(image) for image in maps])
    np.testing.assert_allclose(autocorrelogram(np.nan_to_num(maps)), theirs, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("directions", "lattice", "other"), [(3, HEXAGONAL, SQUARE), (2, SQUARE, HEXAGONAL)])
@given(st.floats(7, 8), st.floats(0, np.pi))
def test_a_lattice_has_its_score_spacing_and_orientation(directions, lattice, other, spacing, turn):
    maps = autocorrelogram(lattice_map(directions, spacing, turn, (30, 30))[None])
    assert lattice_scores(maps, lattice)[0] > 1
    assert lattice_scores(maps, other)[0] < 0.5
    found, orientation = measure_lattice(maps, 0.05, lattice)
    period = np.pi / directions
    assert found[0] == pytest.approx(0.05 * spacing, rel=0.04)
    error = (orientation[0] - turn + period / 2) % period - period / 2
    assert abs(error) < np.deg2rad(3)
    assert 0 <= orientation[0] <= period


def test_each_map_is_scored_by_itself_and_one_without_a_lattice_has_neither_score_nor_spacing():
    maps = autocorrelogram(mixed_maps(300, (12, 12), seed=4))
    alone = [lattice_scores(maps[i : i + 1])[0] for i in (0, 1, 130, 299)]
    np.testing.assert_allclose(lattice_scores(maps)[[0, 1, 130, 299]], alone, atol=1e-12)
    assert lattice_scores(maps[:0]).shape == (0,)
    point, y, x = np.zeros((20, 20)), *np.mgrid[:20, :20]
    point[9, 9] = 1
    bump = np.exp(-((x - 9.0) ** 2 + (y - 9.0) ** 2) / 8)
    maps = autocorrelogram(np.array([np.full((20, 20), 2.0), point, np.full((20, 20), np.nan), bump]))
    assert np.isnan(lattice_scores(maps)[:3]).all()
    assert np.isnan(measure_lattice(maps, 0.05)).all()


@pytest.mark.parametrize(("wrong", "named"), [
    (lambda: autocorrelogram(np.zeros((20, 20))), "maps"),
    (lambda: autocorrelogram(np.zeros((3, 0, 20))), "maps"),
    (lambda: lattice_scores(np.zeros((2, 20, 21))), "odd"),
    (lambda: measure_lattice(np.zeros((2, 21, 21)), 0.0), "bin_size"),
])  # fmt: skip
def test_other_arrays_are_refused(wrong, named):
    with pytest.raises(InputError, match=named):
        wrong()
