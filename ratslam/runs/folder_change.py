"""A change of several files of a folder as one: made beside them, and put in place when it is complete.

Until it is complete, the folder stays as it was. From then on a kill delays it, and `finish_change` ends it.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tactile.base.bounded import read_json
from tactile.base.errors import InputError, InputErrors
from tactile.base.files import flush_to_disk, hidden_folder, write_text_atomically

READY = ".change"
"""Folder of a complete change within the folder that it changes."""
MAKING = ".making."
"""Beginning of the name of a folder in which a change is made."""
FILES, RECORD = "files", "record.json"
"""In such a folder: the new files, in a folder with the name of the changed one; the name of the change, and
which files are removed."""


def change_folder(folder: Path, what: str, last: str, change: Callable[[Path], None]) -> None:
    """Changes files of a folder: all of them, or none.

    Args:
        what: name of the change, for `unfinished_change`. last: file that is put in place after all others.
        change: writes and removes files in the folder that it is given, which shows those of `folder` and has
            its name; a file must be replaced, not written into.

    Raises:
        InputError: another process changes the folder, or an error of `change`, which names `folder`.
    """
    folder = folder.resolve()
    with _alone(folder), hidden_folder(folder, folder, MAKING) as making:
        shown = making / FILES / folder.name
        shown.mkdir(parents=True)
        before = [file for file in folder.iterdir() if not file.name.startswith(".")]
        for file in before:
            (shown / file.name).symlink_to(file)
        with _errors_of(folder, shown):
            change(shown)
        removed = [file.name for file in before if not os.path.lexists(shown / file.name)]
        for file in shown.iterdir():
            if file.is_symlink():  # was not replaced
                file.unlink()
            else:
                flush_to_disk(file)  # survives a power failure
        record = {"what": what, "removed": removed, "last": last}
        write_text_atomically(making / RECORD, json.dumps(record) + "\n")
        flush_to_disk(making / RECORD)
        try:
            making.rename(folder / READY)
            _put_in_place(folder)
        except KeyboardInterrupt:
            if unfinished_change(folder) is None:
                raise
            _put_in_place(folder)  # takes no time, and half of it would be neither the old nor the new


def unfinished_change(folder: Path) -> str | None:
    """The name of a complete change that was killed before all its files were in place; None without one."""
    try:
        if not (folder / READY / RECORD).is_file():
            return None
    except OSError:  # no folder that can be read
        return None
    return _read_record(folder)["what"]


def _read_record(folder: Path) -> dict[str, Any]:
    """What is to be done: its name, files to remove, and the file to put in place last.

    Raises:
        InputError: the record is damaged, or names files elsewhere.
    """

    def parse(content: Any) -> dict[str, Any]:
        removed, last = [str(name) for name in content["removed"]], str(content["last"])
        if any(Path(name).name != name for name in removed):
            raise ValueError("files of another folder")
        return {"what": str(content["what"]), "removed": removed, "last": last}

    return read_json(folder / READY / RECORD, "the record of a change of this folder", parse)


def finish_change(folder: Path) -> str | None:
    """Puts the files of such a change in place; returns its name, None without one."""
    what, folder = unfinished_change(folder), folder.resolve()
    if what is not None:
        with _alone(folder):
            if unfinished_change(folder) is not None:
                _put_in_place(folder)
    return what


def _put_in_place(folder: Path) -> None:
    """May be repeated after it was stopped anywhere.

    Raises:
        InputError: a file cannot be put in place.
    """
    ready = folder / READY
    record = _read_record(folder)
    new = sorted((ready / FILES).glob("*/*"), key=lambda file: (file.name == record["last"], file.name))
    try:
        for name in record["removed"]:
            (folder / name).unlink(missing_ok=True)
        for file in new:
            file.replace(folder / file.name)
        done = folder / f"{MAKING}{os.getpid()}"
        ready.rename(done)  # so that a removal that is stopped leaves no half of a change
    except OSError as error:
        found = f"its new files are complete, but cannot be put in place ({error.strerror})"
        cure = "repeat the command to complete it"
        raise InputError(str(folder), found, "a folder whose files can be replaced", cure) from error
    shutil.rmtree(done, ignore_errors=True)


@contextmanager
def _errors_of(folder: Path, shown: Path) -> Iterator[None]:
    """Names the files of `folder` in errors instead of those that show them."""
    try:
        yield
    except InputErrors:
        raise
    except InputError as error:
        where, found = (text.replace(str(shown), str(folder)) for text in (error.where, error.found))
        raise InputError(where, found, error.expected, error.cure) from error
    except OSError as error:
        if error.errno is None:
            raise
        name = str(error.filename or folder).replace(str(shown), str(folder))
        raise OSError(error.errno, error.strerror, name) from error


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """One process at a time; the folder is free again when the process ends, however it ends."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                found = "another process changes this folder"
                raise InputError(str(folder), found, "one change at a time", "wait for it") from None
        for left in folder.glob(f"{MAKING}*"):
            shutil.rmtree(left, ignore_errors=True)
        yield
    finally:
        os.close(handle)
