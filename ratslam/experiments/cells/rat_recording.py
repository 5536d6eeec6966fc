"""Recorded cells of a rat in a box of 1 m: a session of `configs/rat_box.yaml`, as long as wanted."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Literal

import numpy as np

from evaluation.cells.recording import NAME, CellRecording, read_recording
from ratslam.config.run_config import load_config
from ratslam.core.session import CHUNK
from ratslam.pipeline.build_session import build_session
from ratslam.pipeline.cell_recorder import open_cell_recorder
from ratslam.pipeline.source import open_observations

Way = Literal["rat", "random walk"]
"""The path of a real rat (Sargolini et al. 2006, packaged), or a random walk."""
SECONDS = 600.0
"""Duration of the packaged path, s."""


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
        session = build_session(config, source)
        with tempfile.TemporaryDirectory() as folder:
            recorder = open_cell_recorder(config, source, session.backend, Path(folder))
            assert recorder is not None
            every = list(source)
            for first in range(0, len(every), CHUNK):
                samples = every[first : first + CHUNK]
                recorder.add(samples, list(session.replay([sample.reading for sample in samples])))
            recorder.finish()
            return read_recording(Path(folder) / NAME)


def with_active_cells(recording: CellRecording, cells: int) -> CellRecording:
    """The recording with the first so many chosen cells that were ever active."""
    kept = np.flatnonzero(recording.activity.any(axis=0))[:cells]
    return recording._replace(cell=recording.cell[kept], activity=recording.activity[:, kept])
