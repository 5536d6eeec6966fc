"""New files and folders: checked before the work, made whole, and never in the place of what others made."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from tactile.base.atomic_write import errors_of, temporary_path
from tactile.base.errors import InputError, os_errors_of

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
    if os.path.lexists(path) and not (replaces and _begins(path, replaces)):
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


def _begins(path: Path, pattern: bytes) -> bool:
    """Whether a path is a file of its own that begins with a pattern."""
    if path.is_symlink() or not path.is_file():
        return False
    with path.open("rb") as file:
        return re.match(pattern, file.read(_BEGINNING), re.DOTALL) is not None


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
            _put_file(temporary, path)
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
            _put_folder(folder, path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _put_file(temporary: Path, path: Path) -> None:
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise _appeared(path) from None
    except OSError:  # a file system without hard links
        if os.path.lexists(path):
            raise _appeared(path) from None
        os.rename(temporary, path)


def _put_folder(folder: Path, path: Path) -> None:
    if os.path.lexists(path):
        raise _appeared(path)
    try:
        os.rename(folder, path)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise _appeared(path) from None
        raise


def _appeared(path: Path) -> InputError:
    return InputError(
        str(path), "another program has made it meanwhile; it stays as it is", "a new file", CURE
    )
