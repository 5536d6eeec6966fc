"""An arm that reaches through clutter with two arrays of magnetic whiskers.

From the recordings of "Navigation and 3D Surface Reconstruction from Passive Whisker Sensing" (arXiv
2406.06038). The CSV file has a row per reading: `row`, the pose of the end effector (position in m,
quaternion in the order in which it was stored), and x, y, z (counts) of 8 whiskers on the left and 6 on the
right. It has no time: the authors' tracker assumes 200 readings per second.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from robot.recordings.whiskers.number_table import read_columns
from robot.sources.in_memory import InMemorySource
from robot.sources.source_registry import SourceEntry
from tactile.base.errors import InputError
from tactile.base.settings import Settings
from tactile.features.contact_stream import ContactStreamConfig, Touch, find_contacts, start_stream
from tactile.features.free_record import DirtyRecordConfig, calibrate_free

WHISKERS = (*(f"left{k}" for k in range(8)), *(f"right{k}" for k in range(6)))
"""Names of the whiskers, in the order of the columns."""
POSE = ("ee_x_m", "ee_y_m", "ee_z_m", "q0", "q1", "q2", "q3")
COLUMNS = ("row", *POSE, *(f"{whisker}_{axis}" for whisker in WHISKERS for axis in "xyz"))


class ReachRecord(NamedTuple):
    """A reach.

    Attributes:
        position: [T, 3] of the end effector, m. quaternion: [T, 4] as stored. signal: [T, 14, 3] counts.
        digest: sha256 (hex) of the file.
    """

    position: np.ndarray
    quaternion: np.ndarray
    signal: np.ndarray
    digest: str


class ReachConfig(Settings):
    """A reach as a source."""

    file: Path
    """The CSV file."""
    rate: PositiveFloat = 200.0
    """Readings per second; the file has no time."""
    free_rows: PositiveInt = 100
    """First rows, in which the whiskers should touch nothing."""
    free: DirtyRecordConfig = DirtyRecordConfig(on_dirty="repair")
    """What is done about whiskers that touch something there."""
    contact: ContactStreamConfig = ContactStreamConfig()
    """Contact detection."""


def read_reach(path: Path) -> ReachRecord:
    """The record in a file.

    Raises:
        InputError: as `number_table.read_columns`, or rows are missing.
    """
    table, digest = read_columns(path, COLUMNS)
    if (jump := np.flatnonzero(table[:, 0] != np.arange(len(table)))).size:
        first = int(jump[0])
        where = f"{path}, row {first}"
        raise InputError(where, f"row number {table[first, 0]:g}", f"{first}, without gaps")
    signal = table[:, 8:].reshape(len(table), len(WHISKERS), 3)
    return ReachRecord(table[:, 1:4], table[:, 4:8], signal, digest)


def find_touches(config: ReachConfig, signal: np.ndarray) -> np.ndarray:
    """[T, 14] a `Touch` for each reading of each whisker, as live.

    Args:
        signal: [T, 14, 3] counts, of the whole record.

    Raises:
        InputError: a whisker cannot be calibrated on the free rows.
    """
    free = calibrate_free(config.free, signal[: config.free_rows], f"{config.file}, free rows")
    return find_contacts(*start_stream(config.contact, free, config.rate), signal)[1]


def open_reach(config: ReachConfig) -> InMemorySource:
    """A reach as a source.

    Its odometry is the end effector's over the plane, in axes that keep their directions; its view [1, 14, 1]
    is 1 where a whisker touches. Whiskers that are bent at the end are not alive.

    Raises:
        InputError: see `read_reach`; a whisker cannot be calibrated.
    """
    record = read_reach(config.file)
    touch, count = find_touches(config, record.signal), len(record.signal)
    motion = np.zeros((count, 4))
    motion[1:, :2] = np.diff(record.position[:, :2], axis=0)
    motion[1:, 3] = 1 / config.rate
    return InMemorySource(
        name=config.file.stem,
        digest=record.digest,
        time=np.arange(count) / config.rate,
        motion=motion,
        moved=np.ones(count, bool),
        views=(touch == Touch.CONTACT).astype(float)[:, None, :, None],
        seen=np.ones(count, bool),
        label=np.full(count, -1, np.int32),
        truth=np.concatenate([record.position[:, :2], np.zeros((count, 1))], axis=1),
        alive=touch[-1] != Touch.BENT,
    )


ENTRY = SourceEntry(ReachConfig, lambda config, warn: open_reach(config))
