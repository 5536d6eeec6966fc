"""Reading files from outside within bounds, with one line for whatever is wrong with them: text, JSON,
tables, YAML, and the arrays of .npz files."""

from __future__ import annotations

import csv
import io
import json
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import yaml
from pydantic import ValidationError

from tactile.base.errors import InputError

T = TypeVar("T")

MOST_BYTES, MOST_TIMES = 1 << 28, 32
"""What is compressed, or said to be large in a header, may expand to so many bytes, or to so many times the
bytes that are stored, whichever is more. 256 MiB leave room for copies in 2 GB of memory."""
MOST_PIXELS = 1 << 26
"""Most values of all views of a recording; 512 MiB as float64."""
MOST_TEXT = 1 << 26
"""Most bytes of a text file, of which lists of numbers take 20 times as much memory."""
SPOILT = (
    ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, RecursionError,
    RuntimeError, SyntaxError, TypeError, ValueError,
)  # fmt: skip
"""What parsers raise for a file that is damaged or of another kind, besides OSError and their own."""


def check_size(where: str, size: int, stored: int = 0) -> None:
    """Raises `InputError` if `stored` bytes expand to more than is allowed, see `MOST_BYTES`."""
    most = max(MOST_BYTES, MOST_TIMES * stored)
    if size > most:
        expected = f"at most {most >> 20} MiB: {MOST_BYTES >> 20} MiB, or {MOST_TIMES} times what is stored"
        raise InputError(where, f"expands to {size} bytes or more", expected)


def expand(reader: IO[bytes], where: str, stored: int) -> bytes:
    """All that a decompressing reader gives; an `InputError` if it is too much."""
    pieces, size = [], 0
    while piece := reader.read(1 << 20):
        pieces.append(piece)
        size += len(piece)
        check_size(where, size, stored)
    return b"".join(pieces)


def read_text(path: str | Path, expected: str = "a text file", most: int = MOST_TEXT) -> str:
    """The text of a file.

    Raises:
        InputError: it is missing, not a plain file, longer than `most` bytes, or not UTF-8.
    """
    with malformed(path, expected):
        path = Path(path)
        if path.exists() and not path.is_file():
            raise InputError(str(path), "a folder" if path.is_dir() else "not a regular file", expected)
        with path.open("rb") as file:
            content = file.read(most + 1)
        if len(content) > most:
            raise InputError(str(path), "a large file", f"{expected}, of at most {most >> 10} KiB")
        return content.decode("utf-8-sig")


def read_json(path: str | Path, expected: str, parse: Callable[[Any], T]) -> T:
    """What `parse` makes of the content of a JSON file.

    Raises:
        InputError: the file cannot be read or is no JSON, or `parse` failed.
    """
    with malformed(path, expected):
        return parse(json.loads(read_text(path, expected)))


def read_rows(path: str | Path, expected: str, parse: Callable[[Mapping[str, str]], T]) -> list[T]:
    """What `parse` makes of each row of a CSV file, cells by column.

    Raises:
        InputError: the file cannot be read, or `parse` failed, with the line.
    """
    reader = csv.DictReader(io.StringIO(read_text(path, expected), newline=""))
    try:
        return [parse(row) for row in reader]
    except (csv.Error, *SPOILT) as error:
        raise InputError(f"{path}:{reader.line_num}", f"malformed ({reason(error)})", expected) from None


def read_plain_yaml(path: str | Path, expected: str) -> dict[str, Any]:
    """The content of a YAML file of at most 128 KiB without aliases, which could expand to any size.

    Raises:
        InputError: it cannot be read, is no YAML, or no mapping.
    """
    text = read_text(path, expected, 1 << 17)
    with malformed(path, expected):
        try:
            content = yaml.load(text, Loader=_Plain)
        except yaml.YAMLError as error:
            raise ValueError(" ".join(str(error).split())) from None
        if not isinstance(content, dict):
            raise ValueError("not a mapping")
        return content


class _Plain(yaml.SafeLoader):
    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)


@contextmanager
def malformed(
    path: str | Path,
    expected: str,
    cure: str = "",
    found: str = "malformed ({})",
    spoilt: tuple[type[Exception], ...] = SPOILT,
) -> Iterator[None]:
    """Turns whatever a parser raises for a file into an `InputError`.

    Args:
        found: what the file is if the parser raises one of `spoilt`; {} is the cause.
    """
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(str(path), "no such file", expected, cure) from None
    except spoilt as error:
        raise InputError(str(path), found.format(reason(error)), expected, cure) from None
    except OSError as error:
        raise InputError(str(path), f"cannot be read ({error.strerror or error})", expected, cure) from None


def reason(error: Exception) -> str:
    """The cause of an error of a parser in a few words."""
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False, include_input=False)[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    if isinstance(error, KeyError):
        return f"without {error}"
    lines = str(error).splitlines()
    return lines[0][:200] if lines else type(error).__name__


NPZ_SPOILT = (*SPOILT, OSError, tokenize.TokenError, struct.error, zipfile.BadZipFile, zlib.error)
"""Errors of zipfile and NumPy in a spoilt file."""


def read_npz(
    path: str | Path, names: Sequence[str], parse: Callable[..., T], expected: str, cure: str = ""
) -> T:
    """The result of `parse`, called with the named arrays of a file.

    Args:
        parse: raises ValueError for unsuitable arrays. expected: kind of file. cure: for errors.

    Raises:
        InputError: the file is missing, malformed or lacks an array, or `parse` failed.
    """
    found = "another kind of file ({})"
    with malformed(path, expected, cure, found, NPZ_SPOILT), zipfile.ZipFile(path) as archive:
        return parse(*read_arrays(archive, [f"{name}.npy" for name in names], str(path)))


def read_arrays(archive: zipfile.ZipFile, members: Sequence[str], where: str) -> list[np.ndarray]:
    """Arrays of an archive, whose size is checked before they are read and whose checksum before they are
    parsed; objects are refused.

    Raises:
        InputError: they are too large. One of `SPOILT`: one is missing, damaged, or no plain array.
    """
    infos = [archive.getinfo(member) for member in members]
    check_size(where, sum(info.file_size for info in infos), archive.start_dir)
    arrays = []
    for info in infos:
        content = io.BytesIO(archive.read(info))
        version, form = np.lib.format.read_magic(content), np.lib.format
        read = form.read_array_header_1_0 if version == (1, 0) else form.read_array_header_2_0
        shape, _, dtype = read(content)
        # Compared as Python's integers, because NumPy's may overflow.
        left = info.file_size - content.tell()
        if not dtype.hasobject and (min(shape, default=0) < 0 or prod(shape) * dtype.itemsize != left):
            raise ValueError(f"{info.filename} is not a plain array")
        content.seek(0)
        arrays.append(form.read_array(content, allow_pickle=False))
    return arrays


LONGEST_SHOWN = 80
"""Characters of a bad row that an error shows."""
LARGEST_NUMBER = 1e20
"""Magnitude above which a number is damage: squares of others do not overflow."""
TableColumns = Mapping[str, tuple[str, ...]]
"""TableColumns to read, in order: name -> alternative names in a header (compared in lower case)."""


def read_text_table(path: str | Path, columns: TableColumns) -> tuple[np.ndarray, np.ndarray]:
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
        if row is not None and len(row) == len(names) and all(abs(value) <= LARGEST_NUMBER for value in row):
            rows.append([row[places[0]] for places in found])
            at.append(number)
        elif number < len(every):  # the line ends with a newline
            shown = f"'{' '.join(cells)[:LONGEST_SHOWN]}'"
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
