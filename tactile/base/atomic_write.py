"""Files that are whole whenever somebody looks."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def in_one_piece(path: Path, write: Callable[[Path], Any]) -> None:
    """Has a file written under a hidden name of the same ending in the same folder, and then renames it."""
    part = path.with_name(f".{os.getpid()}.{path.name}")  # two processes may write the same file
    try:
        write(part)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
