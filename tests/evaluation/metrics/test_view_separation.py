"""Differences of views of the same place and of different places."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.metrics.statistics import auc
from evaluation.metrics.view_separation import ViewDifferences, compare_views
from tactile.base.errors import InputError

VALUES = st.lists(st.integers(0, 5), min_size=1, max_size=9)


def compared(truth, views, step=10.0):
    """Views of one number each, `step` seconds apart."""

    def differences(some, others):
        return np.abs(some[:, None] - others[None])

    time = step * np.arange(len(views))
    return compare_views(views, np.asarray(truth, float), time, differences, "made up")


@given(VALUES, VALUES)
def test_auc_is_the_chance_that_views_of_other_places_differ_more(same, other):
    a, b = np.array(same, float), np.array(other, float)
    pairs = (b[None] > a[:, None]) + 0.5 * (b[None] == a[:, None])
    assert auc(a, b) == pytest.approx(pairs.mean())
    assert auc(a, b) + auc(b, a) == pytest.approx(1)


def test_pairs_are_sorted_by_true_pose_and_time():
    truth = [[0, 0, 0], [1, 0, 0], [0.04, 0, 0.2], [0, 0, 2.0], [0.2, 0, 0], [0, 0, 0]]
    found = compared(truth, np.arange(6) / 10, step=40.0)
    # same: 0-2 and 0-5 and 2-5 (15 degrees, 5 cm, 60 s apart); other: all with row 1
    assert found.same.sum() == 3
    assert found.other.sum() == 5
    late = compared(truth, np.arange(6) / 10, step=20.0)
    assert late.same.sum() == 2  # 0-2 lie only 40 s apart


def test_a_path_without_a_second_visit_has_nothing_to_compare():
    with pytest.raises(InputError, match="two visits"):
        compared([[k, 0, 0] for k in range(5)], np.arange(5.0))
    with pytest.raises(InputError, match="one place"):
        compared(np.zeros((20, 3)), np.arange(20.0))


def test_quantiles_and_shares_are_read_from_the_histograms():
    views = ViewDifferences(np.linspace(0, 1, 11), np.eye(10, dtype=int)[1] * 8, np.ones(10, int), 0.9)
    assert views.quantile(views.same, 0.5) == pytest.approx(0.15)
    assert views.share_below(views.other, 0.15) == pytest.approx(0.15)
