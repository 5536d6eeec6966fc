"""Laws of tracks: a true pose is followed, a wrong one is lost."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.alignment.gain_odds import LEAVING
from ratslam.keyframes.pose_tracks import LOST
from tests.ratslam.keyframes.selection_cases import LAP, lap_poses
from tests.ratslam.keyframes.track_cases import COUNT, FIT, ODDS, laps, places

law = settings(derandomize=True, deadline=None, max_examples=25)
frames = st.integers(0, COUNT - 1)


@law
@given(frames, st.integers(0, 60))
def test_a_true_pose_is_followed_both_ways(frame, extent):
    ground = laps(places(None, 0))
    track = ground.track(frame, ground.poses[frame], extent, ODDS)
    led = np.isfinite(track.odds)
    assert np.flatnonzero(led).tolist() == list(
        range(max(frame - extent, 0), min(frame + extent, COUNT - 1) + 1)
    )
    assert np.hypot(*(track.poses - ground.poses)[led, :2].T).max() < ground.reach
    assert (track.odds[led] == ODDS.odds[1]).all()
    assert np.isnan(track.poses[~led]).all()
    assert track.leads_past(frame, ground.poses[frame], ground)


@law
@given(frames, st.integers(LAP // 4, 3 * LAP // 4))
def test_views_tell_against_a_wrong_pose(frame, off):
    ground = laps(places(None, 0))
    track = ground.track(frame, lap_poses(np.array([frame + off]))[0], LAP // 2, ODDS)
    assert track.odds[np.isfinite(track.odds)].sum() < 0
    assert not track.leads_past(frame, ground.poses[frame], ground)


@law
@given(frames)
def test_a_track_that_the_views_contradict_ends(frame):
    ground = laps(places(None, 0))
    track = ground._replace(fits=-np.abs(ground.fits)).track(frame, ground.poses[frame], COUNT, ODDS)
    led = np.flatnonzero(np.isfinite(track.odds))
    length = int(-LOST // 2) + 1  # each view has log-odds of -2
    assert led[0] == max(frame - length, 0)
    assert led[-1] == min(frame + length, COUNT - 1)


@law
@given(frames)
def test_a_drifting_track_is_held_by_the_views(frame):
    """Motions a tenth too short: the views move the pose back, without them it ends a cell off."""
    ground = laps(places(None, 0))
    short = ground._replace(motions=ground.motions * [0.9, 0.9, 1.0], variances=ground.variances * 25)
    stop = COUNT - 1 if frame < COUNT / 2 else 0
    reached, poses, *_ = short.follow(frame, ground.poses[frame], stop, ODDS)
    assert reached[-1] == stop
    assert np.hypot(*(poses - ground.poses[reached])[:, :2].T).max() < 1.5 * ground.reach


@law
@given(frames)
def test_views_of_a_stretch_fit_best_where_they_were_taken(frame):
    ground = laps(places(None, 0))
    found = ground.places()
    distance = np.hypot(*(found[:, None] - ground.poses)[..., :2].transpose(2, 0, 1))
    assert distance.min(axis=0).max() < ground.reach  # every keyframe has a place
    assert len(found) <= LAP
    best = found[np.argmax(ground.scan(frame, found, 8))]
    assert np.hypot(*(best - ground.poses[frame])[:2]) < 1.5 * ground.reach


def test_own_fits_are_those_of_the_poses():
    ground = laps(places(None, 0))
    assert (ground.own_fits() == FIT).all()
    away = ground._replace(poses=ground.poses.copy())
    away.poses[40:50, 0] += 10.0
    assert np.isnan(away.own_fits()[40:50]).all()
    assert away.own_odds(ODDS)[40:50].tolist() == [LEAVING, *[0.0] * 9]
