"""New files and folders: checked before the work, never in the place of another, whole or not at all."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from tactile.base import bounded, files
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.samples import robust_sd, true_runs


def names(folder):
    return {path.name for path in folder.iterdir()}


def raising(code):
    def refuse(*path):
        raise OSError(code, os.strerror(code), *map(str, path[:1]))

    return refuse


def test_what_cannot_be_made_is_refused_by_its_own_name(tmp_path, monkeypatch):
    file, link, new = tmp_path / "file", tmp_path / "link", tmp_path / "new"
    file.touch()
    link.symlink_to("nowhere")
    long = tmp_path / ("n" * 300)
    files.require_new_file(new)
    files.require_writable(file)
    for path, message in (
        (file, f"{file}: exists already"),
        (link, f"{link}: a link to nowhere"),
        (tmp_path / "none" / "new", f"{tmp_path / 'none'}: no such folder"),
        (file / "new", f"{file}: not a folder"),
        (long, f"{long}: cannot be written (File name too long)"),
        (new, f"{new}: cannot be written (Permission denied)"),
    ):
        with monkeypatch.context() as patch:
            if path == new:
                patch.setattr(Path, "touch", raising(errno.EACCES))
            with pytest.raises(InputError) as caught:
                files.require_new_file(path)
        assert str(caught.value).startswith(message)
    assert names(tmp_path) == {"file", "link"}


def test_a_folder_that_the_same_command_made_goes_on(tmp_path):
    own, other = tmp_path / "own", tmp_path / "other"
    for folder in (own, other):
        files.require_own_folder(folder, ["runs.jsonl"])
        folder.mkdir()
        files.require_own_folder(folder, ["runs.jsonl"])
    (own / "runs.jsonl").touch()
    (other / "table.csv").touch()
    files.require_own_folder(own, ["runs.jsonl"])
    with pytest.raises(InputError, match=r"other: a folder with other files, such as table\.csv"):
        files.require_own_folder(other, ["runs.jsonl"])
    (own / "table.csv").symlink_to(other / "table.csv")
    with pytest.raises(InputError, match=r"own/table\.csv: a link or a device"):
        files.require_own_folder(own, ["runs.jsonl"])


def test_a_file_that_appears_meanwhile_stays(tmp_path, monkeypatch):
    path = tmp_path / "new"

    def write(temporary):
        temporary.write_text("ours")
        path.write_text("theirs")

    with pytest.raises(InputError, match="meanwhile"):
        files.make_new_file(path, write)
    monkeypatch.setattr(os, "link", raising(errno.EPERM))
    with pytest.raises(InputError, match="meanwhile"):
        files.make_new_file(path, write)
    assert path.read_text() == "theirs"
    files.make_new_file(tmp_path / "more", lambda temporary: temporary.write_text("ours"))
    assert names(tmp_path) == {"new", "more"}


@pytest.mark.parametrize(
    "appear",
    [lambda new: (new / "b").mkdir(parents=True), Path.touch, lambda new: new.symlink_to("nowhere")],
    ids=["folder", "file", "link"],
)
def test_a_folder_appears_whole_and_does_not_replace_what_appears_meanwhile(appear, tmp_path):
    path, whole = tmp_path / "new", tmp_path / "whole"

    def make():
        with files.new_folder(path) as folder:
            (folder / "a").write_text("ours")
            appear(path)

    with pytest.raises(InputError, match="meanwhile"):
        make()
    with files.new_folder(whole) as folder:
        (folder / "a").touch()
        assert not whole.exists()
    assert names(whole) == {"a"}
    assert names(tmp_path) == {"new", "whole"}


def test_the_temporary_file_is_hidden_and_keeps_suffix_and_mode(tmp_path):
    file = tmp_path / "a.png"
    file.touch(0o600)

    def write(path):
        assert path.name.startswith(".")
        assert path.suffix == ".png"
        path.write_bytes(b"1")
        files.flush_to_disk(path)
        assert file.read_bytes() == b""

    files.write_atomically(file, write)
    assert file.read_bytes() == b"1"
    assert file.stat().st_mode & 0o777 == 0o600
    assert names(tmp_path) == {"a.png"}


def test_errors_of_writing_leave_the_old_file_and_name_it(tmp_path):
    path, old = tmp_path / "a", tmp_path / "old"
    files.write_text_atomically(old, "old")

    def full(temporary):
        raise OSError(errno.ENOSPC, "full", "source", None, str(temporary))

    def unnamed(temporary):
        temporary.write_text("half")
        raise OSError(errno.ENOSPC, "full")

    for write in (full, unnamed, lambda temporary: (temporary / "b").touch()):
        atomically = files.write_atomically
        for make, file in ((atomically, path), (files.make_new_file, path), (atomically, old)):
            with pytest.raises(OSError, match=r"full|Not a directory|No such file") as caught:
                make(file, write)
            assert caught.value.filename == str(file)
    with pytest.raises(FileNotFoundError) as missing:
        files.make_new_file(path, lambda temporary: (tmp_path / "source").read_bytes())
    assert missing.value.filename == str(tmp_path / "source")
    assert names(tmp_path) == {"old"}
    assert old.read_text() == "old"


def test_outliers_change_the_robust_spread_little():
    deviation = stream(0, "deviation").normal(0.0, [1.0, 3.0], (20_000, 2))
    assert robust_sd(deviation) == pytest.approx([1.0, 3.0], rel=0.03)
    deviation[:2000] += 1e6
    assert robust_sd(deviation) == pytest.approx([1.0, 3.0], rel=0.2)


def test_runs_of_true_values_are_half_open_and_reach_both_ends():
    which = np.array([1, 1, 0, 1, 0, 0, 1, 1], bool)
    assert true_runs(which).tolist() == [[0, 2], [3, 4], [6, 8]]
    assert true_runs(which[:0]).tolist() == true_runs(~which[:2]).tolist() == []


def test_an_archive_that_expands_to_too_much_is_refused_before_it_is_read(tmp_path, monkeypatch):
    file = tmp_path / "zeros.npz"
    np.savez_compressed(file, a=np.zeros(1 << 18))
    monkeypatch.setattr(bounded, "MOST_BYTES", 1 << 20)
    monkeypatch.setattr("zipfile.ZipFile.read", None)
    with pytest.raises(InputError, match="expands to"):
        bounded.read_npz(file, ["a"], np.asarray, "an array")
