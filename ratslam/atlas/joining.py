"""Joins the pieces of a map that views of one on the ground of the other place beyond doubt.

A placement of one piece in the other has to explain all its views, be more likely than any other by far, and
be found from either side. Its keyframes on common ground then give closure sequences, which are selected
together with all others; the pieces are joined if most of their evidence stands. Anchoring whole sessions is
Kim et al. 2010; the rule is ours."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import NamedTuple, Protocol

import numpy as np

from ratslam.alignment.comparison import Comparison
from ratslam.alignment.gain_odds import GainOdds
from ratslam.alignment.ground import Ground
from ratslam.atlas.placement import Placement, Traverse, find_placements, motions_between
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.keyframes.map import KeyframeMap
from ratslam.keyframes.map_hypotheses import MapHypotheses
from ratslam.keyframes.map_solution import MapSolution, selected_solution, solved_map
from tactile.base.se2 import between, compose, fit_rigid_motion, inverse, wrap

LOG_ODDS = 15.0
"""Least log-odds of a placement, beyond the logarithm of the number of places."""
LEAST = 10
"""Least number of keyframes of a piece that is joined."""
STANDING = 0.5
"""Least share of the evidence of the closure sequences between two pieces that the selection accepts."""


Stretches = tuple[int, ...]
"""Numbers of the stretches of keyframes, each from one beginning of a piece to the next, that a piece has."""


class Views(Protocol):
    """Compares the views of a map's keyframes, numbered among all ever taken."""

    def ground(self, poses: np.ndarray) -> Ground:
        """Keyframes at `poses` [N, 3] as ground."""

    def odds(self, frames: np.ndarray, poses: np.ndarray) -> GainOdds:
        """The log-odds of gains on the ground of keyframes `frames` [N] at `poses` [N, 3]."""

    def compare(
        self, frames: np.ndarray, poses: np.ndarray, others: np.ndarray, motion: np.ndarray
    ) -> Comparison:
        """The views of keyframes `others` [n], moved by `motion` [n, 3] into each, on the ground of keyframes
        `frames` [N] at `poses` [N, 3]."""


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
    """A placement beyond doubt: of keyframes `frames` [n] on `ground` of keyframes `onto` [N]; `motion` [3]
    brings them there."""

    onto: np.ndarray
    frames: np.ndarray
    ground: Ground
    views: Comparison
    placement: Placement
    motion: np.ndarray
    needed: float


