"""The table of scores."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from evaluation.cells.analysis import analyse_cells, write_scores
from evaluation.cells.information import information
from evaluation.cells.rate_map import arena_edges, bin_activity, rate_maps
from evaluation.cells.recording import CellRecording
from tactile.base.errors import InputError
from tests.evaluation.cells.box_walk import SHAPE, mixed_cells, random_walk, sheet_recording

WALK = random_walk()


def _recording() -> CellRecording:
    activity = mixed_cells(WALK).astype(np.float32)
    return sheet_recording(WALK, np.zeros(0, int))._replace(cell=np.arange(10), activity=activity)


def test_scores_tell_the_kinds_of_cells_apart() -> None:
    scores = analyse_cells(_recording())
    assert {len(column) for column in scores} == {10}
    assert scores.cell.tolist() == list(range(10))
    assert (scores.fields[:6] == 1).all()
    assert (scores.information[:6] > 0.8).all()
    assert (scores.vector_length[6:8] > 0.8).all()
    assert (scores.heading_information[6:8] > 1).all()
    assert scores.border.argmax() == 8
    assert_allclose(scores.information[9], 0, atol=1e-12)
    assert_allclose(scores.sparsity[9], 1)
    assert scores.rayleigh_p[6] < 1e-9
    assert_allclose(scores.field_area[9], (arena_edges(WALK.truth, 2)[0][[0, -1]] @ [-1, 1]) ** 2, rtol=0.02)


def test_gain_turns_activity_into_spikes() -> None:
    activity = np.full((len(WALK.time), 1), 1 / np.prod(SHAPE))
    recording = _recording()._replace(cell=np.array([7]), activity=activity)
    for gain, rate in ((None, 1.0), (2.5 * np.prod(SHAPE), 2.5)):
        scores = analyse_cells(recording, gain)
        assert_allclose([scores.mean_rate[0], scores.peak_rate[0], scores.heading_peak[0]], rate)


def test_all_cells_from_sums_are_scored_as_from_time_series() -> None:
    recording = _recording()._replace(shape=(5, 1, 2))
    sums = bin_activity(WALK.time, WALK.truth, recording.activity, *arena_edges(WALK.truth))
    none = {"cell": recording.cell[:0], "activity": recording.activity[:, :0]}
    chosen, whole = analyse_cells(recording), analyse_cells(recording._replace(sums=sums, **none))
    for name, a, b in zip(chosen._fields, chosen, whole, strict=True):
        assert_allclose(a, b, atol=1e-12, err_msg=name)
    assert (whole.conjunctive == np.minimum(whole.information, whole.heading_information)).all()
    assert_allclose(whole.information, information(rate_maps(sums), sums.seconds), atol=1e-12)


def test_table_is_written_exactly(tmp_path: Path) -> None:
    scores = analyse_cells(_recording())
    write_scores(tmp_path / "cells.csv", scores)
    with (tmp_path / "cells.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == scores._fields
    for name, column in zip(scores._fields, scores, strict=True):
        assert np.array_equal(np.array([float(row[name]) for row in rows]), column, equal_nan=True)


def test_bad_recordings_give_one_clear_error() -> None:
    recording = _recording()
    with pytest.raises(InputError, match="no cells"):
        analyse_cells(recording._replace(cell=np.zeros(0, int), activity=np.zeros((len(WALK.time), 0))))
    with pytest.raises(InputError, match="one column"):
        analyse_cells(recording._replace(activity=recording.activity[:, :5]))
    with pytest.raises(InputError, match="no known pose"):
        analyse_cells(recording._replace(truth=np.full_like(WALK.truth, np.nan)))
