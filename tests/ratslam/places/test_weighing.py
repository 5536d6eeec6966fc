"""Gains of views that many places share count less."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ratslam.mapping.ground import (
    COMMON,
    PIECE_COMMON,
    PIECE_WEIGHTING,
    SESSION_WEIGHTING,
    less_where_common,
)
from ratslam.places.localiser import compare_with_itself
from tests.ratslam.places.test_self_comparison import GUARD, gains_on, laps

GAINS = arrays(
    np.float64,
    st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 30)),
    elements=st.floats(-700, 30),
)


@given(GAINS)
def test_places_keep_their_order_and_their_differences(gain: np.ndarray) -> None:
    """One number is taken off all gains of a view: at most `COMMON` of the highest."""
    taken = gain - less_where_common(gain)
    assert np.allclose(taken, taken[:, :1, :1])
    assert (taken[:, 0, 0] <= COMMON * gain.max(axis=(1, 2)) + 1e-9).all()


@given(GAINS, st.floats(-5, 5))
def test_a_better_fit_everywhere_counts_in_part(gain: np.ndarray, more: float) -> None:
    np.testing.assert_allclose(
        less_where_common(gain + more) - less_where_common(gain), (1 - COMMON) * more, atol=1e-9
    )


@given(GAINS)
def test_a_view_on_a_growing_map_loses_less_than_one_on_a_finished_map(gain: np.ndarray) -> None:
    lost = PIECE_COMMON / COMMON * (gain - SESSION_WEIGHTING.weigh(gain))
    np.testing.assert_allclose(gain - PIECE_WEIGHTING.weigh(gain), lost, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_view_of_one_place_counts_more_than_one_of_many(dtype: type) -> None:
    one, many = np.full((2, 1, 100), -6.0, dtype)
    one[0, 7], many[0, :60] = 3.0, 3.0
    found = less_where_common(np.stack([one, many]))
    assert found.dtype == dtype
    assert found[0].max() > 3.0 > found[1].max()


def test_views_alike_everywhere_have_no_odds_and_others_do() -> None:
    """The map's own odds are those of the weighed gains."""
    ground = laps(4)
    alike = compare_with_itself(ground, GUARD, gains_on(ground, 0.0), weighing=SESSION_WEIGHTING)
    told = compare_with_itself(ground, GUARD, gains_on(ground, 6.0, reaches=1.0), weighing=SESSION_WEIGHTING)
    assert alike.expected < 0.5 * told.expected
