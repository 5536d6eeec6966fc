"""Objects felt by eight actuated whiskers.

From the recordings of "Vibrissae-inspired vision-based magnetic-actuated whisker"
(doi 10.1038/s41467-025-67672-x). A CSV file holds one object, without a header: a row per touch of
8 whiskers x 16 displacements of their roots, integers in camera pixels, 0 at rest. Rows have no time and no
pose. The files do not say that rows are in the order of the touches, nor which of their values belong to one
whisker; 16 successive ones are taken to.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from robot.recordings.whiskers.number_table import read_rows
from robot.sources.in_memory import InMemorySource
from robot.sources.source_info import SourceInfo
from robot.sources.source_registry import SourceEntry
from tactile.base.errors import InputError
from tactile.base.settings import Settings

WHISKERS, VALUES = 8, 16


class ObjectRecord(NamedTuple):
    """The touches of one object.

    Attributes:
        images: [N, 8, 16] displacements, pixels. digest: sha256 (hex) of the file.
    """

    images: np.ndarray
    digest: str


class ObjectConfig(Settings):
    """The touches of one object as a source."""

    file: Path
    """The CSV file."""


def read_object(path: Path) -> ObjectRecord:
    """The record in a file.

    Raises:
        InputError: as `number_table.read_rows`, or a row is not of 128 whole numbers.
    """
    table, digest = read_rows(path, WHISKERS * VALUES)
    if (broken := np.argwhere(table != np.round(table))).size:
        row, column = broken[0].tolist()
        found = f"{table[row, column]:g} in column {column + 1}"
        raise InputError(f"{path}:{row + 1}", found, "whole numbers of pixels")
    return ObjectRecord(table.reshape(-1, WHISKERS, VALUES), digest)


def open_object(config: ObjectConfig) -> InMemorySource:
    """The touches as a source: a signed view [1, 8, 16] a second of a robot at rest.

    Raises:
        InputError: see `read_object`.
    """
    record = read_object(config.file)
    count = len(record.images)
    return InMemorySource(
        name=config.file.stem,
        digest=record.digest,
        time=np.arange(count, dtype=float),
        motion=np.zeros((count, 4)),
        moved=np.zeros(count, bool),
        views=record.images[:, None],
        seen=np.ones(count, bool),
        label=np.full(count, -1, np.int32),
        info=SourceInfo(signed_views=True),
        alive=np.ones(WHISKERS, bool),
    )


ENTRY = SourceEntry(ObjectConfig, lambda config, warn: open_object(config))
