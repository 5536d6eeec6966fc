"""File `closures.csv`: all loop closures that a map considered, with their evidence and verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.artifacts.run_reader import first_step
from tactile.base.bounded import read_rows

ACCEPTED = "accepted"
"""Verdict on the closures of the map."""
KEYS = ("step", "match_step", "verdict")
"""Columns that every closures.csv has; a map may add columns of numbers."""


class ClosureTable(NamedTuple):
    """The closures of a run, n of them, in the order of the file.

    Attributes:
        steps: [n, 2] the earlier and the later step that a closure joins, counted from the first step of
            this run: negative in the run that this one continues.
        verdicts: [n] `accepted`, or why it is no closure of the map.
        evidence: the other columns, [n] each, by name.
    """

    steps: np.ndarray
    verdicts: list[str]
    evidence: Mapping[str, np.ndarray]

    def accepted(self) -> np.ndarray:
        """[n] bool, which are closures of the map."""
        return np.array([verdict == ACCEPTED for verdict in self.verdicts], bool)


def read_closure_table(directory: Path) -> ClosureTable:
    """Reads the closures of a run directory; none without the file.

    Raises:
        InputError: a line is malformed.
    """
    file = directory / "closures.csv"
    if not file.exists():
        return ClosureTable(np.zeros((0, 2), int), [], {})
    expected = "the columns step, match_step, verdict, and numbers in all others"
    rows = read_rows(file, expected, _parse)
    names = list(rows[0][2]) if rows else []
    steps, verdicts, evidence = zip(*rows, strict=True) if rows else ((), (), ())
    columns = np.array([list(cells.values()) for cells in evidence], float).reshape(len(rows), len(names)).T
    counted = np.array(steps, int).reshape(-1, 2) - first_step(directory)
    return ClosureTable(counted, list(verdicts), dict(zip(names, columns, strict=True)))


def _parse(row: Mapping[str, str]) -> tuple[list[int], str, dict[str, float]]:
    steps = [int(np.int32(row[name])) for name in ("match_step", "step")]
    return steps, str(row["verdict"]), {name: float(row[name]) for name in row if name not in KEYS}


def read_closures(directory: Path) -> np.ndarray:
    """The pairs of steps [n, 2] of this run that are joined by accepted closures; n is 0 without the file.

    Raises:
        InputError: a line is malformed.
    """
    table = read_closure_table(directory)
    return table.steps[table.accepted() & (table.steps >= 0).all(axis=1)]


def write_closure_pairs(path: Path, pairs: np.ndarray) -> None:
    """Writes accepted closures without evidence: pairs [n, 2] of steps, the later and the earlier."""
    lines = (f"{later},{earlier},{ACCEPTED}\n" for later, earlier in pairs.tolist())
    Path(path).write_text("".join([",".join(KEYS) + "\n", *lines]), encoding="utf-8")


class Closures(NamedTuple):
    """Loop closures of a run: proposed and accepted ones, and sequences of both."""

    proposed: int
    accepted: int
    sequences: int
    accepted_sequences: int


def count_closures(path: Path) -> Closures | None:
    """The loop closures in closures.csv; None if there are none, as of a method that proposes none."""
    if not (path / "closures.csv").exists():
        return None
    table = read_closure_table(path)
    accepted = table.accepted()
    sequence = table.evidence.get("sequence", np.arange(len(accepted)))
    return Closures(
        len(accepted), int(accepted.sum()), len(np.unique(sequence)), len(np.unique(sequence[accepted]))
    )
