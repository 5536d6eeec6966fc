"""Objects touched by the three fingertips of a Barrett hand, 22 pressure taxels each.

From the recordings of the TXZY robot (github.com/mathewzilla/TXZY, Sheffield). A MATLAB file holds one cell
array: objects x (position of the hand, fingertips 1 to 3) x trials, or the same cut into single contacts:
x contacts. A cell of a fingertip is an array of samples x 22 pressures, counts. Samples have no time.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import PositiveInt
from scipy.io import loadmat

from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of, missing_error, read_bytes
from robot.sources.source_info import SourceInfo
from robot.sources.source_registry import SourceEntry
from tactile.base.errors import InputError
from tactile.base.settings import Settings

FINGERS, TAXELS = 3, 22
ARRAYS = ("TXZY_dataI", "TXZY_data")
EXPECTED = f"a cell array objects x {1 + FINGERS} x trials (x contacts)"


class TaxelContact(NamedTuple):
    """The samples of one contact, or of a whole trial where contacts are not cut out.

    Attributes:
        object, trial, contact: numbers from 1. pressure: [T, 3, 22] counts.
    """

    object: int
    trial: int
    contact: int
    pressure: np.ndarray


class TaxelConfig(Settings):
    """The contacts with one object as a source."""

    file: Path
    """The MATLAB file."""
    object: PositiveInt = 1
    """Number of the object."""


def read_contacts(path: Path) -> list[TaxelContact]:
    """All contacts of a file.

    Raises:
        InputError: the file is missing, empty, cut or not of MATLAB, lacks the cell array, or a cell is
            empty, has other columns or values that are not finite.
    """
    return _contacts(path, read_bytes(path))


def _contacts(path: Path, content: bytes) -> list[TaxelContact]:
    try:
        arrays = loadmat(BytesIO(content))
    except Exception as error:  # SciPy raises many kinds for a damaged file
        raise InputError(str(path), f"cannot be read ({error})", "a MATLAB file", "copy it again") from None
    name = next((name for name in ARRAYS if name in arrays), None)
    if name is None:
        there = [name for name in arrays if not name.startswith("__")]
        raise missing_error(str(path), "array", ARRAYS[0], there)
    cells = arrays[name]
    if cells.dtype != object or cells.ndim not in (3, 4) or cells.shape[1] != 1 + FINGERS or not cells.size:
        found = f"{name} of {cells.dtype}, {' x '.join(map(str, cells.shape))}"
        raise InputError(str(path), found, EXPECTED)
    cells = cells.reshape(*cells.shape[:3], -1)
    numbers = np.ndindex(cells.shape[0], *cells.shape[2:])
    return [
        TaxelContact(o + 1, t + 1, c + 1, _pressure(f"{path}, {name}", cells[o, 1:, t, c], (o, t, c)))
        for o, t, c in numbers
    ]


def _pressure(where: str, fingers: np.ndarray, number: tuple[int, int, int]) -> np.ndarray:
    """[T, 3, 22] of the cells of three fingertips."""
    thing, trial, contact = (k + 1 for k in number)
    where = f"{where}, object {thing}, trial {trial}, contact {contact}"
    shapes = {finger.shape for finger in fingers}
    samples, *columns = fingers[0].shape
    if len(shapes) > 1 or columns != [TAXELS] or not samples:
        found = f"fingertips of {', '.join(' x '.join(map(str, finger.shape)) for finger in fingers)}"
        raise InputError(where, found, f"the same number of samples x {TAXELS} for each")
    pressure = np.stack(list(fingers), axis=1).astype(float)
    if not np.isfinite(pressure).all():
        raise InputError(where, f"{np.sum(~np.isfinite(pressure))} values that are not finite", "pressures")
    return pressure


def open_contacts(config: TaxelConfig) -> InMemorySource:
    """The contacts with one object as a source: a view [3, 22, 1] a second of a hand at rest.

    Raises:
        InputError: see `read_contacts`; there is no such object.
    """
    content = read_bytes(config.file)
    contacts = _contacts(config.file, content)
    chosen = [contact.pressure for contact in contacts if contact.object == config.object]
    if not chosen:
        last = max(contact.object for contact in contacts)
        raise InputError("source.settings.object", str(config.object), f"1 to {last}")
    views = np.concatenate(chosen)[..., None]
    count = len(views)
    return InMemorySource(
        name=f"{config.file.stem}, object {config.object}",
        digest=digest_of([content, str(config.object).encode()]),
        time=np.arange(count, dtype=float),
        motion=np.zeros((count, 4)),
        moved=np.zeros(count, bool),
        views=views,
        seen=np.ones(count, bool),
        label=np.full(count, -1, np.int32),
        info=SourceInfo(signed_views=True),
        alive=np.ones(FINGERS * TAXELS, bool),
    )


ENTRY = SourceEntry(TaxelConfig, lambda config, warn: open_contacts(config))
