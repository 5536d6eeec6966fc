"""Scores of all cells of the default network: 36 x 21 x 21 cells, 20 x 20 bins of place, 36 of heading."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.cells.analysis import analyse_cells
from evaluation.cells.head_direction import mean_vector_length, preferred_direction
from evaluation.cells.information import information
from evaluation.cells.rate_map import rate_maps, tuning_curves
from evaluation.cells.recording import BinnedSums, CellRecording
from tactile.base.random_streams import stream

CELLS = 36 * 21 * 21


@pytest.fixture(scope="module")
def recording() -> CellRecording:
    """Sums of 600 s in random amounts."""
    draw = stream(0, "sums")
    seconds, held = draw.exponential(1.5, (20, 20)), draw.exponential(600 / 36, 36)
    place = draw.exponential(1 / CELLS, (CELLS, 20, 20)) * seconds
    heading = draw.exponential(1 / CELLS, (CELLS, 36)) * held
    edges, none = np.linspace(0, 1, 21), np.zeros(0)
    sums = BinnedSums(edges, edges, seconds, place.astype(np.float32), held, heading.astype(np.float32))
    return CellRecording((36, 21, 21), 0.05, none, none, none, none, none, none, none, sums)


def test_maps_information_and_tuning_of_all_cells(benchmark, recording):
    sums = recording.sums

    def score():
        maps, curves = rate_maps(sums), tuning_curves(sums)
        turn = curves, sums.heading_seconds
        return information(maps, sums.seconds), mean_vector_length(*turn), preferred_direction(*turn)

    assert all(len(column) == CELLS for column in benchmark(score))


def test_all_scores_of_all_cells(benchmark, recording):
    assert len(benchmark(analyse_cells, recording).cell) == CELLS
