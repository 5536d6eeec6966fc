"""Recordings of tables and figures: where they are, how they are configured, which are missing."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ratslam.runs.settings.run_config import RunConfig, load_config
from tactile.base.errors import InputError

DATA = "RATSLAM_DATA"
"""Environment variable: the folder of the real recordings, which are not part of the project."""
GOLDEN = "../tests/golden"
"""Folder of test recordings, from the folder of the configurations."""

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
"""Last section of the page about real whiskers and wheels."""


class Recording(NamedTuple):
    """A recording of a table: its label, configuration (from the folder of the repository), and replaced
    settings, each `a.b=value`.

    Attributes:
        real: whether it is one of `DATA`.
    """

    label: str
    config: str
    assignments: tuple[str, ...] = ()
    real: bool = False

    def configuration(self, *assignments: str) -> RunConfig:
        """Its configuration with further settings replaced.

        Raises:
            InputErrors: the file or a replaced setting is not valid.
        """
        return load_config(self.config, [*self.assignments, *assignments])

    def missing(self) -> str:
        """The reason that it cannot be used; "" if it can."""
        if self.real and real_recordings() is None:
            return f"set {DATA} to the folder of the real recordings"
        if not Path(self.config).exists():
            return f"{self.config} does not exist; run the command in the repository"
        recording = self.configuration().recording
        if recording is None or recording.file is None or recording.file.exists():
            return ""
        return f"{recording.file} does not exist"


def real_recordings() -> Path | None:
    """The folder of the real recordings; None if it is not set."""
    folder = os.environ.get(DATA)
    return Path(folder) if folder else None


def require_recordings(folder: Path, *names: str) -> list[Path]:
    """The paths of files or folders below `folder`.

    Raises:
        InputError: one does not exist.
    """
    paths = [folder / name for name in names]
    for path in paths:
        if not path.exists():
            cure = f"set {DATA} to the folder of the real recordings"
            raise InputError(str(path), "no such file or folder", "a real recording", cure)
    return paths


def metres(value: float | np.floating) -> str:
    """A length with three significant digits or so."""
    return f"{value:.3f}" if value < 1 else f"{value:.2f}"
