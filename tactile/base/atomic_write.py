"""Atomic file writes: a reader finds the old file or the complete new one, never a part of it."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tactile.base.errors import InputError

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
