"""A CSV file of numbers with a header row, with the line number of each row.

`numpy.loadtxt` parses files of numbers only. Other files are parsed here, because pandas knows no line
numbers, X"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path

import numpy as np

from robot.recordings.csv_config import PER_UNIT, per_unit, split_unit
from robot.recordings.sanity_checks import count_others, utc_seconds
from robot.sources.input_files import missing_error, read_bytes, require_file
from tactile.base.errors import InputError

MAX_CELLS = 1 << 25
"""Limit of a file's rows x columns."""
EMPTY, WORD, CUT = 1, 2, 3
"""Why a cell has no number: nothing in it, text in it, or its row has another number of cells."""
_COMMENT = "#%"  # a line that begins so is a comment, or the header


@dataclass(frozen=True, eq=False)
class CsvFile:
    """The numbers of one file.

    Attributes:
        line: number of the header, from 1. separator: of cells; a space stands for any white space.
        full: names of the C columns as written. names: without their units where that is unambiguous.
        units: of the columns, '' where the header states none.
        values: [N, C]; NaN where there is no number. fault: [N, C] uint8, why: `EMPTY`, `WORD`, `CUT` or 0.
        dates: columns of dates, which are s since 1970 (UTC). lines: [N] line numbers, from 1.
        content: the file's bytes. clock: unit of times whose header states none.
    """

    path: Path
    line: int
    separator: str
    full: tuple[str, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: np.ndarray
    fault: np.ndarray
    dates: frozenset[int]
    lines: np.ndarray
    content: bytes
    clock: str | None = None

    @property
    def top(self) -> str:
        """The place of the header."""
        return f"{self.path}:{self.line}"

    def place(self, row: int) -> str:
        return f"{self.path}:{self.lines[row]}"

    def at(self, name: str) -> int:
        """The position of a column, named with or without its unit, which must exist (see `absences`)."""
        return self._places[name]

    @cached_property
    def _places(self) -> dict[str, int]:
        """The first position of each name, in full or without its unit."""
        return {name: place for place, name in reversed([*enumerate(self.full), *enumerate(self.names)])}

    def column(self, name: str, quantity: str = "", unit: str | None = None) -> np.ndarray:
        """[N] the named column, which must exist; in s, m and rad if its quantity is given.

        Args:
            quantity: as for `per_unit`. unit: None for that in the header.

        Raises:
            InputError: the header states no unit of this quantity.
        """
        place = self.at(name)
        values, found = self.values[:, place], unit or self.units[place]
        if quantity == "time" and place in self.dates:
            return values
        if not found and quantity == "time":
            found = self.clock or ""
        factor = per_unit(found, quantity) if found and quantity else 1.0
        if factor is None:
            if name == self.full[place] and name[-1] not in ")]":
                return values  # the end of a name that the user gave in full
            kind = quantity.split("/")[0]
            cure = f"correct the header, or set recording.table.units.{kind}"
            said = f"{self.full[place]!r} states the unit {found!r}"
            raise InputError(self.top, said, f"a unit of {quantity} ({', '.join(PER_UNIT[kind])})", cure)
        return values if factor == 1 else values / factor

    def judge(
        self, names: Sequence[str], quaternion: Sequence[str] = (), far: bool = False
    ) -> tuple[np.ndarray, list[InputError]]:
        """[N] bool, rows in which a named column has no finite number, and an error for each kind of fault.

        Args:
            quaternion: those of them whose length must be 1. far: inf is a value, nothing in range.
        """
        places = [self.at(name) for name in names]
        fault, values = self.fault[:, places], self.values[:, places]
        endless = ~np.isfinite(values) & ~(far & (values == np.inf))
        kinds = [fault == CUT, fault == WORD, fault == EMPTY, (fault == 0) & endless]
        bad = np.any(kinds, axis=(0, 2)) if places else np.zeros(len(values), bool)
        turn = self.values[:, [self.at(name) for name in quaternion]]
        away = np.abs(np.linalg.norm(turn, axis=1) - 1)
        crooked = bool(quaternion) & ~bad & ~(away <= 0.05)  # three decimals leave 0.002
        errors, drop = [], "correct or drop the row"
        for hit in kinds:
            if hit.any():
                row, column = np.argwhere(hit)[0].tolist()
                found, *wanted = self._fault(row, places[column])
                errors.append(InputError(self.place(row), found + count_others(hit.any(axis=1)), *wanted))
        if crooked.any():
            row = int(crooked.argmax())
            found = f"({', '.join(quaternion)}) is {turn[row].tolist()}{count_others(crooked)}"
            errors.append(InputError(self.place(row), found, "a quaternion of length 1", drop))
        return bad | crooked, errors

    def _fault(self, row: int, place: int) -> tuple[str, str, str]:
        """What is wrong with a cell, what is expected, and the cure."""
        cells = _split(_lines_of(self.content, self.path)[self.lines[row] - 1], self.separator)
        name, fault, drop = self.names[place], int(self.fault[row, place]), "correct or drop the row"
        if fault == CUT:
            few = len(cells) < len(self.names)
            cure = "the row may be cut off" if few else f"quote text that holds {self.separator!r}"
            return f"{len(cells)} cells", f"{len(self.names)}, as in the header", cure
        if fault == WORD:
            comma = re.fullmatch(r"\s*[-+]?\d+,\d+\s*", cells[place])
            cure = "write decimal points, not decimal commas" if comma else drop
            return f"{name} is {cells[place][:40]!r}", "a number", cure
        if fault == EMPTY:
            return f"{name} is empty", "a number", drop
        return f"{name} is {self.values[row, place]}", "a finite number", drop

    def rows(self, kept: np.ndarray) -> CsvFile:
        """The file with these rows only."""
        return replace(self, values=self.values[kept], fault=self.fault[kept], lines=self.lines[kept])

    def absences(self, wanted: Sequence[tuple[str, str]]) -> list[InputError]:
        """Errors for (column, configuration key) pairs whose column is missing, or there more than once."""
        absent = [pair for pair in wanted if pair[0] not in self._places]
        errors = [missing_error(self.top, "column", name, self.full, key) for name, key in absent]
        for name in dict.fromkeys(name for name, _ in wanted):
            if max(self.names.count(name), self.full.count(name)) > 1:
                errors.append(InputError(self.top, f"several columns are called {name!r}", "every name once"))
        return errors

    def numbered(self, prefix: str) -> dict[int, int]:
        """Columns prefix0, prefix1, ...: their numbers in increasing order, and their positions."""
        ends = ((name[len(prefix) :], at) for at, name in enumerate(self.names) if name.startswith(prefix))
        return dict(sorted((int(end), at) for end, at in ends if end.isdecimal()))

    def block(self, prefix: str, unit: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The numbered columns in order: values [N, B], in m if they have a unit; fault [N, B]."""
        places = list(self.numbered(prefix).values())
        values = self.values[:, places]
        unit = unit or (self.units[places[0]] if places else "")
        factor = per_unit(unit, "length") or 1.0
        return values if factor == 1 else values / factor, self.fault[:, places]


def read_csv(path: Path, clock: str | None = None, names: Sequence[str] = ()) -> CsvFile:
    """Reads a CSV file of numbers; dates become s since 1970 (UTC).

    Lines that begin with # or % are comments, but such a line right above numbers may be the header.

    Args:
        clock: unit of times whose header states none. names: of the columns of a file without a header.

    Raises:
        InputError: the file, its header or rows are missing, it is not text, or it exceeds a limit.
    """
    require_file(path)
    _limit(str(path), path.stat().st_size, 1 << 28, "bytes")
    content = read_bytes(path)
    lines = _lines_of(content, path)
    line, separator, full = (0, ",", tuple(names)) if names else _header(path, lines)
    rows = [number for number in range(line, len(lines)) if not _is_skipped(lines[number])]
    if not rows:
        raise InputError(str(path), "has no rows under its header", "at least one row")
    _limit(str(path), len(rows) * len(full), MAX_CELLS, "cells (rows x columns)")
    text = [lines[number] for number in rows]
    fault, dates = np.zeros((len(text), len(full)), np.uint8), frozenset[int]()
    try:
        values = np.loadtxt(text, delimiter=separator.strip(" ") or None, comments=None, ndmin=2)
    except ValueError:  # a cell is no number
        values = np.zeros(0)
    if values.shape != fault.shape:
        values, dates = _cells(text, separator, fault)
    bare, units = zip(*map(split_unit, full), strict=True)
    count = Counter(bare) + Counter(full)
    pairs = zip(full, bare, strict=True)
    plain = tuple(short if count[short] == 1 + (short == name) else name for name, short in pairs)
    return CsvFile(path, line, separator, full, plain, units, values, fault, dates,
                   np.array(rows) + 1, content, clock)  # fmt: skip


def _limit(where: str, count: int, most: int, what: str) -> None:
    if count > most:
        raise InputError(where, f"{count} {what}", f"at most {most}", "leave out columns, or split the file")


def _lines_of(content: bytes, path: Path) -> list[str]:
    """The lines of a file, whatever ends them."""
    wide = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    try:
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError as error:
        found = f"is not text (byte {error.start})"
        raise InputError(str(path), found, "a CSV file in UTF-8", "save it as CSV in UTF-8") from error
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    _limit(str(path), text.count("\n"), 1 << 22, "lines")
    lines = text.split("\n")
    longest = max(range(len(lines)), key=lambda number: len(lines[number]))
    _limit(f"{path}:{longest + 1}", len(lines[longest]), 1 << 20, "characters in a line")
    return lines


def _is_skipped(line: str) -> bool:
    """Whether all cells of a line are empty, or it is a comment."""
    begin = line.lstrip(' ,;\t"\v\f')[:1]
    return not begin or begin in _COMMENT


def _header(path: Path, lines: list[str]) -> tuple[int, str, tuple[str, ...]]:
    """Number of the header line, from 1, separator and names: the first line that is no comment, or the
    comment above the numbers that names as many."""
    rows = list(islice((number for number, line in enumerate(lines) if not _is_skipped(line)), 2))
    number, below = rows[0] if rows else len(lines) - 1, lines[rows[1]] if len(rows) > 1 else ""
    if not rows or any(map(_is_number, _names(lines[number], lines[number])[1])):
        below = lines[number] if rows else ""
        above = [k for k in reversed(range(number)) if lines[k].strip()]
        number = next((k for k in above if not rows or _name_columns(lines[k], below)), number)
    where, (separator, full) = f"{path}:{number + 1}", _names(lines[number], below)
    _limit(where, len(full), 1 << 12, "columns")
    if any(map(_is_number, full)):
        found = f"the first line is {lines[number][:60]!r}"
        raise InputError(where, found, "a header row that names the columns")
    longest = 200
    strange = next((name for name in full if not name.isprintable() or len(name) > longest), None)
    if strange is not None:
        found = f"the header names a column {strange[:40]!r}, {len(strange)} characters"
        raise InputError(where, found, f"text without control characters, at most {longest} a name")
    return number + 1, separator, tuple(full)


def _names(line: str, row: str) -> tuple[str, list[str]]:
    """What separates the names of a header line, above this row, and the names."""
    line = line.lstrip().lstrip(_COMMENT).replace("\xa0", " ").strip(" ")
    spaced = 1 < len(line.split()) == len(row.split())
    mark = next((mark for mark in ",;\t" if mark in line), " " if spaced else ",")
    return mark, [name.strip() for name in _split(line, mark)]


def _name_columns(comment: str, row: str) -> bool:
    """Whether a comment names as many columns as a row has."""
    mark, names = _names(comment, row)
    widths = len(_split(row, mark)), len(_split(row.rstrip(" " + mark), mark))
    return len(names) in widths and not any(map(_is_number, names))


def _split(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    if '"' in line:
        try:
            return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
        except csv.Error:  # a cell beyond the size limit of the csv module is not a number
            pass
    return line.split(separator)


def _cells(text: list[str], separator: str, fault: np.ndarray) -> tuple[np.ndarray, frozenset[int]]:
    """[N, C] values, parsed cell by cell, and the columns of dates; writes into `fault`, as in `CsvFile`."""
    width, dates, values = fault.shape[1], set[int](), np.full(fault.shape, np.nan)
    for row, line in enumerate(text):
        cells = _split(line, separator)
        while len(cells) > width and not cells[-1].strip():
            cells.pop()  # commas after the last cell
        if len(cells) != width:
            fault[row] = CUT
            continue
        for column, cell in enumerate(cells):
            try:
                values[row, column] = float(cell)
            except ValueError:
                if (seconds := _seconds(cell)) is None:
                    fault[row, column] = WORD if cell.strip() else EMPTY
                else:
                    values[row, column] = seconds
                    dates.add(column)
    return values, frozenset(dates)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return _seconds(cell) is not None
    return True


def _seconds(cell: str) -> float | None:
    """s since 1970 (UTC) of a date with a time of day; None if it is none."""
    try:
        return utc_seconds(cell.strip().replace("/", "-").removesuffix("UTC")) if ":" in cell else None
    except ValueError:
        return None
