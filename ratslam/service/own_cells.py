"""Cells of one's own, from NWB files: their scores as those of pose cells, and both side by side."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.cells.analysis import analyse_cells, control_scores, write_scores
from evaluation.cells.cell_comparison import LEAST_SPIKES, ComparedScore, Interval, compare_cells
from evaluation.cells.rate_map import running_speed
from evaluation.cells.recording import CellRecording, record_spikes
from ratslam.runs.settings.run_config import load_config
from ratslam.service.export_formats import read_run_cells
from ratslam.service.spikes import SpikeConfig
from robot.recordings.nwb_file import NwbConfig, read_nwb
from robot.simulation.rat.rat_path import MotionConfig
from robot.sources.source import Warn
from tactile.base.errors import InputError
from tactile.base.files import make_new_file

STANDING = MotionConfig().standing
"""Speed, m/s, below which an animal whose head direction was not measured has no heading."""


class OwnCells(NamedTuple):
    """Recorded cells. Attributes: recording: their spikes on the path. names: of the units. described: the
    session in one sentence."""

    recording: CellRecording
    names: tuple[str, ...]
    described: str


def read_own_cells(path: Path, config: NwbConfig | None = None, warn: Warn = None) -> OwnCells:
    """The units of an NWB file on the path of the animal.

    Without a measured head direction, the heading is the direction of motion, and samples at less than
    `STANDING` do not count.

    Args:
        warn: called with one sentence for each thing that is not as it should be.

    Raises:
        InputError: as `read_nwb`, or it has no spikes.
    """
    session = read_nwb(path, config, warn)
    if not session.spikes:
        cure = "export them from the spike sorter as an NWB table `units` with spike_times"
        raise InputError(str(path), "no units with spike times", "the spikes of cells", cure)
    heading, said = session.heading, "measured heading"
    if heading is None:
        said = f"no head direction, so that of motion above {STANDING:g} m/s"
        padded = np.column_stack([session.position, np.zeros(len(session.time))])
        moving = running_speed(session.time, padded) >= STANDING
        velocity = np.gradient(session.position, session.time, axis=0)
        heading = np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)
    truth = np.column_stack([session.position, heading])
    if session.observed is not None and warn is not None:
        outside = [(session.time < first) | (session.time > last) for first, last in session.observed]
        if lost := int(np.all(outside, axis=0).sum()):
            warn(f"{path}: {lost} samples lie outside of the times in which all units were recorded")
    recording = record_spikes(session.time, truth, session.spikes, session.observed)
    known = np.isfinite(recording.truth).all(axis=1)
    count = sum(map(len, session.spikes))
    described = f"{session.subject or 'unnamed subject'}, {session.start}: {len(session.names)} cells, "
    described += f"{count} spikes, {session.time[-1] - session.time[0]:.0f} s, {said}, "
    described += f"place and heading known in {100 * known.mean():.1f} % of the samples"
    return OwnCells(recording, session.names, described)


def score_own_cells(
    path: Path,
    output: Path,
    config: NwbConfig | None = None,
    warn: Warn = None,
    shuffles: int = 100,
    seed: int = 0,
) -> str:
    """Writes the scores of the units of an NWB file with their controls; the session in words.

    Args:
        output: a new CSV file (`write_scores`), a line for each unit. shuffles: of each unit. seed: of the
            shuffles.

    Raises:
        InputError: as `read_own_cells` and `control_scores`.
    """
    cells, names, described = read_own_cells(path, config, warn)
    scores, controls = analyse_cells(cells), control_scores(cells, shuffles, seed)
    make_new_file(output, lambda file: write_scores(file, scores, controls, names))
    return described


def compare_run(
    directory: Path,
    path: Path,
    config: NwbConfig | None = None,
    warn: Warn = None,
    turn: float | None = None,
    spikes: SpikeConfig | None = None,
    shuffles: int = 100,
    least: int = LEAST_SPIKES,
) -> tuple[str, list[ComparedScore]]:
    """The cells of a run beside those of an NWB file; both in words, and the lines of the comparison.

    The activity of the run's cells becomes Poisson spikes on its true path, which are scored as the data's
    are. The time at which its cues turned is that of the first phase of the run that turns them.

    Args:
        directory: of a run with chosen cells. turn: when cues turned in the data, s; None: not at all.
        spikes: of the run's cells; its seed is also that of shuffles and bootstrap. shuffles: of each cell.
        least: spikes of a cell that is compared.

    Raises:
        InputError: as `read_run_cells`, `read_own_cells` and `compare_cells`.
    """
    spikes = spikes or SpikeConfig()
    recording, trains, _ = read_run_cells(directory, spikes)
    model = record_spikes(recording.time, recording.truth, trains.times)
    simulation = load_config(directory / "config.yaml").rat_simulation
    phases = () if simulation is None else simulation.phases
    turned = next((phase.start for phase in phases if phase.rotate_cues_deg), None)
    cells = read_own_cells(path, config, warn)
    rows = compare_cells(model, cells.recording, (turned, turn), shuffles, least, seed=spikes.seed)
    described = f"model {directory}: {len(trains.cell)} cells, {sum(map(len, trains.times))} spikes, "
    seconds = recording.time[-1] - recording.time[0]
    described += f"{seconds:.0f} s, peak rate {spikes.peak_rate:g} Hz, seed {spikes.seed}"
    return f"{described}\ndata {path}: {cells.described}", rows


COLUMNS = ("score", "model", "data", "data - model", "P(data > model)", "cells")


def comparison_table(rows: list[ComparedScore]) -> Iterator[tuple[str, ...]]:
    """The lines of a comparison as text, its header first; each number with its 95 % interval."""

    def shown(interval: Interval) -> str:
        first, low, high = interval
        return "-" if np.isnan(first) else f"{first:.3g} [{low:.3g}, {high:.3g}]"

    yield COLUMNS
    for row in rows:
        numbers = map(shown, (row.model, row.data, row.difference, row.above))
        yield row.label, *numbers, f"{row.cells[0]}, {row.cells[1]}"
