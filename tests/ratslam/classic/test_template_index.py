"""Laws of the template index: it says what comparing with every view says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam import templateindex
from ratslam.templateindex import RATIO, TAIL, TIE, Nearest, TemplateIndex


def plainly(views, view, threshold):
    """The answer by comparing with all views [N, D]."""
    if len(views) == 0:
        return Nearest(-1, np.inf)
    errors = np.abs(views - view).mean(axis=1)
    best = errors.min()
    if best > threshold + TIE:
        return Nearest(-1, np.inf)
    return Nearest(int(np.flatnonzero(errors <= best + TIE)[0]), best)


def agree(index, views, view):
    found, expected = index.query(view), plainly(views, view, index.threshold)
    assert found.template == expected.template
    assert found.error == pytest.approx(expected.error, rel=1e-12, abs=1e-14)
    return found.template >= 0


@pytest.fixture
def short_tail(monkeypatch):
    """Trees from the third view on."""
    monkeypatch.setattr(templateindex, "TAIL", 3)


values = st.sampled_from([0.0, 0.1, 0.2, 0.5, 0.5 + 1e-13, 1.0])


@pytest.mark.usefixtures("short_tail")
@given(
    st.integers(1, 4).flatmap(
        lambda size: st.lists(st.lists(values, min_size=size, max_size=size), min_size=1, max_size=60)
    ),
    st.sampled_from([0.0, 0.025, 0.05, 0.1, 0.3, 1.0]),
)
@settings(max_examples=150)
def test_every_answer_is_that_of_comparing_with_all(views, threshold):
    """Few values, so that ties and differences of just the threshold are the rule."""
    views = np.array(views)
    index = TemplateIndex(views.shape[1], threshold)
    for count, view in enumerate(views):
        agree(index, views[:count], view)
        assert index.append(view) == count
    for view in views:
        agree(index, views, view)
        agree(index, views, view[::-1])


@pytest.mark.parametrize("threshold", [0.01, 0.05, 0.15])
def test_thousands_of_views(threshold):
    stream = np.random.default_rng(0)
    views = stream.random((3000, 18))
    index = TemplateIndex(18, threshold)
    index.extend(views[:1500])
    for view in views[1500:]:
        index.append(view)
    matched = 0
    for k in range(300):
        moved = stream.uniform(-2, 2, 18) * threshold * stream.random()
        matched += agree(index, views, views[stream.integers(len(views))] + moved)
        agree(index, views, stream.random(18))
        agree(index, views, views[k])
    assert 100 < matched < 300


def test_just_the_threshold_matches_and_a_trace_more_does_not():
    for many in (0, 2 * TAIL):
        index = TemplateIndex(2, 0.25)
        index.append([0.0, 0.0])
        index.extend(np.full((many, 2), 9.0))
        assert index.query([0.5, 0.0]) == (0, 0.25)
        assert index.query([0.0, 0.5 + 1e-6]) == (-1, np.inf)
        for beyond in (0.5, 0.9, 1.1, 1.5, 1.9, 2.1, 2.9, 3.1):
            view = np.array([0.0, 0.5 + 2 * beyond * TIE])
            agree(index, index.views, view)
            assert (index.query(view).template == 0) == (beyond < 1)


def test_of_equals_the_earliest_wins_wherever_it_is_kept():
    index = TemplateIndex(3, 0.1)
    for k in range(3 * TAIL):
        index.append([k % 7, 0, 0])
        assert index.query([k % 7, 0.03, 0]).template == k % 7


def test_nothing_known_nothing_found():
    assert TemplateIndex(18, 0.1).query(np.zeros(18)) == (-1, np.inf)


def test_bad_views_are_refused_and_change_nothing():
    index = TemplateIndex(3, 0.1)
    for bad in ([1.0, np.nan, 0], [np.inf, 0, 0], [1.0, 2.0], [[1.0, 2.0, 3.0, 4.0]]):
        for verb in (index.append, index.query):
            with pytest.raises(ValueError, match=r"finite|values"):
                verb(bad)
    with pytest.raises(ValueError, match="shape"):
        index.extend(np.zeros(3))
    assert len(index) == 0
    for size, threshold in ((0, 0.1), (3, -1), (3, np.nan)):
        with pytest.raises(ValueError, match="expected"):
            TemplateIndex(size, threshold)


def test_appending_builds_each_view_into_few_trees():
    """Every level of trees takes a view over at most RATIO + 1 times."""
    stream = np.random.default_rng(0)
    index = TemplateIndex(2, 0.1)
    for count in range(1, 30_001):
        index.append(stream.random(2))
        levels = 1 + max(0.0, np.log(count / TAIL) / np.log(RATIO))
        assert index.built <= (RATIO + 1) * levels * count
        assert len(index._blocks) <= levels + 1
