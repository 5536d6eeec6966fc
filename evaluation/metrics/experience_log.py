"""The experience log: the current experience and the true pose at each step."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.metrics.text_table import read_text_table
from tactile.base.errors import InputError

_COLUMNS = {
    "time": ("t", "timestamp", "stamp"),
    "experience": ("id", "experience id", "experience_id", "exp", "place"),
    "x": ("true_x", "gt_x", "truth_x"),
    "y": ("true_y", "gt_y", "truth_y"),
    "theta": (
        "th",
        "heading",
        "yaw",
        *(f"{prefix}_{th}" for prefix in ("true", "gt", "truth") for th in ("th", "theta")),
    ),
}


class ExperienceLog(NamedTuple):
    """One row per step (whisk cycle, frame) of any SLAM system that reports its current place.

    Attributes:
        time: [N] s. experience: [N] int ids, -1 where there was none. truth: [N, 3] true pose, m, m, rad.
    """

    time: np.ndarray
    experience: np.ndarray
    truth: np.ndarray


def read_experience_log(path: str | Path) -> ExperienceLog:
    """A log from a CSV of time (s), experience id, true x (m), y (m) and heading (rad).

    Column names may be `t` or `time`, `id` or `experience`, `theta`, `th` or `heading`, and so on; without a
    header the columns are in this order.

    Raises:
        InputError: a line is malformed, or an id is not a whole number.
    """
    table = read_text_table(path, _COLUMNS)
    time, experience, x, y, theta = table.values.T
    broken = np.flatnonzero((experience != np.round(experience)) | (np.abs(experience) > 2**53))
    if len(broken):
        where, found = f"{path}:{table.line[broken[0]]}", f"experience id {experience[broken[0]]:g}"
        raise InputError(where, found, "a whole number of at most 2^53, -1 for none")
    return ExperienceLog(time, experience.astype(np.int64), np.stack([x, y, theta], axis=1))


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
