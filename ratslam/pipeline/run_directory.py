"""The run directory: files of a run, readable at any moment.

Text files grow by whole lines, one chunk at a time; all other files appear complete, by renaming. So an
interrupt, a kill or a full disk leaves a readable prefix.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from tactile.base.atomic_write import write_atomically, write_text_atomically
from tactile.base.errors import InputError

COLUMNS = (
    "t", "place", "action", "x", "y", "heading", "sd_x", "sd_y", "sd_heading", "lost", "outcome",
)  # fmt: skip
"""Columns of steps.csv before those of the backend: time (s), experience, action, online pose in the map
frame and its standard deviations (m, m, rad), flag, outcome."""


class RunDirectory:
    """A new run directory.

    Args:
        columns: columns of steps.csv that the backend adds.

    Raises:
        InputError: the directory exists or cannot be created.
    """

    STREAMS = ("online.tum", "odometry.tum", "truth.tum", "steps.csv", "online_error.csv")

    def __init__(self, path: Path, columns: Iterable[str] = ()) -> None:
        self.path, self.columns = path, (*COLUMNS, *columns)
        if path.exists():
            raise InputError(str(path), "exists already", "a new run directory", "choose another with -o")
        try:
            path.mkdir(parents=True)
        except OSError as error:
            raise InputError(
                str(path), f"cannot be created ({error.strerror})", "a writable folder"
            ) from None
        self._streams: dict[str, TextIO] = {}

    def __enter__(self) -> RunDirectory:
        self._streams = {
            name: (self.path / name).open("x", encoding="utf-8", newline="") for name in self.STREAMS
        }
        self._streams["steps.csv"].write(",".join(self.columns) + "\n")
        self._streams["online_error.csv"].write("t,error\n")
        return self

    def __exit__(self, *_: object) -> None:
        for stream in self._streams.values():
            # A full disk has been reported by the failed write; closing would report it again.
            with suppress(OSError):
                stream.close()

    def append(self, lines: Mapping[str, Iterable[str]]) -> None:
        """Appends whole lines to the text files and flushes them."""
        for name, added in lines.items():
            self._streams[name].write("".join(added))
            self._streams[name].flush()

    def text(self, name: str, content: str) -> None:
        """Writes a text file atomically."""
        write_text_atomically(self.path / name, content)

    def manifest(self, content: Mapping[str, Any]) -> None:
        """Writes manifest.json atomically."""
        self.text("manifest.json", json.dumps(content, indent=2, allow_nan=False) + "\n")

    def checkpoint(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Writes map.npz atomically."""

        def write(path: Path) -> None:
            with path.open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

        write_atomically(self.path / "map.npz", write)

    def file(self, name: str, write: Any) -> None:
        """Writes any file atomically: `write(path)` gets a temporary path with the same suffix."""
        write_atomically(self.path / name, write)


def read_checkpoint(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a map.npz.

    Raises:
        InputError: there is no such file, or it is not a complete checkpoint.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise InputError(str(path), "no such file", "the map.npz of a run directory") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(str(path), f"not a checkpoint ({error})", "the map.npz of a run directory") from None
    if "steps" not in arrays:
        raise InputError(str(path), "an archive of other arrays", "the map.npz of a run directory")
    return arrays
