"""Published recordings of real whiskers and touch sensors, each as a source of its own (`source.plugin`).

| plug-in | recording | file |
|---|---|---|
| `whisker_reach` | arm reaching through clutter, 14 magnetic whiskers (arXiv 2406.06038) | CSV, counts |
| `whisker_stage` | one such whisker on an XYZ stage (Stanford, Lin et al. 2024) | CSV, counts |
| `whisker_objects` | objects, 8 actuated whiskers (doi 10.1038/s41467-025-67672-x) | CSV, camera pixels |
| `taxel_contacts` | objects, three fingertips of 22 pressures (github.com/mathewzilla/TXZY) | MATLAB |

No file has times of its readings. Each cell of each row of a CSV file must be a number.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import PositiveFloat, PositiveInt
from scipy.io import loadmat

from robot.recordings.csv_file import read_csv
from robot.recordings.sanity_checks import nonfinite_errors
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of, missing_error, raise_errors, read_bytes
from robot.sources.odometry import from_motions
from robot.sources.source import Source, SourceEntry, SourceInfo
from tactile.base.errors import InputError
from tactile.base.settings import Settings
from tactile.calibration import DirtyRecordConfig, calibrate_free
from tactile.contact_stream import ContactStreamConfig, Touch, find_contacts, start_stream


def read_columns(path: Path, columns: Sequence[str], header: bool = True) -> tuple[np.ndarray, str]:
    """The numbers [N, C] of a file of exactly these columns, and sha256 (hex) of the file.

    Args:
        header: whether the first line names the columns.

    Raises:
        InputError: the file is missing, empty or cut, or has other columns or cells that are not finite
            numbers.
    """
    file = read_csv(path, names=() if header else columns)
    raise_errors(file.absences([(name, "") for name in columns])[:1])
    if file.full != tuple(columns):
        expected = f"these {len(columns)}: {', '.join(columns)}"
        raise InputError(str(path), f"{len(file.full)} columns", expected)
    if not file.content.endswith(b"\n"):
        raise InputError(str(path), "the last line is cut", cure="copy the file again")
    if file.dates or len(file.lines) != file.content.strip().count(b"\n") + (not header):
        raise InputError(str(path), "lines without numbers", f"{len(columns)} numbers in each line")
    raise_errors(file.judge(columns)[1] or nonfinite_errors(file.values, "a number", file.place))
    return file.values, digest_of([file.content])


def _source(
    name: str,
    digest: str,
    time: np.ndarray,
    views: np.ndarray,
    *,
    alive: np.ndarray,
    motion: np.ndarray | None = None,
    truth: np.ndarray | None = None,
) -> InMemorySource:
    """A source with a view at each time; without motion of a robot at rest, whose views are signed."""
    count, still = len(time), motion is None
    return InMemorySource(
        name=name,
        digest=digest,
        time=time,
        motion=np.zeros((count, 4)) if motion is None else motion,
        moved=np.full(count, not still),
        views=views,
        seen=np.ones(count, bool),
        label=np.full(count, -1, np.int32),
        truth=truth,
        info=SourceInfo(signed_views=still),
        alive=alive,
    )


WHISKERS = (*(f"left{k}" for k in range(8)), *(f"right{k}" for k in range(6)))
"""Names of the whiskers of the reach, in the order of the columns."""
COLUMNS: tuple[str, ...] = ("row", "ee_x_m", "ee_y_m", "ee_z_m", "q0", "q1", "q2", "q3")
COLUMNS += tuple(f"{whisker}_{axis}" for whisker in WHISKERS for axis in "xyz")


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
        InputError: as `read_columns`, or rows are missing.
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
    """
    record = read_reach(config.file)
    touch, count = find_touches(config, record.signal), len(record.signal)
    motion = np.zeros((count, 4))
    motion[1:, :2] = np.diff(record.position[:, :2], axis=0)
    motion[1:, 3] = 1 / config.rate
    return _source(
        config.file.stem,
        record.digest,
        np.arange(count) / config.rate,
        (touch == Touch.CONTACT).astype(float)[:, None, :, None],
        motion=motion,
        truth=np.concatenate([record.position[:, :2], np.zeros((count, 1))], axis=1),
        alive=touch[-1] != Touch.BENT,
    )


