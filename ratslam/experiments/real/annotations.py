"""Stretches of a record marked as contact, free or unclear by annotators, and scores against them."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tactile.base.errors import InputError

FOLDER = Path(__file__).with_name("annotations")
"""A CSV file for each annotator: whisker, start_row, end_row (exclusive), label; it covers every row of every
whisker."""


class Label(IntEnum):
    """A mark of an annotator."""

    FREE = 0
    CONTACT = 1
    UNCLEAR = 2


class Score(NamedTuple):
    """Contacts found against marks. A figure without rows to divide by is NaN.

    Attributes:
        precision, recall: of the rows that are clear. strict_precision, strict_recall: of all rows, every
            unclear one counted as wrong. unclear: share of unclear rows.
    """

    precision: float
    recall: float
    strict_precision: float
    strict_recall: float
    unclear: float


def read_annotation(path: Path, whiskers: Sequence[str], rows: int) -> np.ndarray:
    """[rows, W] int8, the `Label` of each row.

    Raises:
        InputError: the file is not such a table, or marks a row twice or not at all.
    """
    with path.open(encoding="utf-8", newline="") as file:
        table = csv.DictReader(file)
        if set(table.fieldnames or ()) != {"whisker", "start_row", "end_row", "label"}:
            raise InputError(str(path), f"columns {table.fieldnames}", "whisker, start_row, end_row, label")
        stretches = list(table)
    marks = np.full((rows, len(whiskers)), -1, np.int8)
    for line, stretch in enumerate(stretches, start=2):
        where = f"{path}:{line}"
        try:
            column, label = whiskers.index(stretch["whisker"]), Label[stretch["label"].upper()]
            first, last = int(stretch["start_row"]), int(stretch["end_row"])
        except (ValueError, KeyError, AttributeError, TypeError):
            expected = f"one of {', '.join(whiskers)}, two row numbers, and contact, free or unclear"
            raise InputError(where, str(stretch), expected) from None
        if not 0 <= first < last <= rows or (marks[first:last, column] >= 0).any():
            raise InputError(where, f"rows {first} to {last}", f"unmarked rows between 0 and {rows}")
        marks[first:last, column] = label
    if (gap := np.argwhere(marks < 0)).size:
        found = f"row {gap[0][0]} of {whiskers[gap[0][1]]} is not marked"
        raise InputError(str(path), found, "a label for every row of every whisker")
    return marks


def read_annotators(folder: Path, whiskers: Sequence[str], rows: int) -> dict[str, np.ndarray]:
    """The marks [rows, W] of each annotator; none where the folder has no CSV file."""
    return {path.stem: read_annotation(path, whiskers, rows) for path in sorted(folder.glob("*.csv"))}


def merge_marks(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The marks on which two annotators agree; unclear where they differ or either says so."""
    return np.where(first == second, first, Label.UNCLEAR)


def score_contacts(contact: np.ndarray, marks: np.ndarray) -> Score:
    """Scores contacts found, [...] bool, against marks of the same shape."""
    unclear = marks == Label.UNCLEAR
    right = int((contact & (marks == Label.CONTACT)).sum())
    false, missed = (
        int(wrong.sum()) for wrong in (contact & (marks == Label.FREE), ~contact & (marks == Label.CONTACT))
    )
    doubtful, silent = int((contact & unclear).sum()), int((~contact & unclear).sum())
    return Score(
        precision=_share(right, right + false),
        recall=_share(right, right + missed),
        strict_precision=_share(right, right + false + doubtful),
        strict_recall=_share(right, right + missed + silent),
        unclear=float(unclear.mean()),
    )


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
