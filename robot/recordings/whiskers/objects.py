"""Objects felt by eight actuated whiskers.

From the recordings of "Vibrissae-inspired vision-based magnetic-actuated whisker"
(doi 10.1038/s41467-025-67672-x). A CSV file holds one object, without a header: a row per touch of
8 whiskers x 16 displacements of their roots, integers in camera pixels, 0 at rest. Rows have no time and no
pose. The files do not say that rows are in the order of the touches, nor which of their values belong to one
whisker; 16 successive ones are taken to.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of, read_bytes
from robot.sources.registry import SourceEntry
from robot.sources.source_info import SourceInfo
from tactile.base.config import Settings
from tactile.base.errors import InputError

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
        InputError: the file is missing, empty or cut, or a row is not 128 whole numbers.
    """
    content, size = read_bytes(path), WHISKERS * VALUES
    expected = f"{size} whole numbers in each row, {WHISKERS} whiskers x {VALUES} displacements"
    if not content.endswith(b"\n"):
        raise InputError(str(path), "the last line is cut", cure="copy the file again")
    if not content.strip():
        raise InputError(str(path), "no rows", expected, "was it copied completely?")
    try:
        table = np.loadtxt(BytesIO(content), delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(str(path), str(error), expected) from None
    if table.shape[1] != size:
        raise InputError(str(path), f"{table.shape[1]} columns", expected)
    rows, columns = np.nonzero(table != np.round(table))  # NaN differs from itself; infinity is found below
    if not len(rows):
        rows, columns = np.nonzero(np.isinf(table))
    if len(rows):
        found = f"{table[rows[0], columns[0]]:g} in column {columns[0] + 1}"
        raise InputError(f"{path}:{rows[0] + 1}", found, expected)
    return ObjectRecord(table.reshape(-1, WHISKERS, VALUES), digest_of([content]))


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
