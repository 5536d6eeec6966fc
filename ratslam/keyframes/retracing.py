"""Retracing: where a robot that may be carried was at each keyframe of a finished map, all views considered.

The map's own stretches between breaks, the places that closure sequences claim and, where the map's poses fit
badly, the places that look alike are followed as tracks in both directions. The sequence of tracks with the
largest log-odds is that of a hidden Markov model in which the robot is seldom carried (Viterbi 1967);
odometry is cut where it jumps from one track to another. That its states are tracks is ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.alignment.gain_odds import GainOdds
from ratslam.core.compiled import compiled
from ratslam.keyframes.closure_selection import CUT
from ratslam.keyframes.loop_closures import ClosureLog, Verdict
from ratslam.keyframes.pose_tracks import SelfTraverse, Track
from ratslam.keyframes.verification import turn_on_spot

JUMP = CUT
"""What being carried costs, nat: twice what a cut costs a selection, because each view counts here, and
successive ones are alike."""
BEYOND, AROUND = 60, 180
"""Keyframes over which a stretch of the map is followed beyond its ends, and over which any other track is
followed."""
LOOKED, EVERY = 8, 4
"""Keyframes whose views are considered together to see whether the map fits, and how often."""
DOUBTED = 0.5
"""Mean log-odds of these below which other places are tried, nat."""
TRIED = 4
"""Number of such places."""


class Retraced(NamedTuple):
    """Poses [N, 3] of the keyframes, the log-odds of their views there less `JUMP` for each cut, and the
    keyframes [n] before which odometry is cut."""

    poses: np.ndarray
    odds: float
    cuts: np.ndarray


def retrace(
    session: SelfTraverse, odds: GainOdds, cuts: np.ndarray, log: ClosureLog, sector_angle: float
) -> Retraced:
    """The most likely track through all keyframes.

    Args:
        cuts: keyframes [n] before which the odometry of the map is cut. log: whose sequences claim places.
    """
    tracks = _own_tracks(session, odds, cuts)
    for frame, pose in _claims(session, log, sector_angle):
        _add(tracks, session, odds, frame, pose)
    _search(tracks, session, odds)
    poses, gained = (np.stack(part) for part in zip(*tracks, strict=True))
    reach = session.ground.reach, session.ground.reach_heading
    chosen, jumps, total = _best_sequence(poses, gained, *reach, JUMP)
    return Retraced(poses[chosen, np.arange(session.size)], total, np.flatnonzero(jumps))


def _own_tracks(session: SelfTraverse, odds: GainOdds, cuts: np.ndarray) -> list[Track]:
    """The stretches of the map between its cuts, followed on beyond them."""
    own, tracks = session.own_odds(odds), []
    for first, last in zip([0, *cuts.tolist()], [*cuts.tolist(), session.size], strict=True):
        track = Track(np.full((session.size, 3), np.nan), np.full(session.size, -np.inf))
        track.poses[first:last], track.odds[first:last] = session.poses[first:last], own[first:last]
        for end, stop in ((last - 1, last - 1 + BEYOND), (first, first - BEYOND)):
            frames, poses, _, gained = session.follow(end, session.poses[end], stop, odds)
            track.poses[frames], track.odds[frames] = poses, gained
        tracks.append(track)
    return tracks


def _claims(session: SelfTraverse, log: ClosureLog, sector_angle: float) -> list[tuple[int, np.ndarray]]:
    """The poses [3] that the sequences claim for the keyframe of their middle members."""
    claims = []
    for sequence in np.flatnonzero((log.left() > 1) & (log.verdicts() != Verdict.UNDONE)).tolist():
        members = log.members(sequence)
        frame, match, shift, _ = members[len(members) // 2].tolist()
        claims.append((frame, turn_on_spot(session.poses[match], -shift * sector_angle)))
    return claims


def _search(tracks: list[Track], session: SelfTraverse, odds: GainOdds) -> None:
    """Adds tracks of places that look alike where the poses of the map do not fit."""
    fits = np.convolve(session.own_odds(odds), np.ones(LOOKED), "valid")
    places = session.places()
    for frame in range(0, len(fits), EVERY):
        if fits[frame] < DOUBTED * LOOKED:
            likeness = session.scan(frame, places, LOOKED)
            for place in np.argsort(-likeness, kind="stable")[:TRIED].tolist():
                _add(tracks, session, odds, frame, places[place])


def _add(tracks: list[Track], session: SelfTraverse, odds: GainOdds, frame: int, pose: np.ndarray) -> None:
    """Adds the track of a keyframe at a pose [3], unless one leads past it."""
    if not any(track.leads_past(frame, pose, session.ground) for track in tracks):
        tracks.append(session.track(frame, pose, AROUND, odds))


@compiled
def _best_sequence(
    poses: np.ndarray, odds: np.ndarray, reach: float, reach_heading: float, jump: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """The sequence of tracks with the largest log-odds.

    Args:
        poses: [K, N, 3] of K tracks. odds: [K, N], -inf where a track does not lead. reach, reach_heading:
            differences below which two tracks are at one pose, m and rad. jump: cost of a change between
            tracks that are not.

    Returns:
        the track of each keyframe [N]; bool [N], whether it was reached by a jump; the log-odds.
    """
    tracks, count = odds.shape
    score = odds[:, 0].copy()
    before, jumped = np.zeros((count, tracks), np.int64), np.zeros((count, tracks), np.bool_)
    for k in range(1, count):
        best, after = int(np.argmax(score)), np.full(tracks, -np.inf)
        for t in range(tracks):
            if odds[t, k] == -np.inf:
                continue
            value, source, leaps = score[best] - jump, best, True
            for u in range(tracks):
                if score[u] <= value or odds[t, k - 1] == -np.inf:
                    continue
                x, y = poses[t, k - 1, 0] - poses[u, k - 1, 0], poses[t, k - 1, 1] - poses[u, k - 1, 1]
                alike = np.cos(poses[t, k - 1, 2] - poses[u, k - 1, 2]) > np.cos(reach_heading)
                if u == t or (x * x + y * y < reach * reach and alike):
                    value, source, leaps = score[u], u, False
            before[k, t], jumped[k, t], after[t] = source, leaps, value + odds[t, k]
        score = after
    chosen, jumps = np.empty(count, np.int64), np.zeros(count, np.bool_)
    chosen[-1] = np.argmax(score)
    for k in range(count - 1, 0, -1):
        chosen[k - 1] = before[k, chosen[k]]
        jumps[k] = jumped[k, chosen[k]]
    return chosen, jumps, score[chosen[-1]]
