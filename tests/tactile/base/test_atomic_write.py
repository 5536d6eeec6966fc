"""Atomic writes leave the old file or the complete new one, and no temporary file."""

from pathlib import Path

import pytest

from tactile.base.files import flush_to_disk, write_atomically, write_text_atomically


def test_the_temporary_file_is_hidden_and_keeps_the_suffix(tmp_path: Path) -> None:
    seen: list[Path] = []

    def write(path: Path) -> None:
        seen.append(path)
        path.write_bytes(b"1")
        flush_to_disk(path)
        assert not (tmp_path / "a.png").exists()

    write_atomically(tmp_path / "a.png", write)
    assert seen[0].name.startswith(".")
    assert seen[0].suffix == ".png"
    assert (tmp_path / "a.png").read_bytes() == b"1"
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    write_text_atomically(tmp_path / "a.txt", "old")

    def fail(path: Path) -> None:
        path.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(tmp_path / "a.txt", fail)
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
