"""Reading files named by the user, with one error for each cause that makes a file unusable."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tactile.base.errors import InputError, InputErrors, did_you_mean

MOST_NAMES = 12
"""Existing names that an error lists."""


def require_file(path: Path) -> None:
    """Checks that a file can be read and has content.

    Raises:
        InputError: the file is missing, not a regular file, not readable, or empty.
    """
    with readable(path):
        if path.is_dir():
            raise InputError(str(path), "is a folder", "a file")
        if not path.exists():
            try:
                cure = did_you_mean(path.name, [other.name for other in path.parent.iterdir()])
            except OSError:
                cure = f"the folder {path.parent} does not exist"
            raise InputError(str(path), "no such file", "an existing file", cure)
        if not path.is_file():
            raise InputError(str(path), "is not a regular file", "a file")
        with path.open("rb") as file:
            if not file.read(1):
                raise InputError(str(path), "is empty", "a recording", "was it copied completely?")


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turns an error of the operating system in reading a file into an `InputError`."""
    try:
        yield
    except OSError as error:
        cure = "make it readable for this user" if isinstance(error, PermissionError) else ""
        raise InputError(str(path), f"cannot be read ({error.strerror or error})", cure=cure) from error


def read_bytes(path: Path) -> bytes:
    """The content of a file, at least one byte."""
    require_file(path)
    with readable(path):
        return path.read_bytes()


def digest_of(contents: Iterable[bytes | Path]) -> str:
    """SHA-256 (hex) of the contents one after another, also those of files, which may exceed the memory.

    Raises:
        InputError: a file cannot be read.
    """
    total = hashlib.sha256()
    for content in contents:
        if isinstance(content, bytes):
            total.update(content)
            continue
        with readable(content), content.open("rb") as file:
            hashlib.file_digest(file, lambda: total)
    return total.hexdigest()


def missing_error(where: str, kind: str, name: str, there: Sequence[str], key: str = "") -> InputError:
    """The error for a name that a file lacks; it lists the existing names and suggests a similar one.

    Args:
        kind: of the missing name, such as 'column' or 'array'. there: the existing names.
        key: configuration key in which the name was given, if any.
    """
    cure = did_you_mean(name, there) or (f"name the {kind} with {key}" if key else "")
    shown = ", ".join(map(repr, there[:MOST_NAMES])) or "(nothing)"
    if len(there) > MOST_NAMES:
        shown += f" and {len(there) - MOST_NAMES} more"
    return InputError(where, f"no {kind} {name!r}", f"it among {shown}", cure)


def raise_errors(errors: Sequence[InputError]) -> None:
    """Raise the error, or all errors together as `InputErrors`; do nothing without any."""
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise InputErrors(list(errors))
