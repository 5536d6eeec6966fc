"""Fields and border scores of maps that are drawn by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from evaluation.cells.fields import (
    border_score,
    find_fields,
    largest_field,
    score_borders,
    wall_coverage,
    wall_distance,
)
from evaluation.cells.rate_map import rate_maps
from tactile.base.errors import InputError
from tests.evaluation.cells.box_walk import mixed_sums, random_walk

SECONDS = np.ones((20, 20))


def _blocks(*corners: tuple[int, int, int, int, float]) -> np.ndarray:
    """[1, 20, 20] rectangles (top, left, height, width, rate) on zeros."""
    rates = np.zeros((1, 20, 20))
    for top, left, height, width, rate in corners:
        rates[0, top : top + height, left : left + width] = rate
    return rates


def test_fields_of_blocks() -> None:
    rates = np.concatenate(
        [
            _blocks((2, 2, 4, 4, 1.0), (10, 10, 3, 5, 0.5), (18, 0, 2, 2, 0.9)),
            _blocks(),
            _blocks((0, 0, 20, 20, 2.0)),
        ]
    )
    fields = find_fields(rates)
    assert fields.cell.tolist() == [0, 0, 2]
    assert fields.bins.tolist() == [16, 15, 400]
    assert fields.peak.tolist() == [1.0, 0.5, 2.0]
    assert np.unique(fields.label[0]).tolist() == [0, 1, 2]
    assert fields.number.tolist() == [2, 0, 1]
    assert fields.largest.tolist() == largest_field(rates, SECONDS).tolist() == [16, 0, 400]


def test_fields_touch_by_sides_and_not_by_corners_or_cells() -> None:
    corner = _blocks((0, 0, 3, 3, 1.0), (3, 3, 3, 3, 1.0))
    assert len(find_fields(corner).cell) == 2
    assert len(find_fields(np.concatenate([corner, corner])).cell) == 4
    assert len(find_fields(_blocks((0, 0, 3, 3, 1.0), (3, 2, 3, 3, 1.0))).cell) == 1


def test_bins_without_a_rate_part_fields() -> None:
    rates = _blocks((0, 0, 5, 11, 1.0))
    rates[0, :, 5] = np.nan
    assert find_fields(rates).bins.tolist() == [25, 25]


def test_place_cells_have_one_field() -> None:
    sums = mixed_sums(random_walk())
    fields = find_fields(rate_maps(sums)[:6])
    assert fields.number.tolist() == [1] * 6
    # A fifth of a Gaussian of 0.12 m is reached at 0.2154 m; smoothing by 1.5 bins widens it.
    inside = fields.largest[1] * (sums.x_edges[1] - sums.x_edges[0]) * (sums.y_edges[1] - sums.y_edges[0])
    assert_allclose(inside, np.pi * 2 * np.log(5) * (0.12**2 + 0.075**2), rtol=0.1)


def test_border_scores_of_blocks() -> None:
    wall = _blocks((0, 0, 20, 1, 1.0))
    deep = _blocks((0, 0, 20, 10, 1.0))
    middle = _blocks((8, 8, 4, 4, 1.0))
    score = border_score(np.concatenate([wall, deep, middle, _blocks()]), SECONDS)
    assert_allclose(score[0], (1 - 0.1) / (1 + 0.1))
    assert 0 < score[1] < score[0]
    assert_allclose(score[2:], -1)


@pytest.mark.parametrize("turns", range(4))
def test_walls_are_alike(turns: int) -> None:
    straight = _blocks((0, 0, 14, 2, 1.0), (5, 12, 4, 4, 0.8))
    rates = np.rot90(straight, turns, axes=(1, 2))
    fields = find_fields(rates)
    assert_allclose(wall_coverage(rates, fields), 14 / 20)
    assert_allclose(wall_distance(rates, fields), wall_distance(straight, find_fields(straight)))
    assert_allclose(score_borders(rates, fields), border_score(straight, SECONDS))


def test_distance_counts_the_bin_beside_the_wall_as_one() -> None:
    rates = _blocks((0, 0, 20, 1, 1.0))
    assert_allclose(wall_distance(rates, find_fields(rates)), 2 * 1 / 20)


def test_unvisited_bins_beside_a_wall_are_replaced_by_the_next() -> None:
    rates = _blocks((0, 0, 20, 3, 1.0))
    rates[0, 5:9, 0] = np.nan
    assert_allclose(wall_coverage(rates, find_fields(rates)), 1)
    rates[0, 12, :] = np.nan  # parts the field: 12 and 7 of the 19 lines that have a rate
    assert_allclose(wall_coverage(rates, find_fields(rates)), 12 / 19)


def test_border_cell_of_the_walk_scores_highest() -> None:
    sums = mixed_sums(random_walk())
    score = border_score(rate_maps(sums, smoothing=0.5), sums.seconds)
    assert score.argmax() == 8
    assert score[8] > 0.6


def test_maps_have_two_axes() -> None:
    with pytest.raises(InputError, match=r"\[cells, H, W\]"):
        find_fields(np.ones((20, 20)))
