"""Recordings as rows of tables: where they are, how they are configured, which are missing."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ratslam.runs.settings.run_config import RunConfig, load_config

DATA = "RATSLAM_DATA"
"""Environment variable: the folder of the real recordings, which are not part of the project."""
GOLDEN = "../tests/golden"
"""Folder of test recordings, from the folder of the configurations."""


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
        if self.real and not os.environ.get(DATA):
            return f"set {DATA} to the folder of the real recordings"
        if not Path(self.config).exists():
            return f"{self.config} does not exist; run the command in the repository"
        recording = self.configuration().recording
        if recording is None or recording.file.exists():
            return ""
        return f"{recording.file} does not exist"


def real_recordings() -> Path | None:
    """The folder of the real recordings; None if it is not set."""
    folder = os.environ.get(DATA)
    return Path(folder) if folder else None


def metres(value: float | np.floating) -> str:
    """A length with three significant digits or so."""
    return f"{value:.3f}" if value < 1 else f"{value:.2f}"
