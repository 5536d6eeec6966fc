"""Crops a map: keyframes, views, odometry, closures, experiences and steps of a part of it remain."""

from __future__ import annotations

import numpy as np

from ratslam.core.arrays import with_prefix
from ratslam.mapping.experiences import Experiences
from ratslam.mapping.map import KeyframeMap
from ratslam.mapping.map_state import INTERRUPTED, MapState
from ratslam.mapping.merging import take_keyframes
from ratslam.mapping.step_record import NO_TRAVEL, StepRecord, Travel
from ratslam.recall.memory import CroppedRows, MergedRows
from tactile.base.se2 import between, compose, correct_heading, inverse

Arrays = dict[str, np.ndarray]
AFRESH = ("archive/", "merger/", "selection/", "tie_odds/")
"""Parts of a map that begin anew after a crop: what they hold is about keyframes that are gone."""


def keyframes_in_box(map: KeyframeMap, box: tuple[float, float, float, float]) -> np.ndarray:
    """[E] bool: keyframes in a box x0, y0, x1, y1 (m) of the final map."""
    x, y = map.solution().pose.rows[:, :2].T
    return (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])


def keyframes_of_steps(map: KeyframeMap, first: int, last: int) -> np.ndarray:
    """[E] bool: keyframes taken at the steps first to last - 1."""
    step = map.keyframe_steps()
    return (step >= first) & (step < last)


def keyframes_of_piece(map: KeyframeMap, piece: int) -> np.ndarray:
    """[E] bool: keyframes of a piece, numbered as `Map.pieces` does."""
    return map.pieces()[map.keyframe_steps()] == piece


def crop_map(map: KeyframeMap, blank: KeyframeMap, inside: np.ndarray) -> CroppedRows:
    """Reduces a map to some of its keyframes, and returns what the kernel needs to follow.

    Merged keyframes are restored, to be merged anew. Where keyframes are left out, odometry is interrupted:
    only closures join the parts, which are pieces without them. The robot stays where it was.

    Args:
        map: is changed. blank: an empty map of the same settings. inside: [E] bool, keyframes that remain, of
            all ever taken.

    Raises:
        ValueError: no keyframe remains.
    """
    taken = np.flatnonzero(inside)
    if not len(taken):
        raise ValueError("no keyframe remains")
    number = np.where(inside, np.cumsum(inside) - 1, -1)
    before, archive = map.state.taken.rows.copy(), map.state.merged
    row = archive.row.rows.copy() if archive else np.arange(map.state.count)
    state = map.solution().copy()
    state.reckoned = map.state.reckoned
    elsewhere = bool(state.begins.rows[taken[-1] + 1 :].any())
    since, last = NO_TRAVEL, int(taken[-1])
    if not elsewhere:  # the odometry from the last keyframe that remains to the newest one
        reckoned = state.dead_reckoned()
        sums = (float(values.rows[last + 1 :].sum()) for values in (state.length, state.turn))
        since = Travel(between(reckoned[last], reckoned[-1]), *sums)
    own = map.arrays()
    arrays = {name: value for name, value in own.items() if not name.startswith(AFRESH)}
    arrays |= {name: value for name, value in blank.arrays().items() if name.startswith(AFRESH)}
    experiences = Experiences(map.config.place_radius * map.cell, map.config.place_heading)
    experiences.restore(with_prefix(own, "experiences/"))
    experiences.take(row, before, number, state.pose.rows)
    state.steps, state.archive = StepRecord(), None
    state.steps.restore(with_prefix(own, "steps/"))
    state.steps.take(number)
    sequences = state.log.take(number)
    _take_keyframes(state, taken, sequences, since)
    if archive:
        arrays["merger/merge_due/0"] = np.array(map.config.merge_stood > 0)
    appearance = map.appearance
    views = appearance.stored(taken)
    appearance.take(taken)
    motion, length, turn = (own[f"travel/{k}"] for k in range(3))
    travel = compose(since.motion, motion), since.length + length, since.turn + turn
    arrays |= {f"travel/{k}": np.array(value) for k, value in enumerate(travel)}
    arrays |= {"solved/0": np.array(-1), "solved/1": np.array(-1)}
    arrays |= state.arrays() | {f"steps/{key}": value for key, value in state.steps.arrays().items()}
    for name, part in dict(experiences=experiences, appearance=appearance).items():
        arrays |= {f"{name}/{key}": value for key, value in part.arrays().items()}
    # The hypotheses of the selection begin at the first keyframe, so that the map stays where it was.
    arrays["selection/hypotheses/poses/0"] = state.pose.rows[None, :1].copy()
    compared = own.get("acceptance/log_ratio")  # with odometry, where the rule of acceptance does that
    if compared is not None:
        arrays["acceptance/log_ratio"] = compared[sequences[sequences < len(compared)]]
    map.restore(arrays)
    merged = MergedRows(row[taken], np.maximum(number[before], 0), np.zeros((len(before), 3)), *views)
    return CroppedRows(merged, inside[before], *since, elsewhere)


def _take_keyframes(state: MapState, taken: np.ndarray, sequences: np.ndarray, since: Travel) -> None:
    """Reduces a map to keyframes; odometry is interrupted where some are left out, and stays cut where the
    sequence that showed a break is gone."""
    start = state.start
    back = inverse(correct_heading(since.motion, since.length, start.bias, start.turn_error))
    state.reckoned = compose(state.reckoned, back)
    number = np.cumsum(state.begins.rows)[taken]
    skipped = take_keyframes(state, taken)
    state.begins.rows[1:] = np.diff(number) > 0  # also where the first keyframe of a piece is left out
    cut = state.cut.rows
    known = np.isin(cut, sequences)
    lost = (cut >= 0) & ~known
    cut[known] = np.searchsorted(sequences, cut[known])
    cut[lost] = INTERRUPTED
    cut[skipped] = np.where(state.begins.rows[skipped], -1, INTERRUPTED)
    cut[0], state.begins.rows[0] = -1, False
    state.taken.replace(np.arange(len(taken)))
