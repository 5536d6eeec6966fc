"""The run directory: files of a run, readable at any moment.

Text files grow by whole lines, one chunk at a time; all other files appear complete, by renaming. So an
interrupt, a kill or a full disk leaves a readable prefix.
"""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

from tactile.base.atomic_write import write_atomically, write_text_atomically
from tactile.base.errors import os_errors_of
from tactile.base.new_file import require_new_file

COLUMNS = (
    "t", "place", "action", "x", "y", "heading", "sd_x", "sd_y", "sd_heading", "lost", "doubt", "outcome",
)  # fmt: skip
"""Columns of steps.csv before those of the backend: time (s), experience, action, online pose in the map
frame and its standard deviations (m, m, rad), flag, probability that the map is worse than odometry,
outcome."""
STREAMS = ("online.tum", "odometry.tum", "truth.tum", "steps.csv", "online_error.csv", "timing.csv")
"""Files that grow by whole lines."""


class RunDirectory:
    """A new run directory; a context manager that closes its text files.

    Its process holds a lock on steps.csv, by which a run is told from one that was killed.

    Args:
        columns: columns of steps.csv that the backend adds. manifest: the first text of manifest.json, which
            is there before the other files.

    Raises:
        InputError: the directory exists or cannot be created.
    """

    def __init__(self, path: Path, columns: Iterable[str] = (), manifest: str = "") -> None:
        self.path = path
        require_new_file(path, parents=True)
        with os_errors_of(path, "cannot be created", "a writable folder"):
            path.mkdir(parents=True)
        if manifest:
            self.text("manifest.json", manifest)
        self._streams = {name: (path / name).open("x", encoding="utf-8", newline="") for name in STREAMS}
        with suppress(OSError):  # a file system without locks
            fcntl.flock(self._streams["steps.csv"], fcntl.LOCK_EX)
        heads = {"steps.csv": ",".join((*COLUMNS, *columns)), "online_error.csv": "t,error"}
        heads["timing.csv"] = "step,steps,seconds"
        self.append({name: head + "\n" for name, head in heads.items()})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for stream in self._streams.values():
            # A full disk has been reported by the failed write; closing would report it again.
            with suppress(OSError):
                stream.close()

    def append(self, lines: Mapping[str, Iterable[str]]) -> None:
        """Appends whole lines to the text files and flushes them."""
        for name, added in lines.items():
            with self._writing(name):
                self._streams[name].write("".join(added))
                self._streams[name].flush()

    def text(self, name: str, content: str) -> None:
        """Writes a text file atomically."""
        with self._writing(name):
            write_text_atomically(self.path / name, content)

    def file(self, name: str, write: Callable[[Path], Any]) -> None:
        """Writes any file atomically: `write(path)` gets a temporary path with the same suffix."""
        with self._writing(name):
            write_atomically(self.path / name, write)

    @contextmanager
    def _writing(self, name: str) -> Iterator[None]:
        """Names the file in errors, and notes what holds of the others."""
        try:
            yield
        except OSError as error:
            if error.errno is None:
                raise
            named = OSError(error.errno, error.strerror, error.filename or str(self.path / name))
            named.add_note("the files written before are complete")
            raise named from error
