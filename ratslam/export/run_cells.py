"""Reads the recorded cells of a run directory, draws their spikes and scores them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from evaluation.cells.analysis import AnalysisSettings, CellScores, analyse_all_cells, analyse_cells
from evaluation.cells.recording import NAME, CellRecording, read_recording
from ratslam.attractor.config import PoseCellConfig
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
    recording, network = _read_cells(directory)
    file = directory / NAME
    if not len(recording.cell):
        raise InputError(str(file), "no chosen cells", "cells recorded at every step", CURE)
    spikes = draw_spikes(recording, settled_peak(network), config)
    documents = [network.model_dump_json().encode(), config.model_dump_json().encode()]
    return RunCells(recording, spikes, digest_of([file.read_bytes(), *documents]))


def score_run_cells(directory: Path, peak_rate: float) -> CellScores:
    """Scores of the chosen cells of a run; if only sums were recorded, of all cells.

    Args:
        peak_rate: of a cell at the peak of a settled packet of the run's network, Hz.

    Raises:
        InputError: the run has no recorded cells, no true pose is known, the path has no area, or a file is
            malformed.
    """
    recording, network = _read_cells(directory)
    settings = AnalysisSettings(gain=peak_rate / settled_peak(network))
    analyse = analyse_all_cells if not len(recording.cell) and recording.sums else analyse_cells
    return analyse(recording, settings)


def _read_cells(directory: Path) -> tuple[CellRecording, PoseCellConfig]:
    """The recorded cells of a run and its network; sets JAX to float64."""
    file = directory / NAME
    if not file.exists():
        raise InputError(str(file), "no such file", "a run with recorded pose cells", CURE)
    recording = read_recording(file)
    prepare_precision("float64")
    return recording, load_config(directory / "config.yaml").pose_cells
