"""The Experience Metric: the rates of re-localisation (ARR) and of correct re-localisation (ARCR), from a log
of the current experience and the true pose at each step.

Source: Salman & Pearson 2016, Algorithm 1; "line" below is a line of it. As printed, its ARCR is always 0
(the set of correct re-localisations only grows from its own members), so there are four modes with one ARR:

    strict   the verdict on the first step of a visit holds for the visit; the pose of an experience is the
             one at its creation; a new experience is valid if the last re-localisation was correct
    paper    the printed listing with line 26 corrected in analogy to lines 10 and 11
    or       line 26 with "or": a wrong visit counts as correct from its second step; for comparison only
    literal  the printed listing
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from pydantic import NonNegativeInt, PositiveFloat

from tactile.base.bounded import read_text_table
from tactile.base.errors import InputError
from tactile.base.se2 import wrap
from tactile.base.settings import Settings

_COLUMNS = {
    "time": ("t", "timestamp", "stamp"),
    "experience": ("id", "experience id", "experience_id", "exp", "place"),
    "x": ("true_x", "gt_x", "truth_x"),
    "y": ("true_y", "gt_y", "truth_y"),
    "theta": ("th", "heading", "yaw", "true_th", "true_theta", "gt_th", "gt_theta", "truth_th",
              "truth_theta"),
}  # fmt: skip


def read_experience_log(path: str | Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The log of any SLAM system that reports its place: a CSV with a row per step of time (s), experience
    id, true x (m), y (m) and heading (rad).

    Column names may be `t` or `time`, `id` or `experience`, `theta`, `th` or `heading`, and so on; without a
    header the columns are in this order.

    Returns:
        time: [N] s. experience: [N] ids, -1 where there was none. truth: [N, 3] true pose, m, m, rad.

    Raises:
        InputError: a line is malformed, or an id is not a whole number.
    """
    values, line = read_text_table(path, _COLUMNS)
    time, experience, x, y, theta = values.T
    broken = np.flatnonzero((experience != np.round(experience)) | (np.abs(experience) > 2**53))
    if len(broken):
        where, found = f"{path}:{line[broken[0]]}", f"experience id {experience[broken[0]]:g}"
        raise InputError(where, found, "a whole number of at most 2^53, -1 for none")
    return time, experience.astype(np.int64), np.stack([x, y, theta], axis=1)


def change_rows(experience: np.ndarray) -> np.ndarray:
    """The steps [M] at which the current experience changes, including the first step.

    They turn a per-step log into a per-action log. Steps with id -1 (no experience) are skipped.
    """
    rows = np.flatnonzero(np.asarray(experience) != -1)
    ids = np.asarray(experience)[rows]
    return rows[np.concatenate([[True], ids[1:] != ids[:-1]])] if len(rows) else rows


def creation_rows(experience: np.ndarray) -> np.ndarray:
    """For each step [N], the first step with the same experience."""
    _, first, code = np.unique(experience, return_index=True, return_inverse=True)
    return first[code]


ExmMode = Literal["strict", "paper", "or", "literal"]
EXM_MODES: tuple[ExmMode, ...] = ("strict", "paper", "or", "literal")

NO_RELOCALISATION = "no re-localisation: ARCR is 0/0"
LITERAL_WARNING = "0 by construction: the printed line 26 never holds"


class ExmConfig(Settings):
    """Settings of Algorithm 1."""

    mode: ExmMode = "strict"
    """Reading of the listing (see the module)."""
    log: Literal["step", "action"] = "step"
    """One entry per step (the paper's) or per change of experience; their values are not comparable."""
    base: NonNegativeInt | None = None
    """Number of steps in the base set (i_base); null: up to the first return to the start."""
    position: PositiveFloat = 0.1
    """Position threshold, m (Salman & Pearson 2016, section III-G)."""
    heading_deg: PositiveFloat = 25.0
    """Heading threshold, degrees (same source)."""


DEFAULT_EXM = ExmConfig()
_OfEntries = Callable[[np.ndarray], np.ndarray]


