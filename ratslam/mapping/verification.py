"""Tests of closure candidates against the map, and breaks of the odometry.

A candidate continues a sequence if it moved in memory as odometry did. A sequence fits the map if its
squared Mahalanobis distance under the covariance of the map is small. Where the robot was carried, the
odometry is cut at the keyframe from which the views fit better at the poses that a closure sequence claims.
Sequences between pieces of the map, which no odometry joins, are recognised too.
"""

from __future__ import annotations

import numpy as np

from ratslam.mapping.loop_closures import Candidate, ClosureLog
from ratslam.mapping.map_state import MapState
from ratslam.mapping.optimizer import MapCovariance
from tactile.base.se2 import between, compose, wrap


def turn_on_spot(pose: np.ndarray, angle: float) -> np.ndarray:
    """The pose [3] turned on the spot by `angle`, rad."""
    return compose(pose, np.array([0.0, 0.0, angle]))


def continues_sequence(state: MapState, candidate: Candidate) -> bool:
    """Whether the candidate moved from the newest one by the same motion in memory as in odometry."""
    last, config = state.log.last(), state.config
    if last is None or candidate.keyframe - last.keyframe > config.max_gap:
        return False
    remembered, travelled = _motions(state, last, candidate)
    apart = np.hypot(*(remembered - travelled)[:2])
    allowed = config.agreement * state.cell + 0.1 * np.hypot(*travelled[:2])
    if not (apart < allowed and abs(wrap(remembered[2] - travelled[2])) < config.agreement_heading):
        return False
    if not config.sequence_agreement:
        return True
    # The motion from the first member of the newest sequence has to agree with odometry too.
    frame, match, shift, _ = state.log.members(state.log.sequences - 1)[0]
    remembered, travelled = _motions(state, Candidate(frame, match, shift, 0.0, 0.0), candidate)
    allowed = config.agreement * state.cell + config.sequence_agreement * np.hypot(*travelled[:2])
    rotation = abs(wrap(remembered[2] - travelled[2]))
    return bool(np.hypot(*(remembered - travelled)[:2]) < allowed and rotation < 2 * config.agreement_heading)


def has_same_heading(state: MapState, candidate: Candidate) -> bool:
    """Whether the headings of a closure agree by odometry: a robot that has turned is in another
    experience, even if its view changes little with heading."""
    pose, turn = state.pose.rows, -candidate.shift * state.sector_angle
    turned = wrap(pose[candidate.keyframe, 2] - pose[candidate.match, 2])
    drift = abs(wrap(turned - turn))
    return bool(np.cos(turn) > 0 and drift < state.config.agreement_heading * state.config.max_turn)


def judge_by_map(
    state: MapState, covariance: MapCovariance, member: np.ndarray
) -> tuple[float, float, float, float]:
    """How the map judges the place of a closure (keyframe, match, shift).

    Returns:
        log of the probability density that the map gives to the place, over its mean density at all
        keyframes that could be recalled; squared Mahalanobis distance from the place; largest standard
        deviations of the map's own relative pose, of position (m) and heading (rad).
    """
    j, i, shift = (int(value) for value in member[:3])
    config, poses, turn = state.config, state.pose.rows, -shift * state.sector_angle
    own = covariance.relative(i, j, turn)
    gate = config.gate_sd * state.cell
    allowed = own + np.diag([gate**2, gate**2, config.gate_heading**2])
    origin = turn_on_spot(poses[i], turn)
    claims = between(origin, compose(poses[: max(j - state.guard, i + 1)], np.array([0.0, 0.0, turn])))
    error = claims - between(origin, poses[j])
    error[:, 2] = wrap(error[:, 2])
    distance = np.einsum("na,ab,nb->n", error, np.linalg.inv(allowed), error)
    among = np.log(max(np.exp(-distance / 2).sum(), 1.0))
    ratio = np.log(len(error)) - distance[i] / 2 - among
    position, heading = np.sqrt(np.linalg.eigvalsh(own[:2, :2]).max()), np.sqrt(own[2, 2])
    return float(ratio), float(distance[i]), float(position), float(heading)


def _motions(state: MapState, first: Candidate, candidate: Candidate) -> tuple[np.ndarray, np.ndarray]:
    """[3] motion from one candidate to a later one: between the remembered poses, and in the map."""
    pose, angle = state.pose.rows, state.sector_angle
    start, end = (turn_on_spot(pose[one.match], -one.shift * angle) for one in (first, candidate))
    return between(start, end), between(pose[first.keyframe], pose[candidate.keyframe])


def map_distance(state: MapState, candidate: Candidate) -> float:
    """Squared Mahalanobis distance of the candidate's claim from the map."""
    turn = -candidate.shift * state.sector_angle
    pose = state.pose.rows
    error = between(turn_on_spot(pose[candidate.match], turn), pose[candidate.keyframe])
    gate = state.config.gate_sd * state.cell
    least = np.diag([gate**2, gate**2, state.config.gate_heading**2])
    allowed = state.covariance().relative(candidate.match, candidate.keyframe, turn) + least
    return float(error @ np.linalg.solve(allowed, error))


SEARCH = 400
"""Number of keyframes among which a break is searched."""


def find_break(
    state: MapState, poses: np.ndarray, onwards: np.ndarray, carried: np.ndarray, since: int
) -> int:
    """The keyframe before which the odometry is cut; see `closure_selection.FindCut`."""
    frames = np.arange(since + 1, since + 1 + len(onwards))[-SEARCH:]
    return find_turning_point(state, frames, poses, onwards[-SEARCH:], carried)


def find_turning_point(
    state: MapState, frames: np.ndarray, poses: np.ndarray, onwards: np.ndarray, carried: np.ndarray
) -> int:
    """The keyframe of `frames` [n] from which views fit better at the carried poses than at the odometry's.

    Args:
        poses: [N, 3] of older keyframes. onwards: [n, 3] poses of `frames` by odometry.
    """
    misfits = np.zeros((2, len(frames)))  # of the keyframes where they stay and where they are carried
    for row, own in zip(misfits, (onwards, compose(carried, onwards)), strict=True):
        for k, (frame, pose) in enumerate(zip(frames.tolist(), own, strict=True)):
            old = poses[: max(frame - state.guard, 0)]
            near = np.flatnonzero(np.hypot(*(old - pose)[:, :2].T) < 1.5 * state.cell)
            row[k] = state.least_misfit(frame, near, np.cos(old[near, 2] - pose[2]) < 0)
    stays, goes = misfits
    # With a break before frames[k], those before k stay and the others are carried.
    cost = np.concatenate([[0], np.cumsum(stays)[:-1]]) + np.cumsum(goes[::-1])[::-1]
    return int(frames[len(cost) - 1 - np.argmin(cost[::-1])])


def spans(piece: np.ndarray, log: ClosureLog) -> np.ndarray:
    """[R] bool: sequences that have a candidate between two pieces, of which each keyframe [N] is in one."""
    found, table = np.zeros(log.sequences, bool), log.table()
    table = table[table[:, 5] >= 0]
    later, earlier, sequence = table[:, [0, 1, 5]].astype(int).T
    found[sequence[piece[later] != piece[earlier]]] = True
    return found
