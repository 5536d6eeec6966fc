"""A CSV file of numbers with a header row, with the line number of each row."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robot.recordings.sanity_checks import count_others, nonfinite_errors
from robot.sources.input_files import digest_of, missing_error, raise_errors, read_bytes
from tactile.base.errors import InputError

MAX_LISTED = 8  # errors listed one by one; the others are counted


@dataclass(frozen=True, eq=False)
class CsvFile:
    """The numbers of one file.

    Attributes:
        names: its C columns. values: [N, C]; NaN in empty cells. empty: [N, C] bool, empty cells.
        lines: [N] line numbers, from 1. content: the file's bytes.
    """

    path: Path
    names: tuple[str, ...]
    values: np.ndarray
    empty: np.ndarray
    lines: np.ndarray
    content: bytes

    def place(self, row: int) -> str:
        return f"{self.path}:{self.lines[row]}"

    def column(self, name: str) -> np.ndarray:
        """[N] the named column, which must exist (see `absences`)."""
        return self.values[:, self.names.index(name)]

    def faults(self, *names: str) -> list[InputError]:
        """Errors for empty, NaN or infinite cells of the named columns."""
        errors = []
        for name in names:
            empty = self.empty[:, self.names.index(name)]
            if empty.any():
                found = f"{name} is empty{count_others(empty)}"
                errors.append(InputError(self.place(int(empty.argmax())), found, "a number"))
            errors += nonfinite_errors(self.column(name), name, self.place, ~empty)
        return errors

    def absences(self, wanted: Sequence[tuple[str, str]]) -> list[InputError]:
        """Errors for (column, configuration key) pairs whose column is missing."""
        where = f"{self.path}:1"
        absent = [(name, key) for name, key in wanted if name not in self.names]
        return [missing_error(where, "column", name, self.names, key) for name, key in absent]

    def numbered(self, prefix: str) -> dict[int, int]:
        """Columns prefix0, prefix1, ...: their numbers in increasing order, and their positions."""
        numbers = {
            int(name[len(prefix) :]): place
            for place, name in enumerate(self.names)
            if name.startswith(prefix) and name[len(prefix) :].isdecimal()
        }
        return dict(sorted(numbers.items()))

    def block(self, prefix: str) -> tuple[np.ndarray, np.ndarray]:
        """The numbered columns in order: values [N, B], empty [N, B]."""
        columns = list(self.numbered(prefix).values())
        return self.values[:, columns], self.empty[:, columns]


def read_csv(path: Path) -> CsvFile:
    """Reads a CSV file of numbers.

    Raises:
        InputError: the file, its header or rows are missing, or a row has another length or an invalid cell.
    """
    content = read_bytes(path)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(str(path), f"is not text (byte {error.start})", "a CSV file in UTF-8") from error
    lines = text.splitlines()
    names = _header(path, lines[0] if lines else "")
    full = [(number, line) for number, line in enumerate(lines[1:], start=2) if line.strip()]
    if not full:
        raise InputError(str(path), "has no rows under its header", "at least one row")
    values = _numbers([line for _, line in full], len(names))
    empty = np.zeros((len(full), len(names)), bool)
    if values is None:
        values, empty = _cells(path, names, full)
    return CsvFile(path, names, values, empty, np.array([number for number, _ in full]), content)


def digest_of_files(files: Sequence[CsvFile]) -> str:
    """SHA-256 (hex) of the contents of the files in order, each file once."""
    return digest_of({file.path: file.content for file in files}.values())


def _header(path: Path, line: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in _split(line))
    where = f"{path}:1"
    if len(names) < 2:
        for mark, word in ((";", "semicolons"), ("\t", "tabs")):
            if mark in line:
                raise InputError(where, f"the columns are separated by {word}", "commas")
    if any(_is_number(name) for name in names):
        raise InputError(where, f"the first line is {line[:60]!r}", "a header row that names the columns")
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise InputError(where, f"several columns are called {doubled[0]!r}", "every name once")
    return names


def _numbers(lines: list[str], width: int) -> np.ndarray | None:
    """[N, C] parsed at once, or None if a cell needs separate treatment."""
    try:
        values = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2)
    except ValueError:
        return None
    return values if values.shape == (len(lines), width) else None


def _cells(path: Path, names: tuple[str, ...], full: list[tuple[int, str]]) -> tuple[np.ndarray, np.ndarray]:
    """[N, C] values and empty flags, parsed cell by cell; raises the errors of cells that are not numbers."""
    values = np.full((len(full), len(names)), np.nan)
    empty = np.zeros(values.shape, bool)
    errors = []
    for row, (number, line) in enumerate(full):
        cells = _split(line)
        if len(cells) != len(names):
            found, expected = f"{len(cells)} cells", f"{len(names)}, as in the header"
            errors.append(InputError(f"{path}:{number}", found, expected, "the row may be cut off"))
            continue
        for column, cell in enumerate(cells):
            if not cell.strip():
                empty[row, column] = True
            elif _is_number(cell):
                values[row, column] = float(cell)
            else:
                errors.append(InputError(f"{path}:{number}", f"{names[column]} is {cell[:40]!r}", "a number"))
    if len(errors) > MAX_LISTED:
        errors[MAX_LISTED:] = [InputError(str(path), f"{len(errors) - MAX_LISTED} more faults like these")]
    raise_errors(errors)
    return values, empty


def _split(line: str) -> list[str]:
    try:
        return next(csv.reader([line]), [])
    except csv.Error:  # a cell beyond the size limit of the csv module is not a number
        return line.split(",")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
