"""New files and folders: checked before the work, and never in the place of another."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from tactile.base.errors import InputError
from tactile.base.files import (
    make_new_file,
    new_folder,
    require_new_file,
    require_own_folder,
    require_writable,
    write_atomically,
)


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        require_new_file(path)
    return str(caught.value)


def test_what_cannot_be_made_is_refused_by_its_own_name(tmp_path: Path, monkeypatch) -> None:
    file, link = tmp_path / "file", tmp_path / "link"
    file.touch()
    link.symlink_to("nowhere")
    assert refusal(file).startswith(f"{file}: exists already")
    assert refusal(link).startswith(f"{link}: a link to nowhere, which does not exist")
    assert refusal(tmp_path / "none" / "new").startswith(f"{tmp_path / 'none'}: no such folder")
    assert refusal(file / "new").startswith(f"{file}: not a folder")
    long = tmp_path / ("n" * 300)
    assert refusal(long).startswith(f"{long}: cannot be written (File name too long)")
    require_new_file(tmp_path / "new")
    require_writable(file)

    def deny(path: Path, *_: object) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(Path, "touch", deny)
    denied = refusal(tmp_path / "new")
    assert denied.startswith(f"{tmp_path / 'new'}: cannot be written (Permission denied)")
    assert {path.name for path in tmp_path.iterdir()} == {"file", "link"}


def test_a_folder_that_the_same_command_made_goes_on(tmp_path: Path) -> None:
    own, other = tmp_path / "own", tmp_path / "other"
    for folder in (own, other):
        require_own_folder(folder, ["runs.jsonl"])
        folder.mkdir()
        require_own_folder(folder, ["runs.jsonl"])
    (own / "runs.jsonl").touch()
    (other / "table.csv").touch()
    require_own_folder(own, ["runs.jsonl"])
    with pytest.raises(InputError, match=r"other: a folder with other files, such as table\.csv"):
        require_own_folder(other, ["runs.jsonl"])
    (own / "table.csv").symlink_to(other / "table.csv")
    with pytest.raises(InputError, match=r"own/table\.csv: a link or a device"):
        require_own_folder(own, ["runs.jsonl"])


def test_a_file_that_appears_meanwhile_stays(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "new"

    def write(temporary: Path) -> None:
        temporary.write_text("ours")
        path.write_text("theirs")

    with pytest.raises(InputError, match="meanwhile"):
        make_new_file(path, write)
    monkeypatch.setattr(os, "link", _not_supported)
    with pytest.raises(InputError, match="meanwhile"):
        make_new_file(path, write)
    assert path.read_text() == "theirs"
    make_new_file(tmp_path / "more", lambda temporary: temporary.write_text("ours"))
    assert {file.name for file in tmp_path.iterdir()} == {"new", "more"}


def _not_supported(*_: object) -> None:
    raise OSError(errno.EPERM, os.strerror(errno.EPERM))


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_a_folder_does_not_replace_what_appears_meanwhile(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "new"

    def make() -> None:
        with new_folder(path) as folder:
            (folder / "a").write_text("ours")
            if kind == "folder":
                path.mkdir()
                (path / "b").touch()
            elif kind == "file":
                path.touch()
            else:
                path.symlink_to("nowhere")

    with pytest.raises(InputError, match="meanwhile"):
        make()
    assert [file.name for file in tmp_path.iterdir()] == ["new"]


def test_a_folder_appears_whole(tmp_path: Path) -> None:
    with new_folder(tmp_path / "new") as folder:
        (folder / "a").touch()
        assert not (tmp_path / "new").exists()
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["a"]


def test_errors_of_writing_name_the_file_and_not_its_temporary_or_source(tmp_path: Path) -> None:
    path = tmp_path / "a"

    def full(temporary: Path) -> None:
        raise OSError(errno.ENOSPC, "full", "source", None, str(temporary))

    def unnamed(temporary: Path) -> None:
        raise OSError(errno.ENOSPC, "full")

    for write in (full, unnamed, lambda temporary: (temporary / "b").touch()):
        for make in (write_atomically, make_new_file):
            with pytest.raises(OSError, match=r"full|Not a directory|No such file") as caught:
                make(path, write)
            assert caught.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as missing:
        make_new_file(path, lambda temporary: (tmp_path / "source").read_bytes())
    assert missing.value.filename == str(tmp_path / "source")
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_is_replaced_keeps_its_mode(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.touch(0o600)
    write_atomically(path, lambda temporary: temporary.write_text("new"))
    assert path.stat().st_mode & 0o777 == 0o600
