"""Text files of numbers: one row per line, separated by commas or blanks, with or without a header."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tactile.base.bounded import read_text
from tactile.base.errors import InputError

LONGEST = 80
"""Characters of a bad row that an error shows."""
LARGEST = 1e20
"""Magnitude above which a number is damage: squares of others do not overflow."""
Columns = Mapping[str, tuple[str, ...]]
"""Columns to read, in order: name -> alternative names in a header (compared in lower case)."""


def read_text_table(path: str | Path, columns: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Reads columns of a file: the values [N, columns] float64 of its rows and their line numbers [N] from 1.

    A first line that is not all numbers is a header; other columns of the file are ignored. A file without a
    header holds exactly these columns in this order. Blank lines and lines that begin with `#` are skipped. A
    last line without a newline (a recording that was cut off) is dropped if it is not a complete row.

    Raises:
        InputError: the file cannot be read, lacks a column or has a malformed row (with file and line).
    """
    every = list(enumerate(read_text(path, "a text file of numbers").split("\n"), start=1))
    lines = [(number, line) for number, line in every if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise InputError(str(path), "no rows", f"lines of {' '.join(columns)}")
    fields = _cells(lines[0][1])
    header = _numbers(fields) is None
    names = [name.lower() for name in fields] if header else list(columns)
    known = {column: (column, *others) for column, others in columns.items()}
    found = [[names.index(name) for name in each if name in names] for each in known.values()]
    missing = [column for column, at in zip(columns, found, strict=True) if not at]
    if missing:
        lack = f"no column {', '.join(missing)} among {' '.join(names)}"
        wanted = "; ".join("/".join(known[column]) for column in missing)
        raise InputError(f"{path}:{lines[0][0]}", lack, wanted)
    rows, at = [], []
    for number, line in lines[header:]:
        cells = _cells(line)
        row = _numbers(cells)
        if row is not None and len(row) == len(names) and all(abs(value) <= LARGEST for value in row):
            rows.append([row[places[0]] for places in found])
            at.append(number)
        elif number < len(every):  # the line ends with a newline
            shown = f"'{' '.join(cells)[:LONGEST]}'"
            raise InputError(f"{path}:{number}", shown, f"{len(names)} finite numbers: {' '.join(names)}")
    if not rows:
        raise InputError(str(path), "no rows", f"lines of {' '.join(columns)}")
    return np.array(rows), np.array(at)


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split(",")] if "," in line else line.split()


def _numbers(cells: list[str]) -> list[float] | None:
    """The cells as numbers, or None if one is not a number."""
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return None
