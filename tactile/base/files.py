"""Files: written atomically, made new without replacing any, read from outside within bounds.

An atomic write leaves the old file or the complete new one, never a part of it. New files and folders are
checked before the work, made whole, and never put in the place of what others made. Readers (text, JSON,
YAML, CSV, .npz) bound the size of what they read, and tell in one line whatever is wrong with a file.
"""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import re
import shutil
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from math import prod
from pathlib import Path
from tempfile import mkdtemp
from typing import IO, Any, TypeVar

import numpy as np
import yaml
from pydantic import ValidationError

from tactile.base.errors import InputError, os_errors_of

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk, a quota or a file that is full."""


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Calls `write` with a hidden temporary path in the same folder, then renames that file to `path`.

    The temporary name keeps the file's suffix and contains the process id, so two processes may write the
    same file. If `write` raises, `path` stays as it was and the temporary file is removed. A file that is
    replaced keeps its mode. Errors of the temporary file name `path`.

    Raises:
        InputError: `path` is a device or a FIFO, which a file would replace.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(str(path), "a device or a FIFO", "a file")
    temporary = temporary_path(path)
    try:
        with errors_of(path, temporary):
            write(temporary)
            with suppress(FileNotFoundError):
                shutil.copymode(path, temporary)
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_text_atomically(path: Path, text: str) -> None:
    """Writes a UTF-8 text file by `write_atomically`."""
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def flush_to_disk(path: Path) -> None:
    """Waits until the file's content is on the disk; called inside `write`, it makes the renamed
    file survive a power failure."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def temporary_path(path: Path) -> Path:
    """The hidden path at which a file is made."""
    return path.with_name(f".{os.getpid()}.{path.name}")


@contextmanager
def errors_of(path: Path, temporary: Path) -> Iterator[None]:
    """Names `path` in errors of writing to a temporary file, or to files in a temporary folder."""
    try:
        yield
    except OSError as error:
        if not _is_of(error, temporary):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    except InputError as error:
        where = getattr(error, "where", "")
        if str(temporary) not in where:
            raise
        named = where.replace(str(temporary), str(path))
        raise InputError(named, error.found, error.expected, error.cure) from error


def _is_of(error: OSError, temporary: Path) -> bool:
    """Whether an error is one of writing: of the temporary file, of a full disk while another is copied to
    it, or without any name, as those of open files are."""
    if error.errno is None:
        return False
    named = [
        Path(os.fsdecode(name)) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)
    ]
    own = [name == temporary or temporary in name.parents for name in named]
    return not own or own[0] or (any(own) and error.errno in FULL)


CURE = "choose another with -o"
_BEGINNING = 1 << 13  # bytes of a file by which it is known again


def require_new_file(path: Path, *, replaces: bytes = b"", parents: bool = False) -> None:
    """Checks, before any work, that a file or a folder can be made.

    Args:
        replaces: pattern of the beginning of a file that may be replaced, as the same command made it before;
            b"": nothing may. parents: whether folders above it that are missing will be made.

    Raises:
        InputError: something is there already, be it a file, a folder, a link or a device; or its folder is
            missing or cannot be written in.
    """
    replaceable = False
    if replaces and path.is_file() and not path.is_symlink():
        with path.open("rb") as file:
            replaceable = re.match(replaces, file.read(_BEGINNING), re.DOTALL) is not None
    if os.path.lexists(path) and not replaceable:
        dangles = path.is_symlink() and not path.exists()
        found = f"a link to {os.readlink(path)}, which does not exist" if dangles else "exists already"
        expected = "a new file, or one that this command made before" if replaces else "a new file"
        raise InputError(str(path), found, expected, CURE)
    first = path
    while parents and not os.path.lexists(first.parent):
        first = first.parent
    if not os.path.isdir(first.parent):
        found = "not a folder" if os.path.lexists(first.parent) else "no such folder"
        raise InputError(str(first.parent), found, "an existing folder", "make it first")
    require_writable(first)


def require_own_folder(path: Path, marks: Sequence[str]) -> None:
    """Checks, before any work, that a folder can be made, or is empty, or one to go on with.

    Args:
        marks: names of files that the same command has made in it before; one suffices.

    Raises:
        InputError: it is another folder or no folder, has links or devices in it, or cannot be written in.
    """
    if path.is_symlink() or not path.is_dir():
        require_new_file(path, parents=True)
        return
    inside = sorted(path.iterdir())
    if inside and not any(path / mark in inside for mark in marks):
        found = f"a folder with other files, such as {inside[0].name}"
        raise InputError(str(path), found, "a new folder, or one that this command made before", CURE)
    for file in inside:
        if file.is_symlink() or not (file.is_file() or file.is_dir()):
            raise InputError(str(file), "a link or a device", "files of this command", CURE)
    require_writable(path / f"{marks[0]}.new")


def require_writable(path: Path) -> None:
    """Checks that a file can be made at a path, or replaced there.

    Raises:
        InputError: a folder is there, its own folder cannot be written in, or its name is too long.
    """
    if os.path.isdir(path):
        raise InputError(str(path), "a folder", "a file")
    temporary = temporary_path(path)
    with os_errors_of(path, "cannot be written", "a file in a folder that can be written", CURE):
        temporary.touch()
        temporary.unlink()


def make_new_file(path: Path, write: Callable[[Path], Any]) -> None:
    """Makes a file as `write_atomically` does, but replaces none.

    Raises:
        InputError: another program has made it meanwhile.
    """
    temporary = temporary_path(path)
    try:
        with errors_of(path, temporary):
            write(temporary)
            try:
                os.link(temporary, path)
            except FileExistsError:
                raise _appeared(path) from None
            except OSError:  # a file system without hard links
                if os.path.lexists(path):
                    raise _appeared(path) from None
                os.rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A hidden folder in which a context makes files; at its end it becomes the folder `path`.

    Raises:
        InputError: another program has made it meanwhile.
    """
    try:
        folder = Path(mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        with errors_of(path, folder):
            yield folder
            folder.chmod(0o755)
            if os.path.lexists(path):
                raise _appeared(path)
            try:
                os.rename(folder, path)
            except OSError as error:
                if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                    raise _appeared(path) from None
                raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _appeared(path: Path) -> InputError:
    return InputError(
        str(path), "another program has made it meanwhile; it stays as it is", "a new file", CURE
    )


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
