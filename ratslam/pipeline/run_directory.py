"""A run directory: what a run leaves behind, readable at every moment.

Text files grow by whole lines, a chunk at a time; everything else appears in one piece by renaming. So an
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
"""Of steps.csv, before those of the backend: s; the pose is the one told at that step, in the map frame (m,
rad)."""


class RunDirectory:
    """Files of one run.

    Args:
        columns: that the backend adds to steps.csv.

    Raises:
        InputError: the directory exists already, or cannot be made.
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
                str(path), f"cannot be made ({error.strerror})", "a folder that can be written"
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
            # A full disk has been reported by the write that met it; closing would only repeat it.
            with suppress(OSError):
                stream.close()

    def append(self, lines: Mapping[str, Iterable[str]]) -> None:
        """Adds whole lines to the streams and hands them to the operating system."""
        for name, added in lines.items():
            self._streams[name].write("".join(added))
            self._streams[name].flush()

    def text(self, name: str, content: str) -> None:
        """A text file, in one piece."""
        write_text_atomically(self.path / name, content)

    def manifest(self, content: Mapping[str, Any]) -> None:
        """manifest.json, in one piece."""
        self.text("manifest.json", json.dumps(content, indent=2, allow_nan=False) + "\n")

    def checkpoint(self, arrays: Mapping[str, np.ndarray]) -> None:
        """map.npz, in one piece."""

        def write(path: Path) -> None:
            with path.open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

        write_atomically(self.path / "map.npz", write)

    def file(self, name: str, write: Any) -> None:
        """Any file in one piece; `write(path)` makes it under a temporary name of the same ending."""
        write_atomically(self.path / name, write)


def read_checkpoint(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a map.npz.

    Raises:
        InputError: there is no such file, or it is not a whole checkpoint.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise InputError(str(path), "no such file", "the map.npz of a run directory") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(str(path), f"not a checkpoint ({error})", "the map.npz of a run directory") from None
    if "steps" not in arrays:
        raise InputError(str(path), "arrays of something else", "the map.npz of a run directory")
    return arrays
