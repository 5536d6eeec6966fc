"""Whether the robot is really back: the log-odds that a closure sequence is true.

A sequence claims that its middle keyframe was at the pose of the one it matched. That pose is followed by
odometry, corrected by the keyframes near by, through the sequence and `BEYOND` keyframes before and after
it, once over the map (m) and once over the older pass alone as odometry knows it (o), which no closure has
bent. Each view on the way counts by how well it fits there, for or against:

    L_g = a_g + w+ max(R, 0) + w- min(R, 0) + n_within . w1 + n_around . w2,    g = m, o
    L   = (L_m + L_o) / 2

R is the log of the density that odometry gave to the claimed place over its mean at all older keyframes.
The numbers n count views by kind (`KINDS`). The weights are those of a logistic regression on simulated
sessions with known truth (`python -m ratslam reproduce tables closures`); they are far below those of
independent views, because successive views are alike. The evidence of recall counts less where L is low
(`ClosureLog.credit`), and an unlikely sequence waits for a selection (`AT_ONCE`); L alone refuses none.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from ratslam.mapping.ground import (
    EVEN,
    MOST_REACH,
    MOST_REACH_HEADING,
    REACH,
    REACH_HEADING,
    compare_view,
    follow_track,
)
from ratslam.mapping.loop_closures import Verdict
from ratslam.mapping.map_state import MapState
from ratslam.mapping.odometry_scan import log_ratio
from tactile.base.compiled import compiled
from tactile.base.se2 import correct_heading, integrate, inverse

AT_ONCE = 1.0
"""Least log-odds of a sequence that is accepted before it is weighed against the others."""
WEIGHTS = "closure_judge.json"
"""The weights, beside this file."""
BEYOND = 80
"""Keyframes before and after a sequence whose views count."""
EXTENT = 50
"""Keyframes of the older pass before and after it, beyond those, that may be compared."""
LEAST, MOST = -6.0, 8.0
"""Limits of R in L; odometry has outliers."""
NOISIER = 0.35
"""Standard deviation of the log of the factor by which the odometry is noisier than set."""
EDGES = np.array([-1.5, 0.0, 1.5])
"""Gains, nat, between views that contradict, disagree, agree and fit."""
KINDS = len(EDGES) + 3
"""Kinds of views: these four; beside the way, contradicted by none; off the way."""
STRAY = 1.0
"""Distance of a followed pose from odometry, in reaches, from which it is compared with fewer keyframes."""
CONTROLS = 48
"""Number of keyframes elsewhere with which a view is compared."""
BOX = 16
"""Keyframes of a way that are compared with the ground in the box around them."""


class SequenceEvidence(NamedTuple):
    """What is known of n sequences.

    Attributes:
        odometry_ratio: [n] R, not limited below; NaN where odometry is broken between the keyframes that a
            sequence joins, about which nothing is said. counts: [n, 2, 2, KINDS] views of each kind: over the
            map and over the older pass; of the sequence and around it.
    """

    odometry_ratio: np.ndarray
    counts: np.ndarray

    def features(self) -> np.ndarray:
        """[n, 2, 3 + 2 KINDS] factors of the weights, over the map and over the older pass."""
        ratio, n = np.maximum(self.odometry_ratio, LEAST), len(self.odometry_ratio)
        first = np.column_stack([np.ones(n), np.maximum(ratio, 0), np.minimum(ratio, 0)])
        counts = self.counts.reshape(n, 2, 2 * KINDS)
        return np.concatenate([np.repeat(first[:, None], 2, axis=1), counts], axis=2)

    def log_odds(self, weights: np.ndarray) -> np.ndarray:
        """[n] L; NaN where nothing is said. weights: see `shipped_weights`."""
        ways: np.ndarray = (self.features() * weights).sum(axis=2)
        return ways.mean(axis=1)


@cache
def shipped_weights() -> np.ndarray:
    """Weights [2, 3 + 2 KINDS] of whisker views, over the map and over the older pass: a, w+, w-, w1, w2,
    nat."""
    return np.array(json.loads((files(__package__) / WEIGHTS).read_text(encoding="utf-8"))["weights"])


def judge_sequences(state: MapState, sequences: np.ndarray) -> np.ndarray:
    """[n] log-odds of sequences [n] of a map; NaN where nothing is said: of views without weights, and
    where the robot may be carried, as odometry then gives no prior."""
    if not state.appearance.JUDGED or state.config.may_be_carried:
        return np.full(len(sequences), np.nan)
    return sequence_evidence(state, sequences, BEYOND).log_odds(shipped_weights())


def judge_anew(state: MapState, sequences: np.ndarray) -> None:
    """Stores the log-odds of sequences [n] of the map in its log; of those that have lost keyframes by
    merging the former ones stay."""
    whole = sequences[[not state.log.has_merged(k) for k in sequences.tolist()]]
    state.log.set_log_odds(whole, judge_sequences(state, whole))


def doubt_of_closures(state: MapState) -> float:
    """Probability that the accepted sequences of a map are false if they are so together,
    1 / (1 + exp(S)), with the sum S of their log-odds, R below `LEAST` counted in full; NaN if nothing is
    said of any. Where a room looks alike after half a turn, only odometry speaks against a false sequence. It
    may be noisier than set, by the likeliest factor f of those with a prior (`NOISIER`): R / f^2 counts.
    """
    if not state.appearance.JUDGED or state.config.may_be_carried:
        return np.nan
    accepted = np.flatnonzero((state.log.verdicts() == Verdict.ACCEPTED) & (state.log.left() > 0))
    evidence = sequence_evidence(state, accepted, BEYOND)
    odds = evidence.log_odds(shipped_weights())
    if not np.isfinite(odds).any():
        return np.nan
    log = np.linspace(0.0, 3.0, 31)  # of the factors
    excluded = np.minimum(evidence.odometry_ratio / np.exp(2 * log[:, None]) - LEAST, 0.0)
    sums = np.nansum(odds + excluded, axis=1) - (log / NOISIER) ** 2 / 2
    return float(expit(-sums.max()))


def sequence_evidence(state: MapState, sequences: np.ndarray, after: int) -> SequenceEvidence:
    """The evidence for sequences [n], each with a candidate or more, in a map of N keyframes.

    Args:
        after: number of keyframes after a sequence that are known.
    """
    config = state.config
    found = SequenceEvidence(np.full(len(sequences), np.nan), np.zeros((len(sequences), 2, 2, KINDS)))
    ways = _ways(state, sequences, after)
    # Odometry into each keyframe without its systematic errors, and poses by odometry alone.
    motion = correct_heading(state.motion.rows, state.length.rows, state.bias, state.turn_error)
    variance = state.own_variances()
    reckoned = state.dead_reckoned(state.start.bias, state.start.turn_error)
    asked = np.zeros(state.count, bool)
    for way in ways.values():
        asked[way.low : way.high] = True
    elsewhere = np.zeros(state.count)  # see `_fit_elsewhere`; 0 beside all ways
    elsewhere[asked] = _fit_elsewhere(state, np.flatnonzero(asked))
    for k, way in ways.items():
        j, i, turn = way[:3]
        x, y, heading = reckoned[: j + 1].T.copy()
        between = np.ascontiguousarray(variance[i + 1 : j + 1, 1:])
        gate = (config.gate_sd * state.cell) ** 2, config.gate_heading**2
        apart = np.empty(max(j - state.guard, 1))
        ratio = log_ratio(x, y, heading, between, i, j, -turn, gate, apart)
        found.odometry_ratio[k] = min(float(ratio), MOST)
        reach = EXTENT + way.last - way.first + BEYOND
        end = max(min(way.match + reach, way.middle - state.guard), way.match) + 1
        older = slice(max(way.match - reach, 0), end)
        before = max(way.first - state.guard, way.match) + 1
        moved = motion[way.low : way.high], variance[way.low : way.high]
        for g, (ground, begins) in enumerate(((state.pose.rows[:before], 0), (reckoned[older], older.start))):
            found.counts[k, g] = _count_views(state, way, *moved, elsewhere, ground, begins)
    return found


class _Way(NamedTuple):
    """The keyframes from `low` to before `high` whose views count, those of the sequence from `first` to
    `last`; keyframe `middle` is claimed to be where `match` was, turned by `turn`, rad."""

    middle: int
    match: int
    turn: float
    low: int
    high: int
    first: int
    last: int


def _ways(state: MapState, sequences: np.ndarray, after: int) -> dict[int, _Way]:
    """The ways of sequences [n], by their row; none of those that join keyframes between which the odometry
    is broken."""
    table, breaks = state.log.table(), np.flatnonzero(state.is_broken())
    order = np.argsort(table[:, 5], kind="stable")
    begin, end = np.searchsorted(table[order, 5], np.stack([sequences, sequences + 1]))
    ways = {}
    for k in range(len(sequences)):
        rows = table[order[begin[k] : end[k]]]
        middle, match, shift = rows[len(rows) // 2, :3].astype(int).tolist()
        part, of_match = np.searchsorted(breaks, [middle, match], side="right").tolist()
        if part == of_match:
            first, last = int(rows[0, 0]), int(rows[-1, 0])
            low = max(first - BEYOND, int(breaks[part - 1]) if part else 0)
            high = min(last + after + 1, int(breaks[part]) if part < len(breaks) else state.count)
            turn = -shift * state.sector_angle
            ways[k] = _Way(middle, match, turn, low, high, max(first, low), min(last, high - 1))
    return ways


def _fit_elsewhere(state: MapState, frames: np.ndarray) -> np.ndarray:
    """[n] log of the mean likelihood of the views of keyframes [n] at up to `CONTROLS` keyframes elsewhere,
    in turn seen ahead and, where half turns are compared, from the opposite direction."""
    others = np.unique(np.linspace(0, state.count - 1, CONTROLS).astype(int))
    shape = len(frames), len(others)
    row, control = (each.ravel() for each in np.indices(shape))
    reversed = (control % 2 > 0) & state.half_turns
    odds = state.log_odds(frames[row], others[control], reversed).reshape(shape)
    away = np.abs(others - frames[:, None]) > state.guard
    mean = np.where(away, np.exp(odds), 0.0).sum(axis=1) / np.maximum(away.sum(axis=1), 1)
    return np.where(mean > 0, np.log(np.where(mean > 0, mean, 1.0)), 0.0)


def _count_views(
    state: MapState,
    way: _Way,
    motion: np.ndarray,
    variance: np.ndarray,
    elsewhere: np.ndarray,
    ground: np.ndarray,
    begins: int,
) -> np.ndarray:
    """[2, KINDS] of `SequenceEvidence`, over keyframes from number `begins` on at the poses `ground`.

    Args:
        motion, variance: [W, 3] of the odometry into each keyframe of the way. elsewhere: [N] see
            `_fit_elsewhere`.
    """
    start = ground[way.match - begins] + [0.0, 0.0, way.turn]
    reach, turns = REACH * state.cell, np.arange(1 + state.half_turns) * np.pi
    middle, lag, spread = way.middle - way.low, way.low - begins, state.closure_variance()
    back = inverse(motion[middle:0:-1])
    path = np.concatenate([integrate(back, start)[::-1], start[None], integrate(motion[middle + 1 :], start)])
    limits = (STRAY + MOST_REACH) * reach, MOST_REACH_HEADING * REACH_HEADING * 1.5
    frame, other, turned = _pairs(path, ground, turns, *limits, lag, state.guard)
    is_compared = np.zeros(len(ground), bool)
    is_compared[other] = True
    compared, column = np.flatnonzero(is_compared), np.cumsum(is_compared) - 1
    gains = np.full((len(path), len(turns), len(compared)), -np.inf)
    gains[frame, turned, column[other]] = (
        state.log_odds(frame + way.low, other + begins, turned > 0) - elsewhere[frame + way.low]
    )
    on = ground[compared], turns, gains
    kinds = np.empty(len(path), int)
    stays = np.zeros((1, 3))
    for frames, motions, variances in (
        (np.arange(middle, len(path)), [stays, motion[middle + 1 :]], [stays, variance[middle + 1 :]]),
        (np.arange(middle - 1, -1, -1), [back], [variance[middle:0:-1]]),
    ):
        moves = np.concatenate(motions), np.concatenate(variances)
        pose, _, best, _ = follow_track(
            *on, frames, *moves, spread, reach, REACH_HEADING, EVEN.edges, EVEN.odds, -np.inf, start
        )
        kinds[frames] = _kinds(*on, frames, pose, best, ground, reach, lag, state.guard)
    within = np.zeros(len(path), bool)
    within[way.first - way.low : way.last + 1 - way.low] = True
    return np.stack([np.bincount(kinds[part & (kinds >= 0)], minlength=KINDS) for part in (within, ~within)])


@compiled
def _pairs(
    path: np.ndarray, ground: np.ndarray, turns: np.ndarray, reach: float, turn: float, lag: int, guard: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which keyframes [n] of a path are within reach of which [n] of the ground, seen at which turn [n]; in
    the order of the path. Keyframes of nearly the same time are left out.

    Args:
        lag: number of the first keyframe of the path, counted from the first of the ground.
    """
    capacity, count = 256, 0
    found = np.empty((3, capacity), np.int64)
    close, around = np.empty(len(ground), np.int64), 0  # those in the box around a part of the path
    close_x, close_y = np.empty(len(ground)), np.empty(len(ground))
    apart = np.empty(len(ground))
    for k in range(len(path)):
        if k % BOX == 0:  # the keyframes in the box around the next `BOX` poses of the path
            left, right, below, above, around = np.inf, -np.inf, np.inf, -np.inf, 0
            for at in range(k, min(k + BOX, len(path))):
                left, right = min(left, path[at, 0] - reach), max(right, path[at, 0] + reach)
                below, above = min(below, path[at, 1] - reach), max(above, path[at, 1] + reach)
            for g in range(len(ground)):
                x, y = ground[g, 0], ground[g, 1]
                close[around], close_x[around], close_y[around] = g, x, y
                around += int((x >= left) & (x <= right) & (y >= below) & (y <= above))
        for near in range(around):  # squared distances; a loop of its own is vectorised
            apart[near] = (close_x[near] - path[k, 0]) ** 2 + (close_y[near] - path[k, 1]) ** 2
        for near in range(around):
            g = close[near]
            if apart[near] >= reach * reach or abs(g - k - lag) <= guard:
                continue
            for s in range(len(turns)):
                angle = (ground[g, 2] + turns[s] - path[k, 2]) / (2 * np.pi)
                if 2 * np.pi * abs(angle - np.rint(angle)) < turn:  # faster than `wrapped`
                    if count == capacity:
                        more = np.empty((3, 2 * capacity), np.int64)
                        more[:, :count] = found
                        found, capacity = more, 2 * capacity
                    found[0, count], found[1, count], found[2, count] = k, g, s
                    count += 1
    return found[0, :count].copy(), found[1, :count].copy(), found[2, :count].copy()