class ExperienceMetric(NamedTuple):
    """ARR and ARCR of one run with their counts.

    Attributes:
        arr: re-localisations / entries after the base set; NaN without entries.
        arcr: correct re-localisations / re-localisations; NaN without re-localisations.
        entries: after the base set. relocalisations: eta. correct: eta_c.
        base: entries in the base set, in the log used.
        note: reason for NaN, or a warning ('' for none).
        counted, right: [N] bool, the entry is a re-localisation; a correct one.
        near: [N] bool, true and perceived pose are within the thresholds (line 24; where `counted`).
    """

    arr: float
    arcr: float
    entries: int
    relocalisations: int
    correct: int
    base: int
    note: str
    counted: np.ndarray
    right: np.ndarray
    near: np.ndarray

    @property
    def arcr_chain_free(self) -> float:
        """Share of the re-localisations that are near the truth, whether or not earlier ones were correct.

        NaN without re-localisations.
        """
        return float(self.near[self.counted].mean()) if self.counted.any() else np.nan


def experience_metric(
    experience: np.ndarray, truth: np.ndarray, config: ExmConfig = DEFAULT_EXM
) -> ExperienceMetric:
    """ARR and ARCR of one run (Algorithm 1).

    Args:
        experience: [N] id of the current experience at each step, -1 for none (such steps are skipped).
            Renumbering does not change the result.
        truth: [N, 3] true poses, m, m, rad.

    Raises:
        InputError: the logs differ in length, a true pose is not finite, the base set is out of range, or
            none is given and the run never returns to its start.
    """
    experience, truth = np.asarray(experience), np.asarray(truth, float)
    if experience.ndim != 1 or len(experience) == 0 or truth.shape != (len(experience), 3):
        found = f"shapes {experience.shape} and {truth.shape}"
        raise InputError("experience log", found, "[N] and [N, 3], N at least 1")
    if not np.isfinite(truth).all():
        row = int(np.argmin(np.isfinite(truth).all(axis=1)))
        raise InputError(f"true trajectory, row {row}", f"{truth[row]}", "finite numbers", "remove such rows")
    end = base_end(truth, config.position, config.heading_deg) if config.base is None else config.base
    rows = change_rows(experience) if config.log == "action" else np.flatnonzero(experience != -1)
    base = int(np.searchsorted(rows, _check_base(end, len(experience))))
    perceived_by, turned, _, _ = _READINGS[config.mode]
    ids, poses = experience[rows], truth[rows]
    counted = relocalisations(ids, base)
    # Lines 16 to 24 without the valid set.
    perceived = poses[perceived_by(ids)]
    distance = np.hypot(*(poses - perceived)[:, :2].T)
    turn = np.abs(turned(poses[:, 2] - perceived[:, 2]))
    near = (distance < config.position) & (turn < np.radians(config.heading_deg))
    right = _correct(ids, base, counted, near, config.mode)
    eta, eta_c, entries = int(counted.sum()), int(right.sum()), len(ids) - base
    notes = [LITERAL_WARNING] if config.mode == "literal" else []
    notes += [] if entries else ["no entry after the base set: ARR is 0/0"]
    note = "; ".join(notes + ([] if eta else [NO_RELOCALISATION]))
    arr, arcr = eta / entries if entries else np.nan, eta_c / eta if eta else np.nan
    counts = entries, eta, eta_c, base
    return ExperienceMetric(arr, arcr, *counts, note, counted, right, near)


def relocalisations(experience: np.ndarray, base: int) -> np.ndarray:
    """Which entries are re-localisations: [N] bool (lines 9 to 15; needs no truth).

    In closed form: the entries of an experience count from the first one after the base set that returns
    to it, that is, whose previous entry is another experience and which was not created there.

    Args:
        experience: [N] ids. base: entries in the base set.
    """
    base = _check_base(base, len(experience))
    entry = np.arange(len(experience))
    _, code = np.unique(experience, return_inverse=True)
    returns = (entry >= base) & (creation_rows(experience) < entry) & ~_dwell(experience)
    since = np.full(len(experience) + 1, len(experience))
    np.minimum.at(since, code[returns], entry[returns])
    return entry >= since[code]


