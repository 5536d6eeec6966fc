"""The figure of the torus: an ideal recording, and a short session."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.cells.recording import CellRecording
from evaluation.papers.cells.torus import FIGURE, measure_cells, measure_torus
from evaluation.papers.figure import Task

RATE = 10.0


def ideal(size, torus, cells=6, steps=20_000):
    """Cells with one field of 0.1 m on a torus of a side in m, along a path without order in a box."""
    rng = np.random.default_rng(0)
    place = rng.random((steps, 2)) * size
    off = place[:, None] - rng.random((cells, 2)) * torus
    off -= torus * np.round(off / torus)
    activity = np.exp(-(off**2).sum(axis=-1) / (2 * 0.1**2)).astype(np.float32)
    return CellRecording(
        (36, 21, 21), torus / 21, np.arange(steps) / RATE, np.column_stack([place, np.zeros(steps)]),
        np.zeros((steps, 3)), np.zeros(steps), np.zeros(steps, np.int32),
        np.arange(cells, dtype=np.int32), activity, None,
    )  # fmt: skip


@pytest.mark.parametrize("torus", [0.8, 1.05])
def test_spacing_is_the_side_of_the_torus(torus):
    recording = ideal((3.5, 2.5), torus)
    found = measure_cells(recording, recording.activity, (3.5, 2.5), 0.1, 19, 0)
    np.testing.assert_allclose(found.spacing, torus, rtol=0.02)
    assert (found.square.score > 0.8).all()
    assert found.square.above.all()
    assert (found.hexagonal.score < 0.3).all()
    assert (found.fields >= 4).all()


def test_a_box_smaller_than_the_torus_holds_no_lattice():
    recording = ideal((0.4, 0.4), 1.05)
    found = measure_cells(recording, recording.activity, (0.4, 0.4), 0.05, 19, 0)
    assert (found.fields <= 1).all()
    assert np.isnan(found.spacing).all()


@pytest.mark.soak
def test_a_short_session_gives_table_and_picture(tmp_path):
    result = measure_torus(Task(41009, 1), seconds=(60.0, 45.0), columns=6, shuffles=19)
    text = "\n".join(FIGURE.table(result))
    assert "3.33 x 2.38" in text
    assert "0.67 x 0.67" in text
    FIGURE.draw(result, tmp_path / "torus.png")
    assert (tmp_path / "torus.png").stat().st_size > 10_000
