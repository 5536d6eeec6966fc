"""How well every view of a map fits at every other keyframe, and the log-odds of a fit."""

from __future__ import annotations

import numpy as np

from ratslam.alignment.gain_odds import BINS, GainOdds, learn_gain_odds
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.pose_tracks import SelfTraverse

SAMPLES = 60
"""Number of stretches by which the odds of false poses are learned."""
FIRST, FURTHER = 8, 16
"""Keyframes by which alike places are chosen, and those after them whose fits there count."""
ALIKE = 4
"""Number of alike places for each stretch."""
ELSEWHERE = 2.0
"""Least distance of another place, as a multiple of the reach of a keyframe."""
EVEN = GainOdds(np.arange(BINS - 1.0), np.zeros(BINS), 0.0)
"""Odds that say nothing."""


def view_fits(graph: KeyframeGraph) -> np.ndarray:
    """[N, S, N] float32 log-odds that the view of a keyframe (first axis) is one of the place of another
    (last axis), facing alike and, with whiskers, opposite; -inf for those of nearly the same time."""
    count, shifts = graph.count, 2 if np.cos(graph.sector_angle) < 0 else 1
    fits = np.empty((count, shifts, count), np.float32)
    every, reversed = np.tile(np.arange(count), shifts), np.repeat(np.arange(shifts) > 0, count)
    for frame in range(count):
        fits[frame] = graph.log_odds(frame, every, reversed).reshape(shifts, count)
        fits[frame, :, max(frame - graph.guard, 0) : frame + graph.guard + 1] = -np.inf
    return fits


def earlier_fits(fits: np.ndarray) -> np.ndarray:
    """The fits [N, S, N] at earlier keyframes, -inf at later ones."""
    later = np.triu(np.ones((len(fits), len(fits)), bool))
    return np.where(later[:, None], np.float32(-np.inf), fits)


def learn_odds(session: SelfTraverse) -> GainOdds:
    """The log-odds of a fit, from those at the map's own poses and on tracks from other places that look
    alike."""
    true, false = session.own_fits(), [np.zeros(0)]
    places = session.places()
    frames = np.arange(FIRST, session.size - FIRST - FURTHER, max(session.size // SAMPLES, 1))
    for frame in frames.tolist():
        fits = session.scan(frame, places, FIRST)
        apart = np.hypot(*(places - session.poses[frame])[:, :2].T)
        facing = np.cos(places[:, 2] - session.poses[frame, 2]) > np.cos(2 * session.ground.reach_heading)
        fits[(apart < ELSEWHERE * session.ground.reach) & facing] = -np.inf
        for place in np.argsort(-fits, kind="stable")[:ALIKE].tolist():
            *_, found, _ = session.follow(frame, places[place], frame + FIRST + FURTHER, EVEN)
            false.append(found[FIRST:])
    other = np.concatenate(false)
    return learn_gain_odds(true[np.isfinite(true)], other[np.isfinite(other)])
