"""Recorded cells of a rat in a box of 1 m: a session of `configs/rat_box.yaml`, as long as wanted."""

from __future__ import annotations

from typing import Literal

import numpy as np

from evaluation.cells.recording import CellRecording
from ratslam.config.run_config import load_config
from ratslam.experiments.cells.rat_sessions import RatSessions
from ratslam.pipeline.source import open_observations

Way = Literal["rat", "random walk"]
"""The path of a real rat (Sargolini et al. 2006, packaged), or a random walk."""
SECONDS = 599.0
"""Duration of a session, s: nearly that of the packaged path."""


def record_rat(
    way: Way, chosen: int, sums: bool = False, seconds: float = SECONDS, seed: int = 0
) -> CellRecording:
    """The pose cells of a session at 20 Hz with views at 10 Hz and errors of the odometry.

    Args:
        chosen: cells, drawn from the whole network. sums: whether all cells are summed at 10 Hz. seed: of the
            cells, the errors and the random walk.
    """
    own = [f"rat_simulation.seconds={seconds}", f"rat_simulation.seed={seed}", f"session.seed={seed}"]
    own += [f"cells.chosen={chosen}", "session.reserve=1024"]
    own += ["cells.sums={}"] if sums else []
    own += ["rat_simulation.walk={}"] if way == "random walk" else []
    with open_observations(load_config("rat_box", own)) as (config, source):
        return RatSessions(config).run(source).recording


def with_active_cells(recording: CellRecording, cells: int) -> CellRecording:
    """The recording with the first so many chosen cells that were ever active."""
    kept = np.flatnonzero(recording.activity.any(axis=0))[:cells]
    return recording._replace(cell=recording.cell[kept], activity=recording.activity[:, kept])
