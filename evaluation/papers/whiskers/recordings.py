"""Paths of the real recordings, and what they do not show."""

from __future__ import annotations

from pathlib import Path

from tactile.base.errors import InputError

REACH = "real_touch/whiskersensing_stanford/derived/reaching_take20_in_clutter.csv"
"""The arm in clutter (`robot/recordings/real_whiskers.py`), below the folder of the real recordings."""
UNPROVEN = """\
## What these recordings do not show
- No public recording has whiskers, revisits and true positions together. So no map here is made by real
  whiskers: the images of the walk were recorded, its poses and odometry are simulated.
- No real head was whisking. Contact was measured on passive magnetic whiskers of one arm, in a reach of 12 s;
  the rest angle and the radii of a head were fitted on simulated heads only.
- No whisker of these recordings is known to be bent for good, and no touch recording is longer than a minute:
  hours of drift are made of the drift of that one reach.
- The Create is one drive of nine minutes in one room.
- No live session ran on real hardware: arm, head and Create were emulators.
"""
"""Last section of the page."""


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
