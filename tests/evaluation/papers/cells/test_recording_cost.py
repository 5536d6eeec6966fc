"""The table of what recording costs."""

from __future__ import annotations

import numpy as np

from evaluation.papers.cells.recording_cost import RATE, SPEED, box_walk, pack


def test_the_walk_stays_in_its_box_and_repeats_itself():
    walk, again = box_walk(0, 5000), box_walk(0, 5000)
    np.testing.assert_array_equal(walk.truth, again.truth)
    assert ((walk.truth[:, :2] > 0) & (walk.truth[:, :2] < 1)).all()
    assert np.hypot(walk.motion[:, 0], walk.motion[:, 1]).max() < 1.001 * SPEED / RATE
    assert walk.truth[:, :2].min() < 0.1
    assert walk.truth[:, :2].max() > 0.9
    assert np.isclose(walk.rate_hz, RATE)


def test_all_observations_are_packed():
    chunks = pack([sample.reading for sample in box_walk(0, 40)])
    assert [count for _, count in chunks] == [16, 16, 8]
