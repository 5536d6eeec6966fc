"""File `changes.csv`: places at which a localised session does not agree with the map."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tactile.base.bounded import read_rows

NAME = "changes.csv"
COLUMNS = ("x", "y", "extent", "kind", "evidence", "alarms", "passes", "first_step", "last_step")
"""m, m, m; `new`, `gone` or `different`; nat; expected number by chance; number of passes; steps of the
session that contradict."""

NUMBERS = ("x", "y", "extent", "evidence", "alarms")


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

    def describe(self) -> str:
        """The place in one line."""
        what = {"new": "something new", "gone": "something gone"}.get(self.kind, "something different")
        return (
            f"changed: {what} at ({self.x:.2f}, {self.y:.2f}) m, {self.extent:.2f} m long, "
            f"{self.passes} passes, steps {self.first_step} to {self.last_step}, "
            f"evidence {self.evidence:.0f} nat"
        )


def write_changes(path: Path, changes: Sequence[ChangeRow]) -> None:
    """Writes the places, the surest first."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(changes)


def read_changes(path: Path) -> list[ChangeRow]:
    """Reads the places.

    Raises:
        InputError: a line is malformed.
    """
    return read_rows(path, f"the columns {', '.join(COLUMNS)}", _parse)


def _parse(line: Mapping[str, str]) -> ChangeRow:
    x, y, extent, evidence, alarms = (float(line[name]) for name in NUMBERS)
    if not np.isfinite([x, y, extent, evidence, alarms]).all():
        raise ValueError("a number that is not finite")
    passes, first, last = (int(np.int32(line[name])) for name in ("passes", "first_step", "last_step"))
    return ChangeRow(x, y, extent, str(line["kind"]), evidence, alarms, passes, first, last)
