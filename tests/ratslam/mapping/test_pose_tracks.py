"""Laws of tracks: a true pose is followed, a wrong one is lost."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.ground import LEAVING
from ratslam.mapping.pose_tracks import LOST
from tests.ratslam.mapping.selection_cases import LAP, lap_poses
from tests.ratslam.mapping.track_cases import COUNT, FIT, ODDS, laps, places

law = settings(derandomize=True, deadline=None, max_examples=25)
frames = st.integers(0, COUNT - 1)


@law
@given(frames, st.integers(0, 60))
def test_a_true_pose_is_followed_both_ways(frame, extent):
    session = laps(places(None, 0))
    poses, odds = session.track_from(frame, session.poses[frame], extent, ODDS)
    led = np.isfinite(odds)
    assert np.flatnonzero(led).tolist() == list(
        range(max(frame - extent, 0), min(frame + extent, COUNT - 1) + 1)
    )
    assert np.hypot(*(poses - session.poses)[led, :2].T).max() < session.ground.reach
    assert (odds[led] == ODDS.odds[1]).all()
    assert np.isnan(poses[~led]).all()
    np.testing.assert_array_equal(poses[frame], session.poses[frame])


@law
@given(frames, st.integers(LAP // 4, 3 * LAP // 4))
def test_views_tell_against_a_wrong_pose(frame, off):
    session = laps(places(None, 0))
    _, odds = session.track_from(frame, lap_poses(np.array([frame + off]))[0], LAP // 2, ODDS)
    assert odds[np.isfinite(odds)].sum() < 0


@law
@given(frames)
def test_a_track_that_the_views_contradict_ends(frame):
    session = laps(places(None, 0))
    against = session._replace(fits=-np.abs(session.fits))
    _, odds = against.track_from(frame, session.poses[frame], COUNT, ODDS)
    led = np.flatnonzero(np.isfinite(odds))
    length = int(-LOST // 2) + 1  # each view has log-odds of -2
    assert led[0] == max(frame - length, 0)
    assert led[-1] == min(frame + length, COUNT - 1)


@law
@given(frames)
def test_a_drifting_track_is_held_by_the_views(frame):
    """Motions a tenth too short: the views move the pose back, without them it ends a cell off."""
    session = laps(places(None, 0))
    short = session._replace(motions=session.motions * [0.9, 0.9, 1.0], variances=session.variances * 25)
    stop = COUNT - 1 if frame < COUNT / 2 else 0
    reached, poses, *_ = short.follow(frame, session.poses[frame], stop, ODDS)
    assert reached[-1] == stop
    assert np.hypot(*(poses - session.poses[reached])[:, :2].T).max() < 1.5 * session.ground.reach


@law
@given(frames)
def test_views_of_a_stretch_fit_best_where_they_were_taken(frame):
    session = laps(places(None, 0))
    found = session.places()
    distance = np.hypot(*(found[:, None] - session.poses)[..., :2].transpose(2, 0, 1))
    assert distance.min(axis=0).max() < session.ground.reach  # every keyframe has a place
    assert len(found) <= LAP
    best = found[np.argmax(session.scan(frame, found, 8))]
    assert np.hypot(*(best - session.poses[frame])[:2]) < 1.5 * session.ground.reach


def test_own_fits_are_those_of_the_poses():
    session = laps(places(None, 0))
    assert (session.own_fits() == FIT).all()
    away = laps(places(None, 0))
    away.poses[40:50, 0] += 10.0
    assert np.isnan(away.own_fits()[40:50]).all()
    assert away.own_odds(ODDS)[40:50].tolist() == [LEAVING, *[0.0] * 9]
