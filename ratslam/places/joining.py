"""Joins two pieces of a map if the views of one, compared with the keyframes of the other, leave no doubt.

A placement of one piece in the other has to explain all its views, be more likely than any other by far,
and be found from either side. Its keyframes on common ground then give closure sequences, which are
selected together with all others; the pieces are joined if most of their evidence is accepted. Anchoring
whole sessions: Kim et al. 2010.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ratslam.mapping.ground import MAP_WEIGHTING, Ground, Motion
from ratslam.mapping.loop_closures import Candidate
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_solution import solution_with
from ratslam.mapping.map_state import MapState
from ratslam.mapping.optimizer import MapCovariance
from ratslam.places.hypotheses import Path
from ratslam.places.map_views import MapViews
from ratslam.places.placement import Comparison, Traverse, closures_along, find_placements
from tactile.base.se2 import between, compose, fit_rigid_motion, inverse, wrap

LOG_ODDS = 15.0
"""Least log-odds of a placement, beyond the logarithm of the number of places."""
LEAST = 10
"""Least number of keyframes of a piece that is joined."""
MIN_LOG_ODDS = -60.0
"""Log-odds of the way to either end of a piece below which a placement is dropped."""
SOLVED = 0.1
"""Variance of the motion between keyframes of a solved map, as a share of that of odometry."""
COMMON = 1 / 3
"""Least share of one of two pieces, of its keyframes that can be compared, that lies on the other's ground: a
part of another place that is alike counts as often as it is driven."""
STANDING = 0.5
"""Least share of the evidence of the closure sequences between two pieces that the selection accepts."""


Stretches = tuple[int, ...]
"""Numbers of the stretches of keyframes, each from one beginning of a piece to the next, that a piece has."""
Tried = set[tuple[Stretches, Stretches]]
"""Pairs of pieces that were compared."""


class Join(NamedTuple):
    """What joined two pieces.

    Attributes:
        stretches: of either. start: [3] pose of the second piece's first keyframe in the first piece, m, m,
            rad. sd: [3] of a pose in the second piece against the first one, in the middle of their common
            ground. log_odds: of the second piece in the first and of the first in the second. needed:
            log-odds that each needed. closures: number between the two.
    """

    stretches: tuple[Stretches, Stretches]
    start: np.ndarray
    sd: np.ndarray
    log_odds: tuple[float, float]
    needed: tuple[float, float]
    closures: int


class _Found(NamedTuple):
    """A placement beyond doubt.

    Attributes:
        onto: [N] keyframes of the ground that are not merged. frames: [n] keyframes placed on it. ground: of
            `onto` and all merged with these. on: [n] bool, those on the ground. common: their share of
            those that can be compared. motion: [3] brings them there.
    """

    onto: np.ndarray
    frames: np.ndarray
    ground: Ground
    path: Path
    on: np.ndarray
    common: float
    motion: np.ndarray
    needed: float

    @property
    def log_odds(self) -> float:
        """Of the whole piece being there."""
        return float(self.path.odds.sum())


def join_all(
    map: KeyframeMap, views: MapViews, tried: Tried, report: Callable[[str], None] = lambda _: None
) -> list[Join]:
    """Joins pieces of a map, two at a time, until nothing joins any more, and merges keyframes on common
    ground.

    Args:
        tried: pairs of pieces that do not join; those found now are added. report: called with a line for
            each pair that is compared.
    """
    joins: list[Join] = []
    while (join := _join_some(map, views, tried, report)) is not None:
        joins.append(join)
        # Merges keyframes on ground that the closures of a finished map confirm.
        config = map.config
        if config.merge_stood:
            map.state.log.confirm(config.merge_stood)
            map.merger.merge_all(map.state, map.selection, 1)
    return joins


def _join_some(map: KeyframeMap, views: MapViews, tried: Tried, report: Callable[[str], None]) -> Join | None:
    """Joins the first two pieces that can be joined, of those that were not tried yet."""
    state = map.state
    piece, stretch = state.pieces(), np.cumsum(state.begins.rows)
    for pair in combinations(range(int(piece.max()) + 1), 2):
        one, other = (np.flatnonzero(piece == number) for number in pair)
        held = tuple(np.unique(stretch[one]).tolist()), tuple(np.unique(stretch[other]).tolist())
        if held in tried or min(len(one), len(other)) < LEAST:
            continue
        tried.add(held)
        report(f"comparing pieces of {len(one)} and {len(other)} keyframes")
        join = _join(map, views, one, other)
        if join is not None:
            return join._replace(stretches=held)
    return None


def _join(map: KeyframeMap, views: MapViews, one: np.ndarray, other: np.ndarray) -> Join | None:
    """Joins two pieces of keyframes `one` [N] and `other` [n] if the evidence suffices."""
    state = map.state
    found = _place(map, views, one, other)
    back = found and _place(map, views, other, one)
    if not found or not back:
        return None
    # Both placements, of either piece in the other, have to be the same.
    own = state.pose.rows[found.frames][found.on]
    apart = between(compose(found.motion, own), compose(inverse(back.motion), own))
    if not _is_small(found.ground, apart):
        return None
    if max(found.common, back.common) < COMMON:
        return None
    sequences = _closures(state, views, found)
    start = compose(found.motion, state.pose.rows[other[0]])
    trial = state.copy()
    trial.pose.rows[other] = compose(found.motion, trial.pose.rows[other])
    solution = solution_with(trial, sequences, STANDING)
    if solution is None:
        return None
    _take_up(map, solution, sequences)
    middle = sequences[len(sequences) // 2][0]
    # The pieces are held together here: what lies `LOOSE` apart cannot be compared in double precision.
    problem, piece = state.problem(), state.pieces()
    joined = np.where((piece[1:] != piece[:-1])[:, None], 1.0, problem.chain.variance)
    problem = problem._replace(chain=problem.chain._replace(variance=joined))
    covariance = MapCovariance(state.fit(), problem).relative(middle.match, middle.keyframe, 0.0)
    log_odds, needed = (found.log_odds, back.log_odds), (found.needed, back.needed)
    count = sum(len(sequence) for sequence in sequences)
    return Join(((), ()), start, np.sqrt(np.diag(covariance)), log_odds, needed, count)


def _place(map: KeyframeMap, views: MapViews, onto: np.ndarray, frames: np.ndarray) -> _Found | None:
    """The placement of keyframes `frames` [n] on the ground of those `onto` [N] and of all merged with these,
    if it is beyond doubt."""
    state = map.state
    own, every = state.pose.rows[frames], state.merged_into(onto)
    poses = state.unmerged_poses()[every]
    ground, odds = views.ground(poses), views.odds(every, poses, MAP_WEIGHTING)
    motions = _motions(state, own)
    session = Traverse(_compare(state, views, every, poses, frames), motions, MIN_LOG_ODDS, own)
    paths = []
    for path in find_placements(ground, odds, session):
        # No evidence against it at headings that the other session never drove, and less in runs beside its
        # way: two sessions drive different routes, and turn at different places.
        counted = path.odds_beside(ground)
        undriven = path.at_undriven_headings(ground)
        paths.append(path._replace(odds=np.where(undriven, np.maximum(counted, 0.0), counted)))
    paths.sort(key=lambda path: -path.odds.sum())
    needed = LOG_ODDS + float(np.log(max(ground.places(), 1.0)))
    if not paths or paths[0].odds.sum() < needed:
        return None
    best, *others = paths
    on = (best.odds != 0) & np.array([ground.is_near(pose) for pose in best.poses])
    common = float(on.sum() / max(session.views.shows.sum(), 1))
    apart = [(path, between(best.poses[on], path.poses[on])) for path in others]
    rivals = [float(path.odds.sum()) for path, moved in apart if not _is_small(ground, moved)]
    if best.odds.sum() - max(rivals, default=-np.inf) < needed:
        return None
    moved = fit_rigid_motion(own[on], best.poses[on])
    return _Found(onto, frames, ground, best, on, common, moved, needed)


def _compare(
    state: MapState, views: MapViews, taken: np.ndarray, poses: np.ndarray, frames: np.ndarray
) -> Comparison:
    """The views of keyframes `frames` [n] on those numbered `taken` [M] of all, at `poses` [M, 3]."""
    motion = np.array([moved.motion for moved in _motions(state, state.pose.rows[frames])])
    return views.compare(views.freeze(taken, poses), state.taken.rows[frames], motion)


def _motions(state: MapState, poses: np.ndarray) -> list[Motion]:
    """The motions into keyframes of a solved map at `poses` [n, 3]."""
    motion = between(poses[np.maximum(np.arange(len(poses)) - 1, 0)], poses)
    variance = SOLVED * state.odometry_variance(np.hypot(*motion[:, :2].T), np.abs(motion[:, 2]))
    return [Motion(*one) for one in zip(motion, variance, strict=True)]


def _is_small(ground: Ground, apart: np.ndarray) -> bool:
    """Whether the medians of differences [n, 3] of poses are less than the bend of two maps of one place."""
    far, turned = np.median(np.hypot(*apart[:, :2].T)), np.median(np.abs(wrap(apart[:, 2])))
    return bool(far < 2 * ground.reach and turned < ground.reach_heading)


def _closures(state: MapState, views: MapViews, found: _Found) -> list[list[Candidate]]:
    """Closure sequences along a placement, with keyframes that are not merged."""
    poses = state.pose.rows[found.onto]
    compared = _compare(state, views, state.taken.rows[found.onto], poses, found.frames)
    ground = views.ground(poses)
    sequences: list[list[Candidate]] = []
    last = -state.config.max_gap - 1
    for k, match in closures_along(ground, compared, found.path):
        if not found.on[k]:
            continue
        if k - last > state.config.max_gap:
            sequences.append([])
        # The closure of the later with the earlier keyframe, which face `turn` (rad) from each other.
        frame, other = int(found.frames[k]), int(found.onto[match.frame])
        turn, angle = float(ground.turns[match.shift]), state.sector_angle
        if frame < other:
            frame, other, turn = other, frame, -turn
        shift = round(-turn / angle) if angle else 0
        if state.half_turns:  # half a turn is the same either way
            shift = abs(shift)
        posterior = float(1 / (1 + np.exp(-match.gain)))
        sequences[-1].append(Candidate(frame, other, shift, posterior, match.gain))
        last = k
    return [sequence for sequence in sequences if len(sequence) >= state.config.min_length]


def _take_up(map: KeyframeMap, solution: MapState, sequences: list[list[Candidate]]) -> None:
    state = map.state
    for sequence in sequences:
        state.add_accepted(sequence)
    state.log.follow(solution.log)
    state.take_fit(solution.fit())
    state.cut.replace(solution.cut.rows)
    state.place_pieces()
    map.selection.hypotheses.begin(state.fit(), state.log.sequences)
