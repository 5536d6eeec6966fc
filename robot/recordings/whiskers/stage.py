"""Recordings of one magnetic whisker on an XYZ stage (Stanford, Lin et al. 2024, arXiv 2406.06038).

A CSV file has the columns index, px, py, pz (stage, mm), sx, sy, sz (counts of a Hall sensor), and no time.
In a calibration the stage brings a contact to known points of the whisker: rays that start at its base. In a
sweep an object stands on the stage: its place changes with the stage's position, the whisker stands still.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import PositiveFloat

from robot.recordings.whiskers.number_table import read_columns
from robot.sources.in_memory import InMemorySource
from robot.sources.odometry import from_motions
from robot.sources.source import Source
from robot.sources.source_registry import SourceEntry
from tactile.base.errors import InputError
from tactile.base.samples import longest_run
from tactile.base.settings import Settings

COLUMNS = ("", "px", "py", "pz", "sx", "sy", "sz")
"""The index has no name."""
MILLIMETRE = 1e-3
"""m."""
UNEVEN = 3.0
"""A step this many times as long or as short as the median is not part of a sweep."""
SAME_PLACE = 1e-6
"""Stage positions closer than this are the same, m."""


class StageRecording(NamedTuple):
    """N rows of a file: position [N, 3] of the stage, m; signal [N, 3], counts; sha256 (hex) of the file."""

    position: np.ndarray
    signal: np.ndarray
    digest: str


class StageCalibration(NamedTuple):
    """Contacts at known points: position [N, 3] and base [3] in stage coordinates, m; signal [N, 3] above
    the signal at the base, counts."""

    position: np.ndarray
    base: np.ndarray
    signal: np.ndarray


class StageConfig(Settings):
    """A whisker on a stage as a source: one view of 1 x 1 x 3, the sizes of the three signals."""

    file: Path
    """CSV file of a calibration or a sweep."""
    rate_hz: PositiveFloat = 1.0
    """Rows per second; the files have no time."""


def read_stage(path: Path) -> StageRecording:
    """Reads a file.

    Raises:
        InputError: as `number_table.read_columns`.
    """
    table, digest = read_columns(path, COLUMNS)
    return StageRecording(table[:, 1:4] * MILLIMETRE, table[:, 4:], digest)


def cut_sweep(recording: StageRecording) -> StageRecording:
    """The longest stretch of even steps: without the way to the start, and the row of zeros there."""
    step = np.linalg.norm(np.diff(recording.position, axis=0), axis=1)
    usual = np.median(step)
    even = (step <= UNEVEN * usual) & (step >= usual / UNEVEN)
    run = longest_run(even)
    rows = slice(run.start, run.stop + 1) if even.any() else slice(None)
    return recording._replace(position=recording.position[rows], signal=recording.signal[rows])


def read_stage_calibration(path: Path) -> StageCalibration:
    """Reads a calibration whose rays start at the whisker's base, as its first row does.

    The rows at the base give the signal of a free whisker; between them it drifts linearly.

    Raises:
        InputError: as `read_stage`, or a single row at the base.
    """
    recording = read_stage(path)
    base = recording.position[0]
    free = np.linalg.norm(recording.position - base, axis=1) < SAME_PLACE
    if free.sum() < 2 or free.all():
        expected = "a calibration that returns to the position of its first row, the whisker's base"
        raise InputError(str(path), f"{free.sum()} of {len(free)} rows at the first position", expected)
    index = np.arange(len(free))
    baseline = [np.interp(index, index[free], channel[free]) for channel in recording.signal.T]
    above = recording.signal - np.stack(baseline, axis=1)
    return StageCalibration(recording.position[~free], base, above[~free])


def open_stage(config: StageConfig) -> Source:
    """The source of a file; its motion and its true positions are the stage's x and y.

    Raises:
        InputError: as `read_stage`.
    """
    recording = read_stage(config.file)
    count = len(recording.signal)
    time = np.arange(count) / config.rate_hz
    size = np.abs(recording.signal - recording.signal[0])
    x, y = recording.position[:, :2].T
    steps = np.diff(recording.position, axis=0, prepend=recording.position[:1])
    return InMemorySource(
        name=config.file.stem,
        digest=recording.digest,
        time=time,
        motion=from_motions(time, steps[:, 0], steps[:, 1], np.zeros(count)),
        moved=np.ones(count, bool),
        views=(size / max(size.max(), 1e-300)).reshape(count, 1, 1, 3),
        seen=np.ones(count, bool),
        label=np.full(count, -1, np.int32),
        truth=np.stack([x, y, np.zeros(count)], axis=1),
        alive=np.ones(1, bool),
    )


ENTRY = SourceEntry(StageConfig, lambda config, warn: open_stage(config))
