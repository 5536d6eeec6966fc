"""An arm that reaches through clutter with two arrays of magnetic whiskers.

From the recordings of "Navigation and 3D Surface Reconstruction from Passive Whisker Sensing" (arXiv
2406.06038). The CSV file has a row per reading: `row`, the pose of the end effector (position in m,
quaternion in the order in which it was stored), and x, y, z (counts) of 8 whiskers on the left and 6 on the
right. It has no time: the authors' tracker assumes 200 readings per second.

CSV files of numbers only, each cell of each row filled.

Recordings of one magnetic whisker on an XYZ stage (Stanford, Lin et al. 2024, arXiv 2406.06038).

A CSV file has the columns index, px, py, pz (stage, mm), sx, sy, sz (counts of a Hall sensor), and no time.
In a calibration the stage brings a contact to known points of the whisker: rays that start at its base. In a
sweep an object stands on the stage: its place changes with the stage's position, the whisker stands still.

Objects felt by eight actuated whiskers.

From the recordings of "Vibrissae-inspired vision-based magnetic-actuated whisker"
(doi 10.1038/s41467-025-67672-x). A CSV file holds one object, without a header: a row per touch of
8 whiskers x 16 displacements of their roots, integers in camera pixels, 0 at rest. Rows have no time and no
pose. The files do not say that rows are in the order of the touches, nor which of their values belong to one
whisker; 16 successive ones are taken to.

Objects touched by the three fingertips of a Barrett hand, 22 pressure taxels each.

From the recordings of the TXZY robot (github.com/mathewzilla/TXZY, Sheffield). A MATLAB file holds one cell
array: objects x (position of the hand, fingertips 1 to 3) x trials, or the same cut into single contacts:
x contacts. A cell of a fingertip is an array of samples x 22 pressures, counts. Samples have no time.
"""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import PositiveFloat, PositiveInt
from scipy.io import loadmat

from robot.recordings.sanity_checks import nonfinite_errors
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of, missing_error, raise_errors, read_bytes
from robot.sources.odometry import from_motions
from robot.sources.source import Source, SourceEntry, SourceInfo
from tactile.base.errors import InputError
from tactile.base.samples import longest_run
from tactile.base.settings import Settings
from tactile.calibration import DirtyRecordConfig, calibrate_free
from tactile.contact_stream import ContactStreamConfig, Touch, find_contacts, start_stream


def read_columns(path: Path, columns: Sequence[str]) -> tuple[np.ndarray, str]:
    """The numbers [N, C] below a header of exactly these columns, and sha256 (hex) of the file.

    Raises:
        InputError: the file is missing, empty or cut, or has other columns or cells that are not finite
            numbers.
    """
    content = read_bytes(path)
    header, _, rows = _text(path, content).partition("\n")
    names = header.strip().split(",")
    if lacking := [name for name in columns if name not in names]:
        raise missing_error(str(path), "column", lacking[0], names)
    if names != list(columns):
        raise InputError(str(path), f"{len(names)} columns", f"these {len(columns)}: {', '.join(columns)}")
    return _parse(path, rows, columns, first_line=2), digest_of([content])


def read_rows(path: Path, count: int) -> tuple[np.ndarray, str]:
    """The numbers [N, count] of a file without a header, and sha256 (hex) of the file.

    Raises:
        InputError: as `read_columns`.
    """
    content = read_bytes(path)
    columns = [f"column {number}" for number in range(1, count + 1)]
    return _parse(path, _text(path, content), columns, first_line=1), digest_of([content])


def _text(path: Path, content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError(str(path), "bytes that are not UTF-8", "a CSV file in UTF-8") from None


def _parse(path: Path, rows: str, columns: Sequence[str], first_line: int) -> np.ndarray:
    expected = f"{len(columns)} numbers in each line"
    if not rows.strip():
        raise InputError(str(path), "no rows", expected, "was it copied completely?")
    if not rows.endswith("\n"):
        raise InputError(str(path), "the last line is cut", cure="copy the file again")
    try:
        table = np.loadtxt(StringIO(rows), delimiter=",", comments=None, ndmin=2)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape[1] != len(columns):
        raise _first_fault(path, rows, columns, first_line)
    raise_errors(
        [
            error
            for name, column in zip(columns, table.T, strict=True)
            for error in nonfinite_errors(column, name, lambda row: f"{path}:{row + first_line}")
        ]
    )
    return table


def _first_fault(path: Path, rows: str, columns: Sequence[str], first_line: int) -> InputError:
    """The first line that does not hold the numbers, and what it holds."""
    for number, line in enumerate(rows.splitlines(), start=first_line):
        cells, where = line.split(","), f"{path}:{number}"
        if line.strip() and len(cells) != len(columns):
            return InputError(where, f"{len(cells)} cells", f"{len(columns)} numbers")
        for column, cell in zip(columns, cells, strict=False):
            try:
                float(cell or "empty")
            except ValueError:
                return InputError(where, f"{cell!r} in {column}", "a number")
    return InputError(str(path), "lines of different lengths", f"{len(columns)} numbers in each line")


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


REACH = SourceEntry(ReachConfig, lambda config, warn: open_reach(config))


STAGE_COLUMNS = ("", "px", "py", "pz", "sx", "sy", "sz")
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
    table, digest = read_columns(path, STAGE_COLUMNS)
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


STAGE = SourceEntry(StageConfig, lambda config, warn: open_stage(config))


OBJECTS_WHISKERS, VALUES = 8, 16


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
    table, digest = read_rows(path, OBJECTS_WHISKERS * VALUES)
    if (broken := np.argwhere(table != np.round(table))).size:
        row, column = broken[0].tolist()
        found = f"{table[row, column]:g} in column {column + 1}"
        raise InputError(f"{path}:{row + 1}", found, "whole numbers of pixels")
    return ObjectRecord(table.reshape(-1, OBJECTS_WHISKERS, VALUES), digest)


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
        alive=np.ones(OBJECTS_WHISKERS, bool),
    )


OBJECTS = SourceEntry(ObjectConfig, lambda config, warn: open_object(config))


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


CONTACTS = SourceEntry(TaxelConfig, lambda config, warn: open_contacts(config))
