"""New files and folders: checked before the work, made whole, and never in the place of what others made."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from tactile.base.atomic_write import errors_of, temporary_path
from tactile.base.errors import InputError

CURE = "choose another with -o"


def require_new_file(path: Path) -> None:
    """Checks, before anything is measured, that a file or a folder can be made.

    Raises:
        InputError: it exists already, or its folder does not or cannot be written in.
    """
    if os.path.lexists(path):
        dangles = path.is_symlink() and not path.exists()
        found = f"a link to {os.readlink(path)}, which does not exist" if dangles else "exists already"
        raise InputError(str(path), found, "a new file", CURE)
    if not os.path.isdir(path.parent):
        found = "not a folder" if os.path.lexists(path.parent) else "no such folder"
        raise InputError(str(path.parent), found, "an existing folder", "make it first")
    require_writable(path)


def require_writable(path: Path) -> None:
    """Checks that a file can be made at a path, or replaced there.

    Raises:
        InputError: a folder is there, its own folder cannot be written in, or its name is too long.
    """
    if os.path.isdir(path):
        raise InputError(str(path), "a folder", "a file")
    temporary = temporary_path(path)
    try:
        temporary.touch()
        temporary.unlink()
    except OSError as error:
        found = f"cannot be written ({error.strerror})"
        raise InputError(str(path), found, "a file in a folder that can be written", CURE) from None


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
