"""CSV files of numbers only, each cell of each row filled."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from pathlib import Path

import numpy as np

from robot.recordings.sanity_checks import nonfinite_errors
from robot.sources.input_files import digest_of, missing_error, raise_errors, read_bytes
from tactile.base.errors import InputError


def read_columns(path: Path, columns: Sequence[str]) -> tuple[np.ndarray, str]:
    """The numbers [N, C] below a header of exactly these columns, and sha256 (hex) of the file.

    Raises:
        InputError: the file is missing, empty or cut, or has other columns or cells that are not finite
            numbers.
    """
    content = read_bytes(path)
    header, _, rows = _text(path, content).partition("\n")
    names = header.strip().split(",")
    if lacking := [name for name in columns if name not in names]:
        raise missing_error(str(path), "column", lacking[0], names)
    if names != list(columns):
        raise InputError(str(path), f"{len(names)} columns", f"these {len(columns)}: {', '.join(columns)}")
    return _parse(path, rows, columns, first_line=2), digest_of([content])


def read_rows(path: Path, count: int) -> tuple[np.ndarray, str]:
    """The numbers [N, count] of a file without a header, and sha256 (hex) of the file.

    Raises:
        InputError: as `read_columns`.
    """
    content = read_bytes(path)
    columns = [f"column {number}" for number in range(1, count + 1)]
    return _parse(path, _text(path, content), columns, first_line=1), digest_of([content])


def _text(path: Path, content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(str(path), "bytes that are not UTF-8", "a CSV file in UTF-8") from None


def _parse(path: Path, rows: str, columns: Sequence[str], first_line: int) -> np.ndarray:
    expected = f"{len(columns)} numbers in each line"
    if not rows.strip():
        raise InputError(str(path), "no rows", expected, "was it copied completely?")
    if not rows.endswith("\n"):
        raise InputError(str(path), "the last line is cut", cure="copy the file again")
    try:
        table = np.loadtxt(StringIO(rows), delimiter=",", comments=None, ndmin=2)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape[1] != len(columns):
        raise _first_fault(path, rows, columns, first_line)
    raise_errors(
        [
            error
            for name, column in zip(columns, table.T, strict=True)
            for error in nonfinite_errors(column, name, lambda row: f"{path}:{row + first_line}")
        ]
    )
    return table


def _first_fault(path: Path, rows: str, columns: Sequence[str], first_line: int) -> InputError:
    """The first line that does not hold the numbers, and what it holds."""
    for number, line in enumerate(rows.splitlines(), start=first_line):
        cells, where = line.split(","), f"{path}:{number}"
        if line.strip() and len(cells) != len(columns):
            return InputError(where, f"{len(cells)} cells", f"{len(columns)} numbers")
        for column, cell in zip(columns, cells, strict=False):
            try:
                float(cell or "empty")
            except ValueError:
                return InputError(where, f"{cell!r} in {column}", "a number")
    return InputError(str(path), "lines of different lengths", f"{len(columns)} numbers in each line")
