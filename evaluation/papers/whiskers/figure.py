"""One figure on real recordings: what it measures, its table and its picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from tactile.base.errors import InputError

REACH = "real_touch/whiskersensing_stanford/derived/reaching_take20_in_clutter.csv"
"""The arm in clutter (`robot/recordings/real_whiskers.py`), below the folder of the real recordings."""


class RealFigure(NamedTuple):
    """A figure; each module of this room offers one as `FIGURE`.

    Attributes:
        title: one line. measure: the result, from the folder of the real recordings. table: the lines of a
            Markdown table of the result, each figure beside its control, and sentences about what it does
            not show. draw: draws the result into a new PNG file.
    """

    title: str
    measure: Callable[[Path], Any]
    table: Callable[[Any], list[str]]
    draw: Callable[[Any, Path], None]


def require_recordings(folder: Path, *names: str) -> list[Path]:
    """The paths of files or folders below `folder`.

    Raises:
        InputError: one does not exist.
    """
    paths = [folder / name for name in names]
    for path in paths:
        if not path.exists():
            cure = "set RATSLAM_DATA to the folder of the real recordings"
            raise InputError(str(path), "no such file or folder", "a real recording", cure)
    return paths
