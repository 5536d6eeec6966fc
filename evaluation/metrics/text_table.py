"""Text files of numbers: one row per line, separated by commas or blanks, with or without a header."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tactile.base.errors import InputError
from tactile.base.files import read_text

LONGEST = 80
"""Characters of a bad row that an error shows."""
LARGEST = 1e20
"""Magnitude above which a number is damage: squares of others do not overflow."""
Columns = Mapping[str, tuple[str, ...]]
"""Columns to read, in order: name -> alternative names in a header (compared in lower case)."""


class TextTable(NamedTuple):
    """The rows of a file: `values` [N, columns] float64 and their `line` numbers [N], from 1."""

    values: np.ndarray
    line: np.ndarray


def read_text_table(path: str | Path, columns: Columns) -> TextTable:
    """Reads columns of a file.

    A first line that is not all numbers is a header; other columns of the file are ignored. A file without a
    header holds exactly these columns in this order. Blank lines and lines that begin with `#` are skipped. A
    last line without a newline (a recording that was cut off) is dropped if it is not a complete row.

    Raises:
        InputError: the file cannot be read, lacks a column or has a malformed row (with file and line).
    """
    lines = _lines(path)
    first, fields, ended = next(lines, (1, [], False))
    if not fields:
        raise InputError(str(path), "no rows", f"lines of {' '.join(columns)}")
    header = _numbers(fields) is None
    names = [name.lower() for name in fields] if header else list(columns)
    where = _places(f"{path}:{first}", names, columns)
    rows, at = [], []
    for number, cells, whole in lines if header else chain([(first, fields, ended)], lines):
        row = _numbers(cells)
        if row is not None and len(row) == len(names) and all(abs(number) <= LARGEST for number in row):
            rows.append([row[place] for place in where])
            at.append(number)
        elif whole:
            found = f"'{' '.join(cells)[:LONGEST]}'"
            raise InputError(f"{path}:{number}", found, f"{len(names)} finite numbers: {' '.join(names)}")
    if not rows:
        raise InputError(str(path), "no rows", f"lines of {' '.join(columns)}")
    return TextTable(np.array(rows), np.array(at))


def _lines(path: str | Path) -> Iterator[tuple[int, list[str], bool]]:
    """Line number, fields, and whether the line ends with a newline."""
    lines = read_text(path, "a text file of numbers").split("\n")
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            cells = [cell.strip() for cell in line.split(",")] if "," in line else line.split()
            yield number, cells, number < len(lines)


def _places(where: str, names: list[str], columns: Columns) -> list[int]:
    """Index of each column in the header."""
    found = [
        [names.index(name) for name in (column, *others) if name in names]
        for column, others in columns.items()
    ]
    missing = [column for column, at in zip(columns, found, strict=True) if not at]
    if missing:
        known = "; ".join("/".join((column, *columns[column])) for column in missing)
        raise InputError(where, f"no column {', '.join(missing)} among {' '.join(names)}", known)
    return [at[0] for at in found]


def _numbers(cells: list[str]) -> list[float] | None:
    """The cells as numbers, or None if one is not a number."""
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return None
