"""Laws of retracing: a robot that was carried is found again, one that was not stays where it is."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.carried_solution import JUMP, retrace
from ratslam.mapping.loop_closures import ClosureLog
from tests.ratslam.mapping.selection_cases import LAP, lap_poses
from tests.ratslam.mapping.track_cases import COUNT, ODDS, laps, places

law = settings(derandomize=True, deadline=None, max_examples=15)
jumps = st.integers(2 * LAP + 5, 2 * LAP + 35), st.integers(LAP // 4, 3 * LAP // 4)
NONE = np.zeros(0, int)


def retraced(session, cuts=NONE):
    return retrace(session, ODDS, cuts, ClosureLog(), np.pi)


@law
@given(*jumps)
def test_a_carried_robot_is_found_again(jump, ahead):
    place = places(jump, ahead)
    found = retraced(laps(place))
    assert len(found[2]) == 1
    assert abs(found[2][0] - jump) <= 2
    off = np.hypot(*(found[0] - lap_poses(place))[:, :2].T)
    assert off[np.abs(np.arange(COUNT) - jump) > 2].max() < 0.06


@law
@given(st.integers(LAP, COUNT - 10), st.integers(1, 5), st.integers(LAP // 4, 3 * LAP // 4))
def test_a_robot_that_was_not_carried_stays_where_it_is(first, length, off):
    """A few views of another place do not pay for two jumps."""
    place = places(None, 0)
    shown = place.copy()
    shown[first : first + length] += off
    session = laps(place, shown)
    found = retraced(session)
    assert not len(found[2])
    assert np.hypot(*(found[0] - session.poses)[:, :2].T).max() < session.ground.reach


def test_a_wrong_cut_is_taken_back():
    session = laps(places(None, 0))
    found = retraced(session, np.array([LAP + 20]))
    assert not len(found[2])
    assert found[1] == ODDS.odds[1] * COUNT
    session = laps(places(2 * LAP + 20, LAP // 2))
    assert retraced(session)[1] > ODDS.odds[1] * COUNT - JUMP - 6 * np.ptp(ODDS.odds)


def test_retracing_again_gives_the_same_bits():
    session = laps(places(2 * LAP + 20, LAP // 2))
    one, other = retraced(session), retraced(session)
    assert all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
    assert len(one[2]) == 1
