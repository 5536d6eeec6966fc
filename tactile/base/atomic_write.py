"""Atomic file writes: a reader finds the old file or the complete new one, never a part of it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_atomically(path: Path, write: Callable[[Path], Any]) -> None:
    """Calls `write` with a hidden temporary path in the same folder, then renames that file to `path`.

    The temporary name keeps the file's suffix and contains the process id, so two processes may write the
    same file. If `write` raises, `path` stays as it was and the temporary file is removed.
    """
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        write(temporary)
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