REACH = SourceEntry(ReachConfig, lambda config, warn: open_reach(config))


class StageConfig(Settings):
    """A whisker on a stage as a source: one view of 1 x 1 x 3, the sizes of the three signals."""

    file: Path
    """CSV file of a calibration or a sweep."""
    rate_hz: PositiveFloat = 1.0
    """Rows per second; the files have no time."""


def read_stage(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Position [N, 3] of the stage, m, and signal [N, 3], counts, of N rows; sha256 (hex) of the file."""
    table, digest = read_columns(path, ("", "px", "py", "pz", "sx", "sy", "sz"))  # the index has no name
    return table[:, 1:4] * 1e-3, table[:, 4:], digest


def read_stage_calibration(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reads a calibration whose rays start at the whisker's base, as its first row does.

    The rows at the base give the signal of a free whisker; between them it drifts linearly.

    Returns:
        position: [N, 3] of the contacts, m. signal: [N, 3] above that at the base, counts. base: [3], m.

    Raises:
        InputError: as `read_stage`, or a single row at the base.
    """
    position, signal, _ = read_stage(path)
    base = position[0]
    free = np.linalg.norm(position - base, axis=1) < 1e-6  # m
    if free.sum() < 2 or free.all():
        expected = "a calibration that returns to the position of its first row, the whisker's base"
        raise InputError(str(path), f"{free.sum()} of {len(free)} rows at the first position", expected)
    index = np.arange(len(free))
    baseline = [np.interp(index, index[free], channel[free]) for channel in signal.T]
    above = signal - np.stack(baseline, axis=1)
    return position[~free], above[~free], base


def _open_stage(config: StageConfig) -> Source:
    """The source of a file; its motion and its true positions are the stage's x and y."""
    position, signal, digest = read_stage(config.file)
    count = len(signal)
    time = np.arange(count) / config.rate_hz
    size = np.abs(signal - signal[0])
    x, y = position[:, :2].T
    steps = np.diff(position, axis=0, prepend=position[:1])
    return _source(
        config.file.stem,
        digest,
        time,
        (size / max(size.max(), 1e-300)).reshape(count, 1, 1, 3),
        motion=from_motions(time, steps[:, 0], steps[:, 1], np.zeros(count)),
        truth=np.stack([x, y, np.zeros(count)], axis=1),
        alive=np.ones(1, bool),
    )


STAGE = SourceEntry(StageConfig, lambda config, warn: _open_stage(config))


OBJECTS_WHISKERS = 8
"""Whiskers that feel the objects; each gives 16 displacements of its root."""


class ObjectConfig(Settings):
    """The touches of one object as a source."""

    file: Path
    """The CSV file."""


def read_object(path: Path) -> tuple[np.ndarray, str]:
    """The touches [N, 8, 16] of one object, displacements in pixels, and the sha256 (hex) of their file; it
    has no header and a row per touch.

    The file does not say that rows are in the order of the touches, nor which values belong to one whisker;
    16 successive ones are taken to.

    Raises:
        InputError: as `read_columns`, or a row is not of 128 whole numbers.
    """
    columns = [f"column {number}" for number in range(1, OBJECTS_WHISKERS * 16 + 1)]
    table, digest = read_columns(path, columns, header=False)
    if (broken := np.argwhere(table != np.round(table))).size:
        row, column = broken[0].tolist()
        found = f"{table[row, column]:g} in column {column + 1}"
        raise InputError(f"{path}:{row + 1}", found, "whole numbers of pixels")
    return table.reshape(-1, OBJECTS_WHISKERS, 16), digest


def open_object(config: ObjectConfig) -> InMemorySource:
    """The touches as a source: a signed view [1, 8, 16] a second of a robot at rest."""
    images, digest = read_object(config.file)
    time, alive = np.arange(len(images), dtype=float), np.ones(OBJECTS_WHISKERS, bool)
    return _source(config.file.stem, digest, time, images[:, None], alive=alive)


OBJECTS = SourceEntry(ObjectConfig, lambda config, warn: open_object(config))


_FINGERS, _TAXELS = 3, 22


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
    """All contacts of a file with one cell array: objects x (position of the hand, fingertips 1 to 3) x
    trials, or the same cut into single contacts (x contacts). A cell of a fingertip: samples x 22 pressures.

    Raises:
        InputError: the file is missing, empty, cut or not of MATLAB, lacks the cell array, or a cell is
            empty, has other columns or values that are not finite.
    """
    content = BytesIO(read_bytes(path))
    try:
        arrays = loadmat(content)
    except Exception as error:  # SciPy raises many kinds for a damaged file
        raise InputError(str(path), f"cannot be read ({error})", "a MATLAB file", "copy it again") from None
    known = ("TXZY_dataI", "TXZY_data")  # cut into contacts, and whole
    name = next((name for name in known if name in arrays), None)
    if name is None:
        there = [name for name in arrays if not name.startswith("__")]
        raise missing_error(str(path), "array", known[0], there)
    cells = arrays[name]
    if cells.dtype != object or cells.ndim not in (3, 4) or cells.shape[1] != 1 + _FINGERS or not cells.size:
        found = f"{name} of {cells.dtype}, {' x '.join(map(str, cells.shape))}"
        expected = f"a cell array objects x {1 + _FINGERS} x trials (x contacts)"
        raise InputError(str(path), found, expected)
    cells = cells.reshape(*cells.shape[:3], -1)
    contacts = []
    for thing, trial, contact in np.ndindex(cells.shape[0], *cells.shape[2:]):
        number = thing + 1, trial + 1, contact + 1
        where = "{}, {}, object {}, trial {}, contact {}".format(path, name, *number)
        contacts.append(TaxelContact(*number, _pressure(where, cells[thing, 1:, trial, contact])))
    return contacts


def _pressure(where: str, fingers: np.ndarray) -> np.ndarray:
    """[T, 3, 22] of the cells of three fingertips."""
    shapes = {finger.shape for finger in fingers}
    samples, *columns = fingers[0].shape
    if len(shapes) > 1 or columns != [_TAXELS] or not samples:
        found = f"fingertips of {', '.join(' x '.join(map(str, finger.shape)) for finger in fingers)}"
        raise InputError(where, found, f"the same number of samples x {_TAXELS} for each")
    pressure = np.stack(list(fingers), axis=1).astype(float)
    if not np.isfinite(pressure).all():
        raise InputError(where, f"{np.sum(~np.isfinite(pressure))} values that are not finite", "pressures")
    return pressure


def open_contacts(config: TaxelConfig) -> InMemorySource:
    """The contacts with one object as a source: a view [3, 22, 1] a second of a hand at rest.

    Raises:
        InputError: see `read_contacts`; there is no such object.
    """
    contacts = read_contacts(config.file)
    chosen = [contact.pressure for contact in contacts if contact.object == config.object]
    if not chosen:
        last = max(contact.object for contact in contacts)
        raise InputError("source.settings.object", str(config.object), f"1 to {last}")
    views = np.concatenate(chosen)[..., None]
    digest = digest_of([config.file, str(config.object).encode()])
    time, alive = np.arange(len(views), dtype=float), np.ones(_FINGERS * _TAXELS, bool)
    return _source(f"{config.file.stem}, object {config.object}", digest, time, views, alive=alive)


CONTACTS = SourceEntry(TaxelConfig, lambda config, warn: open_contacts(config))
