"""Differences of views of the same place and of different places."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from evaluation.metrics.statistics import auc
from evaluation.studies.metrics import ViewDifferences, compare_views, image_difference
from tactile.base.errors import InputError

VIEWS = arrays.arrays(float, (5, 3, 6, 1), elements=st.sampled_from([0.0, 0.02, 0.5, 1.0]))
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


@given(VIEWS, VIEWS)
def test_images_differ_by_contacts_and_by_heights(a, b):
    contact, height = image_difference(a, b, 0.05)
    assert image_difference(a, a, 0.05)[0] == 0
    assert contact == image_difference(b, a, 0.05)[0] == np.mean((a > 0) != (b > 0))
    both = (a > 0) & (b > 0)
    if both.any():
        assert height == pytest.approx(0.05 * np.abs(a - b)[both].mean())
    else:
        assert np.isnan(height)


def test_only_heights_count_where_both_touch():
    a = np.zeros((1, 3, 6, 2))
    b = a.copy()
    a[0, 0, 0, 0], b[0, 0, 0, 0] = 0.4, 0.6
    a[0, 1, 0, 0] = 1.0
    b[..., 1] = 0.7  # the radial channel has no effect on contacts
    contact, height = image_difference(a, b, 0.05)
    assert contact == pytest.approx(1 / 18)
    assert height == pytest.approx(0.01)
