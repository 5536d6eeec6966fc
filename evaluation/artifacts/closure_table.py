"""Two tables of a run directory.

`closures.csv`: all loop closures that a map considered, with their evidence and verdicts.
`changes.csv`: places at which a session localised in a map does not agree with it.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
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

    def parse(row: Mapping[str, str]) -> tuple[list[int], str, dict[str, float]]:
        pair = [int(np.int32(row[name])) for name in ("match_step", "step")]
        return pair, str(row["verdict"]), {name: float(row[name]) for name in row if name not in KEYS}

    rows = read_rows(file, "the columns step, match_step, verdict, and numbers in all others", parse)
    names = rows[0][2] if rows else {}
    evidence = {name: np.array([cells[name] for _, _, cells in rows]) for name in names}
    steps = np.array([pair for pair, _, _ in rows], int).reshape(-1, 2) - first_step(directory)
    return ClosureTable(steps, [verdict for _, verdict, _ in rows], evidence)


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
    sequences = len(np.unique(sequence)), len(np.unique(sequence[accepted]))
    return Closures(len(accepted), int(accepted.sum()), *sequences)


CHANGES = "changes.csv"
COLUMNS = ("x", "y", "extent", "kind", "evidence", "alarms", "passes", "first_step", "last_step")
"""m, m, m; `new`, `gone` or `different`; nat; expected number by chance; number of passes; steps of the
session that contradict."""


class ChangeRow(NamedTuple):
    """One place, see `COLUMNS`."""

    x: float
    y: float
    extent: float
    kind: str
    evidence: float
    alarms: float
    passes: int
    first_step: int
    last_step: int

    @classmethod
    def parse(cls, line: Mapping[str, str]) -> ChangeRow:
        """The place of a line of the file; a ValueError for a line that is malformed."""
        numbers = [float(line[name]) for name in ("x", "y", "extent", "evidence", "alarms")]
        if not np.isfinite(numbers).all():
            raise ValueError("a number that is not finite")
        x, y, extent, evidence, alarms = numbers
        passes, first, last = (int(np.int32(line[name])) for name in ("passes", "first_step", "last_step"))
        return cls(x, y, extent, str(line["kind"]), evidence, alarms, passes, first, last)

    def describe(self) -> str:
        """The place in one line."""
        what = {"new": "something new", "gone": "something gone"}.get(self.kind, "something different")
        where = f"({self.x:.2f}, {self.y:.2f}) m, {self.extent:.2f} m long"
        when = f"{self.passes} passes, steps {self.first_step} to {self.last_step}"
        return f"changed: {what} at {where}, {when}, evidence {self.evidence:.0f} nat"


def write_changes(path: Path, changes: Sequence[ChangeRow]) -> None:
    """Writes the places, the surest first."""
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *changes])


def read_changes(path: Path) -> list[ChangeRow]:
    """Reads the places.

    Raises:
        InputError: a line is malformed.
    """
    return read_rows(path, f"the columns {', '.join(COLUMNS)}", ChangeRow.parse)
