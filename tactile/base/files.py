"""Files: written atomically, made new without replacing any, several of a folder changed as one.

An atomic write leaves the old file or the complete new one, never a part of it. New files and folders are
checked before the work, made whole, and never put in the place of what others made. A change of several files
of a folder is made beside them, and put in place when it is complete: until then the folder stays as it was;
from then on a kill delays the change, and `finish_change` ends it.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from tactile.base.errors import InputError, InputErrors, os_errors_of

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
    names = error.filename, error.filename2
    named = [Path(os.fsdecode(name)) for name in names if isinstance(name, str | bytes)]
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
def hidden_folder(path: Path, inside: Path, prefix: str) -> Iterator[Path]:
    """A folder of a context in the folder `inside`, removed at its end; errors of it name `path`."""
    try:
        folder = Path(mkdtemp(dir=inside, prefix=prefix))
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        with errors_of(path, folder):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A hidden folder in which a context makes files; at its end it becomes the folder `path`.

    Raises:
        InputError: another program has made it meanwhile.
    """
    with hidden_folder(path, path.parent, f".{path.name}.") as folder:
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


def _appeared(path: Path) -> InputError:
    found = "another program has made it meanwhile; it stays as it is"
    return InputError(str(path), found, "a new file", CURE)


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
        with _errors_of_shown(folder, shown):
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

    from tactile.base.bounded import read_json  # loads NumPy

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
def _errors_of_shown(folder: Path, shown: Path) -> Iterator[None]:
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