def base_end(truth: np.ndarray, position: float = 0.1, heading_deg: float = 25.0) -> int:
    """The default end of the base set: the row of the first return to the start pose.

    A return counts if the robot has left the start's surroundings and travelled more than half the length of
    the first loop. A loop through the farthest point is at least twice as long as that point is far from the
    start, so its distance stands for half a loop; turning around near the start is thus not a loop.

    Args:
        truth: [N, 3] true poses. position, heading_deg: thresholds of a return, m and degrees.

    Raises:
        InputError: the run never returns.
    """
    away = np.hypot(truth[:, 0] - truth[0, 0], truth[:, 1] - truth[0, 1])
    turned = np.abs(wrap(truth[:, 2] - truth[0, 2]))
    near = (away < position) & (turned < np.radians(heading_deg))
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    left = np.logical_or.accumulate(~near)
    back = np.flatnonzero(near & left & (way > away.max()))
    if len(back) == 0:
        where = f"within {position} m and {heading_deg} degrees of its start"
        cure = "set `base`, the end of the base set"
        raise InputError("true trajectory", f"never returns {where}", "a closed loop", cure)
    return int(back[0])


def _check_base(base: int, length: int) -> int:
    if not 0 <= base <= length:
        raise InputError("i_base", str(base), f"0 to {length}, the length of the log")
    return base


def _dwell(experience: np.ndarray) -> np.ndarray:
    """Whether each entry [N] equals the previous one."""
    return np.concatenate([[False], experience[1:] == experience[:-1]])


def _last_entry(experience: np.ndarray) -> np.ndarray:
    """For each entry [N] the last earlier one with the same id, or itself."""
    order = np.argsort(experience, kind="stable")
    last = np.arange(len(experience))
    again = _dwell(experience[order])
    last[order[again]] = order[np.flatnonzero(again) - 1]
    return last


def _correct(ids: np.ndarray, base: int, counted: np.ndarray, near: np.ndarray, mode: ExmMode) -> np.ndarray:
    """Which re-localisations are correct: [N] bool (lines 15 to 38).

    One sequential pass, because a verdict determines which experiences are valid later.
    """
    _, _, correct, back = _READINGS[mode]
    ids_, dwell = ids.tolist(), _dwell(ids).tolist()
    novel = (creation_rows(ids) == np.arange(len(ids))).tolist()
    counted_, near_ = counted.tolist(), near.tolist()
    valid = set(ids_[:base])
    right = [False] * len(ids_)
    sound = True  # the listing's r_c: the last re-localisation was correct
    for i in range(base, len(ids_)):
        if counted_[i]:
            sound = right[i] = correct(near_[i] and ids_[i] in valid, dwell[i], right[i - 1])
        if sound and (i > 0 if back else novel[i]):
            valid.add(ids_[i - back])
    return np.array(right, bool)


# The listing tests membership in R_c, the experiences re-localised correctly so far. In a dwell this is read
# as the verdict on the previous entry: if R_c only grew, one correct visit would make all later ones correct.
_READINGS: dict[ExmMode, tuple[_OfEntries, _OfEntries, Callable[[bool, bool, bool], bool], int]] = {
    "strict": (creation_rows, wrap, lambda near, dwell, before: before if dwell else near, 0),
    "paper": (_last_entry, wrap, lambda near, dwell, before: near and not (dwell and not before), 1),
    "or": (_last_entry, wrap, lambda near, dwell, before: near or (dwell and before), 1),
    "literal": (_last_entry, np.asarray, lambda near, dwell, before: near and dwell and before, 1),
}
"""The parts of the listing that differ between modes: ids [N] -> [N], the entry whose true pose an entry is
compared with (lines 18 to 21); heading difference -> the angle that is compared (line 23); (line 24 holds,
this is a dwell step, verdict on the entry before) -> verdict (line 26); 1 if the experience of the entry
before becomes valid, 0 if that of this entry does when it is new (lines 34 to 37)."""
