"""The plot of error against time: label positions and extreme values."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.studies.study_report import ParetoPoint, draw_pareto, place_labels


@given(
    st.lists(
        st.tuples(st.integers(10, 90), st.integers(8, 14), st.integers(0, 600), st.integers(0, 400)),
        min_size=1,
        max_size=15,
    )
)
@settings(max_examples=10)
def test_labels_neither_overlap_nor_cover_blocked_boxes(rows):
    rows = np.array(rows, float)
    area, blocked = np.array([0.0, 0.0, 600.0, 400.0]), np.array([[100.0, 100.0, 140.0, 400.0]])
    corners = place_labels(rows[:, :2], rows[:, 2:], area, blocked, blocked + 50)
    boxes = np.concatenate([np.concatenate([corners, corners + rows[:, :2]], axis=1), blocked])
    assert (boxes[:, :2] >= area[:2]).all()
    assert (boxes[:, 2:] <= area[2:]).all()
    for k, one in enumerate(boxes):
        for other in boxes[k + 1 :]:
            assert (one[2:] <= other[:2]).any() or (other[2:] <= one[:2]).any()


def test_labels_without_room_still_get_a_position():
    corners = place_labels(
        np.full((4, 2), 50.0), np.zeros((4, 2)), np.array([0.0, 0.0, 60.0, 60.0]), *[np.zeros((0, 4))] * 2
    )
    assert np.isfinite(corners).all()


@pytest.mark.parametrize("values", [[0.0, 0.0], [0.0, 0.2], [0.1, 0.1], [1e-9, 3e4]])
def test_extreme_errors_are_drawn_with_equal_bytes(values):
    marks = [
        ParetoPoint(f"row {k}", (90.0, 100.0, 110.0), (v, v, 2 * v), k == 0) for k, v in enumerate(values)
    ]

    def drawn():
        buffer = io.BytesIO()
        figure = draw_pareto("a", "b", marks, "time", "error")
        figure.savefig(buffer)
        assert [text.get_text() for text in figure.axes[0].texts if text.get_text()] == ["row 0", "row 1"]
        return buffer.getvalue()

    assert drawn() == drawn()