@compiled
def _is_apart(pose: np.ndarray, ground: np.ndarray, reach: float, frame: int, guard: int) -> bool:
    """Whether no keyframe of the ground is within `reach`, m, but those of nearly the same time as number
    `frame` of it."""
    for g in range(len(ground)):
        x, y = ground[g, 0] - pose[0], ground[g, 1] - pose[1]
        if x * x + y * y < reach * reach and abs(g - frame) > guard:
            return False
    return True


@compiled
def _kinds(
    compared: np.ndarray, turns: np.ndarray, gains: np.ndarray, frames: np.ndarray, poses: np.ndarray,
    best: np.ndarray, ground: np.ndarray, reach: float, lag: int, guard: int,
) -> np.ndarray:  # fmt: skip
    """[n] kind of each view, -1 for none.

    Args:
        compared, turns, gains, frames: see `follow_track`. poses: [n, 3] before each view. best: [n] its best
            gain there. lag: number of the first keyframe of the way, counted from the first of the ground.
    """
    kinds = np.full(len(frames), -1)
    for k in range(len(frames)):
        frame = frames[k]
        at_keyframe = compare_view(compared, turns, gains[frame], poses[k], reach / 2, REACH_HEADING / 2)[0]
        if not np.isnan(at_keyframe):
            kinds[k] = np.searchsorted(EDGES, best[k])
        elif _is_apart(poses[k], ground, reach, frame + lag, guard):
            kinds[k] = len(EDGES) + 2
        elif best[k] < EDGES[0]:
            kinds[k] = 0
        elif np.isnan(best[k]) or best[k] < 0:
            kinds[k] = len(EDGES) + 1
    return kinds
