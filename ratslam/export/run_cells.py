"""Reads the recorded cells of a run directory and draws their spikes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from evaluation.cells.recording import NAME, CellRecording, read_recording
from ratslam.config.run_config import load_config
from ratslam.core.precision import prepare_precision
from ratslam.rats.settled_peak import settled_peak
from ratslam.rats.spikes import SpikeConfig, SpikeTrains, draw_spikes
from robot.sources.input_files import digest_of
from tactile.base.errors import InputError

CURE = "add `cells: {chosen: 64}` to the configuration and run it again"


class RunCells(NamedTuple):
    """Recorded cells of a run, their spikes, and the sha256 (hex) of all that they were made from."""

    recording: CellRecording
    spikes: SpikeTrains
    digest: str


def read_run_cells(directory: Path, config: SpikeConfig) -> RunCells:
    """Reads the chosen cells of a run and draws their spikes. A cell fires at the peak rate at the peak of a
    settled packet of the run's network; that is computed in float64, also for a run in float32.

    Raises:
        InputError: the run has no recorded cells, no chosen ones among them, or a file is malformed.
    """
    file = directory / NAME
    if not file.exists():
        raise InputError(str(file), "no such file", "a run with recorded pose cells", CURE)
    recording = read_recording(file)
    if not len(recording.cell):
        raise InputError(str(file), "no chosen cells", "cells recorded at every step", CURE)
    prepare_precision("float64")
    network = load_config(directory / "config.yaml").pose_cells
    spikes = draw_spikes(recording, settled_peak(network), config)
    documents = [network.model_dump_json().encode(), config.model_dump_json().encode()]
    return RunCells(recording, spikes, digest_of([file.read_bytes(), *documents]))
