"""Ties between pieces of a growing map: the newest piece is placed on another one like a session on a map.

A sequence of closures between pieces strains no odometry, so a false one would be accepted as easily as a
true one. A placement of the whole piece has to explain all its views."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.archive import Archive
from ratslam.mapping.following import Motion
from ratslam.mapping.gain_odds import PIECE, GainOdds, LearnedOdds
from ratslam.mapping.ground import Ground
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog
from ratslam.mapping.piece_ties import Tie
from ratslam.methods.map_views import MapViews, ViewMatcher
from ratslam.places.paths import less_where_dependent
from ratslam.places.placement import Traverse, closures_along, find_placements
from ratslam.recall.memory import Memory

FEWEST = 10
"""Least number of keyframes of a piece that is placed on another or has another placed on it."""


class PlacedOn(NamedTuple):
    """A piece as ground: its keyframes [N], their frozen memory, and the log-odds of gains."""

    frames: np.ndarray
    ground: Ground
    memory: Memory
    odds: GainOdds


class PieceTies:
    """Finds where the newest piece of a map lies on an older one. What it keeps between two calls are only
    compiled functions.

    Args:
        recall: the backend that makes the map.
    """

    def __init__(self, recall: ViewMatcher) -> None:
        self._recall = recall
        self._views: MapViews | None = None

    def __call__(
        self, graph: KeyframeGraph, log: ClosureLog, archive: Archive, odds: LearnedOdds
    ) -> Tie | None:
        """The best placement of the keyframes since the newest beginning on one of the pieces before."""
        begin = int(np.flatnonzero(graph.begins.rows)[-1])
        own, piece = np.arange(begin, graph.count), graph.pieces(log)[:begin]
        if len(own) < FEWEST:
            return None
        if self._views is None or self._views.graph is not graph:
            self._views = MapViews(self._recall, graph)
        found: list[Tie] = []
        for number in np.unique(piece).tolist():
            frames = np.flatnonzero(piece == number)
            if len(frames) >= FEWEST:
                on = _placed_on(self._views, archive, odds, frames)
                found += _place(self._views, own, on)
        if not found:
            return None
        best, *others = sorted(found, key=lambda tie: -tie.log_odds)
        rival = others[0].log_odds if others else -np.inf
        margin = graph.config.tie_log_odds / 2
        return best if best.log_odds - rival >= margin else best._replace(log_odds=best.log_odds - rival)


def _placed_on(views: MapViews, archive: Archive, odds: LearnedOdds, frames: np.ndarray) -> PlacedOn:
    graph = views.graph
    taken, poses = graph.taken.rows[frames], graph.pose.rows[frames]

    def learn() -> GainOdds:
        every = np.flatnonzero(np.isin(archive.row.rows, frames)) if archive.begun else taken
        return views.odds(every, archive.poses(graph.pose.rows)[every], np.isin(every, taken), PIECE)

    key = (len(frames), int(taken[0]), int(taken[-1]))
    return PlacedOn(frames, views.ground(poses), views.freeze(taken, poses), odds.of(key, learn))


def _place(views: MapViews, own: np.ndarray, on: PlacedOn) -> list[Tie]:
    """All placements on a ground."""
    graph = views.graph
    # Odometry into each keyframe of the piece without its systematic errors.
    motion = graph.correct(graph.motion.rows[own], graph.length.rows[own])
    variance = graph.odometry_variance(graph.length.rows[own], graph.turn.rows[own])
    variance[:, 2] *= graph.heading_noise.further_factor
    motions = [Motion(*one) for one in zip(motion, variance, strict=True)]
    compared = views.compare(on.memory, graph.taken.rows[own], np.array([m.motion for m in motions]))
    places = float(np.log(max(on.ground.places(), 1.0)))
    session = Traverse(compared._replace(gain=PIECE.weigh(compared.gain)), motions)
    return [
        Tie(
            float(less_where_dependent(on.ground, path).sum()) - places,
            [
                Candidate(int(own[k]), int(on.frames[at.frame]), int(views.shifts[at.shift]), 1.0, at.gain)
                for k, at in closures_along(on.ground, compared, path)
            ],
        )
        for path in find_placements(on.ground, on.odds, session)
    ]
