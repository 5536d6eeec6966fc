"""Spread without outliers, and runs of true values."""

from __future__ import annotations

import numpy as np
import pytest

from tactile.base.random_streams import stream
from tactile.base.samples import robust_sd, true_runs


def test_outliers_change_the_robust_spread_little() -> None:
    deviation = stream(0, "deviation").normal(0.0, [1.0, 3.0], (20_000, 2))
    assert robust_sd(deviation) == pytest.approx([1.0, 3.0], rel=0.03)
    deviation[:2000] += 1e6
    assert robust_sd(deviation) == pytest.approx([1.0, 3.0], rel=0.2)


def test_runs_are_half_open_and_reach_both_ends() -> None:
    which = np.array([1, 1, 0, 1, 0, 0, 1, 1], bool)
    assert true_runs(which).tolist() == [[0, 2], [3, 4], [6, 8]]
    assert true_runs(which[:0]).tolist() == true_runs(~which[:2]).tolist() == []