def join_all(
    map: KeyframeMap,
    views: Views,
    tried: set[tuple[Stretches, Stretches]],
    report: Callable[[str], None] = lambda _: None,
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
        _merge_keyframes(map)
    return joins


def _join_some(
    map: KeyframeMap,
    views: Views,
    tried: set[tuple[Stretches, Stretches]],
    report: Callable[[str], None],
) -> Join | None:
    """Joins the first two pieces that can be joined, of those that were not tried yet."""
    graph = map.kept_keyframes()
    piece, stretch = graph.pieces(map.log), np.cumsum(graph.begins.rows)
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


def _join(map: KeyframeMap, views: Views, one: np.ndarray, other: np.ndarray) -> Join | None:
    """Joins two pieces of keyframes `one` [N] and `other` [n] if the evidence suffices."""
    graph = map.kept_keyframes()
    found = _place(graph, views, one, other)
    back = found and _place(graph, views, other, one)
    if not found or not back or not _agree(graph, found, back):
        return None
    sequences = _closures(graph, found)
    start = compose(found.motion, graph.pose.rows[other[0]])
    trial, log = graph.copy(), map.log.copy()
    trial.pose.rows[other] = compose(found.motion, trial.pose.rows[other])
    first, solution = log.sequences, _solve_with(trial, log, sequences)
    new = np.arange(log.sequences) >= first
    standing = new & (solution.log.verdicts() == Verdict.ACCEPTED)
    scores = solution.log.scores()
    if not new.any() or scores[standing].sum() < STANDING * scores[new].sum():
        return None
    _take_up(map, solution, sequences)
    middle = sequences[len(sequences) // 2][0]
    covariance = graph.map_covariance(map.log).relative(middle.match, middle.keyframe, 0.0)
    return Join(
        ((), ()), start, np.sqrt(np.diag(covariance)),
        (found.placement.log_odds, back.placement.log_odds), (found.needed, back.needed),
        sum(len(sequence) for sequence in sequences),
    )  # fmt: skip


def _place(graph: KeyframeGraph, views: Views, onto: np.ndarray, frames: np.ndarray) -> _Found | None:
    """The placement of keyframes `frames` [n] on those `onto` [N], if it is beyond doubt."""
    taken, pose = graph.taken.rows, graph.pose.rows
    ground = views.ground(pose[onto])
    own = pose[frames]
    motion = between(own[np.maximum(np.arange(len(own)) - 1, 0)], own)
    variance = graph.odometry_variance(np.hypot(*motion[:, :2].T), np.abs(motion[:, 2]))
    compared = views.compare(taken[onto], pose[onto], taken[frames], motion)
    odds = views.odds(taken[onto], pose[onto])
    placements = find_placements(ground, odds, Traverse(compared, motions_between(own, variance)))
    needed = LOG_ODDS + float(np.log(max(ground.places(), 1.0)))
    if not placements or placements[0].log_odds < needed:
        return None
    best, *others = placements
    rivals = [one.log_odds for one in others if not best.is_like(ground, one)]
    if best.log_odds - max(rivals, default=-np.inf) < needed:
        return None
    on = best.on_ground()
    moved = fit_rigid_motion(own[on], best.path.poses[on])
    return _Found(onto, frames, ground, compared, best, moved, needed)


def _agree(graph: KeyframeGraph, found: _Found, back: _Found) -> bool:
    """Whether two placements, of either piece in the other, are the same."""
    on = found.placement.on_ground()
    own = graph.pose.rows[found.frames][on]
    apart = between(compose(found.motion, own), compose(inverse(back.motion), own))
    far, turned = np.median(np.hypot(*apart[:, :2].T)), np.median(np.abs(wrap(apart[:, 2])))
    return bool(far < 2 * found.ground.reach and turned < found.ground.reach_heading)


def _closures(graph: KeyframeGraph, found: _Found) -> list[list[Candidate]]:
    """Closure sequences along a placement: of each keyframe on common ground with the one there whose view
    fits best."""
    sequences: list[list[Candidate]] = []
    ground, last = found.ground, -graph.config.max_gap - 1
    for k in np.flatnonzero(found.placement.on_ground()).tolist():
        shift, row = ground.near(found.placement.path.poses[k], ground.reach, ground.reach_heading)
        gains = found.views.gain[k][shift, row].astype(float)
        if not len(row) or gains.max() <= 0:
            continue
        best = int(np.argmax(gains))
        turn = float(ground.turns[shift[best]])
        frame, match = int(found.frames[k]), int(found.onto[row[best]])
        if k - last > graph.config.max_gap:
            sequences.append([])
        sequences[-1].append(_candidate(graph, frame, match, turn, float(gains[best])))
        last = k
    return [sequence for sequence in sequences if len(sequence) >= graph.config.min_length]


def _candidate(graph: KeyframeGraph, frame: int, match: int, turn: float, gain: float) -> Candidate:
    """The closure between two keyframes, the first of which faces `turn` (rad) from the second."""
    if frame < match:
        frame, match, turn = match, frame, -turn
    angle = graph.sector_angle
    shift = round(-turn / angle) if angle else 0
    if np.cos(angle) < 0:  # half a turn is the same either way
        shift = abs(shift)
    return Candidate(frame, match, shift, float(1 / (1 + np.exp(-gain))), gain)


def _add(log: ClosureLog, sequences: list[list[Candidate]]) -> None:
    for sequence in sequences:
        for k, candidate in enumerate(sequence):
            log.add(candidate, k > 0)
        log.judge(log.sequences - 1, Verdict.ACCEPTED)


def _solve_with(graph: KeyframeGraph, log: ClosureLog, sequences: list[list[Candidate]]) -> MapSolution:
    """The map with further closure sequences, selected together with all others where sequences are selected;
    changes graph and log."""
    _add(log, sequences)
    graph.optimise(log)
    solution = None
    if graph.config.select_every:
        hypotheses = MapHypotheses()
        hypotheses.begin(graph.fit(), log.sequences)
        solution = selected_solution(graph, log, hypotheses)
    return solution or solved_map(graph, log)


def _take_up(map: KeyframeMap, solution: MapSolution, sequences: list[list[Candidate]]) -> None:
    graph, log = map.kept_keyframes(), map.log
    for sequence in sequences:
        for k, candidate in enumerate(sequence):
            map.archive.add(candidate, k > 0, graph)
    _add(log, sequences)
    log.follow(solution.log)
    graph.pose.rows[:] = solution.fit.poses
    graph.bias, graph.turn_error = solution.fit.bias, solution.fit.turn_error
    graph.cut.replace(solution.cut.rows)
    graph.place_pieces(log)
    map.selection.hypotheses.begin(graph.fit(), log.sequences)


def _merge_keyframes(map: KeyframeMap) -> None:
    """Merges keyframes on ground that the closures of a finished map confirm."""
    config = map.config
    if config.merge_stood:
        map.log.confirm(config.merge_stood)
        map.merger.merge_all(map.kept_keyframes(), map.log, map.selection, 1)
