"""Samples as ROS 2 messages in little-endian CDR, which any ROS 2 or MCAP tool can read.

A message has four bytes (00 01 00 00) and the fields of its schema (`robot.recordings.schemas`) back to
back; an unbounded array is preceded by its length (uint32). float64 values keep every bit.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.schemas import CYCLE, OBSERVATION, REPORT, WHISK
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk

CDR = b"\x00\x01\x00\x00"
MAX_NUMBERS = 100_000_000  # in one message; a larger number is a damaged length
FELT = ("touched", "highest", "reach")
"""Values of each whisker in the field `felt` of a Whisk message."""
FLAGS = {OBSERVATION: ("contact", "dead"), WHISK: ("alive", "contact", "held"), REPORT: ("alive", "contact")}
"""Meaning of the bits of `flags`, from the lowest."""


class Malformed(ValueError):
    """A message that does not fit its schema."""


class Layout(NamedTuple):
    """Byte layout of a message.

    Attributes:
        dtype: the message as a packed record. blank: a message with lengths and shapes filled in.
        fixed: (start, stop, bytes) of all parts that are equal in every message of this layout.
        fields: names of the variable fields.
    """

    dtype: np.dtype
    blank: np.ndarray
    fixed: tuple[tuple[int, int, bytes], ...]
    fields: tuple[str, ...]


def encode(sample: Sample, view_shape: tuple[int, int, int], whiskers: int) -> tuple[str, bytes]:
    """A sample's reading as (schema, message).

    Raises:
        InputError: a field has another shape, or values that its type cannot hold exactly.
    """
    reading = sample.reading
    values: dict[str, Any] = {**reading._asdict(), **reading.odometry._asdict()}
    if isinstance(reading, Cycle):
        name, layout = CYCLE, cycle_layout(len(np.atleast_1d(reading.time)), whiskers)
        values["sample_time"] = reading.time
    elif isinstance(reading, Whisk):
        name, layout = WHISK, whisk_layout(whiskers)
        numbers = np.dtype(("<f8", (whiskers,)))
        values["felt"] = np.stack([_exactly(field, values[field], numbers) for field in FELT], axis=1)
    elif isinstance(reading, Report):
        name, layout = REPORT, report_layout(len(np.atleast_1d(reading.time)), whiskers)
        values["sample_time"] = reading.time
    else:
        name, layout = OBSERVATION, observation_layout(view_shape, whiskers)
        values["dead"] = ~_exactly("alive", reading.alive, np.dtype(("?", (whiskers,)))).astype(bool)
    if name in FLAGS:
        values["flags"] = _packed(values, FLAGS[name], whiskers)
    values["time"] = sample.time
    record = layout.blank.copy()
    for field in layout.fields:
        record[field] = _exactly(field, values[field], layout.dtype[field])
    return name, record.tobytes()


def decode(name: str, message: bytes, view_shape: tuple[int, int, int], whiskers: int) -> tuple[float, Any]:
    """(time, reading) of a message; the inverse of `encode`.

    Raises:
        Malformed: the message does not fit this schema, view shape and number of whiskers.
    """
    if name == CYCLE:
        samples = int.from_bytes(message[44:48], "little")
        if samples * (1 + 3 * whiskers) > MAX_NUMBERS:
            raise Malformed(f"a cycle of {samples} samples")
        layout = cycle_layout(samples, whiskers)
    elif name == WHISK:
        layout = whisk_layout(whiskers)
    elif name == REPORT:
        samples = int.from_bytes(message[56:60], "little")
        if samples * (1 + 2 * whiskers) > MAX_NUMBERS:
            raise Malformed(f"a report of {samples} samples")
        layout = report_layout(samples, whiskers)
    else:
        layout = observation_layout(view_shape, whiskers)
    if len(message) != layout.dtype.itemsize:
        raise Malformed(f"a message of {len(message)} bytes where {layout.dtype.itemsize} were expected")
    if any(message[start:stop] != content for start, stop, content in layout.fixed):
        raise Malformed("a message with another shape than the recording's")
    record = np.frombuffer(message, layout.dtype)[0]
    odometry = Odometry(record["dx"], record["dy"], record["dtheta"], record["dt"])
    if name == CYCLE:
        time, angle, deflection = (record[field].copy() for field in ("sample_time", "angle", "deflection"))
        return float(record["time"]), Cycle(time, angle, deflection, odometry)
    flags = _unpacked(record["flags"], FLAGS[name])
    if name == WHISK:
        felt = {field: record["felt"][:, k].copy() for k, field in enumerate(FELT)}
        return float(record["time"]), Whisk(odometry=odometry, **flags, **felt)
    if name == REPORT:
        time, strain = record["sample_time"].copy(), record["strain"].copy()
        moved, ended = int(record["motion"]), int(record["moment"])
        return float(record["time"]), Report(odometry, moved, ended, **flags, time=time, strain=strain)
    return float(record["time"]), Observation(
        odometry=odometry,
        motion=record["motion"],
        view=record["view"].copy(),  # copies are aligned and writable
        view_seen=record["view_seen"],
        label=record["label"],
        contact=flags["contact"],
        alive=~flags["dead"],
        point=record["point"].copy(),
        wall=record["wall"],
        wall_point=record["wall_point"].copy(),
        wall_sd=record["wall_sd"],
    )


def encode_truth(time: float, truth: np.ndarray) -> bytes:
    """A truth [3] as a message."""
    return CDR + np.array([time, *_exactly("truth", truth, np.dtype(("<f8", (3,))))], "<f8").tobytes()


def decode_truth(message: bytes) -> tuple[float, np.ndarray]:
    """(time, truth [3]); raises `Malformed`."""
    if len(message) != 36 or not message.startswith(CDR):
        raise Malformed("malformed Truth message")
    time, *pose = np.frombuffer(message, "<f8", offset=4)
    return float(time), np.array(pose)


@lru_cache(maxsize=16)
def observation_layout(view_shape: tuple[int, int, int], whiskers: int) -> Layout:
    """The packed form of the Observation schema for these shapes."""
    pixels = int(np.prod(view_shape))
    return _layout(
        [
            *_ODOMETRY,
            ("wall_point", "<f8", (2,)),
            ("wall_sd", "<f8"),
            ("motion", "<i4"),
            ("label", "<i4"),
            ("view_shape", "<u4", (3,)),
            ("view_length", "<u4"),
            ("view", "<f8", view_shape),
            ("whiskers", "<u4"),
            ("point_length", "<u4"),
            ("point", "<f8", (whiskers, 2)),
            ("flags_length", "<u4"),
            ("flags", "u1", (whiskers,)),
            ("view_seen", "?"),
            ("wall", "?"),
        ],
        view_shape=view_shape,
        view_length=pixels,
        whiskers=whiskers,
        point_length=2 * whiskers,
        flags_length=whiskers,
    )


@lru_cache(maxsize=16)
def whisk_layout(whiskers: int) -> Layout:
    """The packed form of the Whisk schema for this number of whiskers."""
    return _layout(
        [
            *_ODOMETRY,
            ("whiskers", "<u4"),
            ("felt_length", "<u4"),
            ("felt", "<f8", (whiskers, len(FELT))),
            ("flags_length", "<u4"),
            ("flags", "u1", (whiskers,)),
        ],
        whiskers=whiskers,
        felt_length=len(FELT) * whiskers,
        flags_length=whiskers,
    )


@lru_cache(maxsize=256)
def report_layout(samples: int, whiskers: int) -> Layout:
    """The packed form of the Report schema for these shapes."""
    return _layout(
        [
            *_ODOMETRY,
            ("motion", "<i4"),
            ("moment", "<i4"),
            ("whiskers", "<u4"),
            ("sample_time_length", "<u4"),
            ("sample_time", "<f8", (samples,)),
            ("axes", "<u4"),
            ("strain_length", "<u4"),
            ("strain", "<f8", (samples, whiskers, 2)),
            ("flags_length", "<u4"),
            ("flags", "u1", (whiskers,)),
        ],
        whiskers=whiskers,
        sample_time_length=samples,
        axes=2,
        strain_length=2 * samples * whiskers,
        flags_length=whiskers,
    )


@lru_cache(maxsize=64)
def cycle_layout(samples: int, whiskers: int) -> Layout:
    """The packed form of the Cycle schema for these shapes."""
    return _layout(
        [
            *_ODOMETRY,
            ("samples", "<u4"),
            ("sample_time_length", "<u4"),
            ("sample_time", "<f8", (samples,)),
            ("whiskers", "<u4"),
            ("angle_length", "<u4"),
            ("angle", "<f8", (samples, whiskers)),
            ("axes", "<u4"),
            ("deflection_length", "<u4"),
            ("deflection", "<f8", (samples, whiskers, 2)),
        ],
        samples=samples,
        sample_time_length=samples,
        whiskers=whiskers,
        angle_length=samples * whiskers,
        axes=2,
        deflection_length=2 * samples * whiskers,
    )


_ODOMETRY = [("cdr", "u1", (4,)), *((name, "<f8") for name in ("time", "dx", "dy", "dtheta", "dt"))]


def _layout(fields: list[Any], **fixed: Any) -> Layout:
    dtype = np.dtype(fields)
    blank = np.zeros((), dtype)
    for name, value in {"cdr": list(CDR), **fixed}.items():
        blank[name] = value
    content = blank.tobytes()
    places = [(dtype.fields[name][1], dtype[name].itemsize) for name in ("cdr", *fixed)]  # type: ignore[index]
    return Layout(
        dtype=dtype,
        blank=blank,
        fixed=tuple((start, start + size, content[start : start + size]) for start, size in places),
        fields=tuple(name for name in dtype.names or () if name != "cdr" and name not in fixed),
    )


def _packed(values: dict[str, Any], names: tuple[str, ...], whiskers: int) -> np.ndarray:
    """[W] uint8, the boolean arrays [W] of these names as bits."""
    flags = np.zeros(whiskers, np.uint8)
    for bit, name in enumerate(names):
        flags |= _exactly(name, values[name], np.dtype(("?", (whiskers,)))).astype(np.uint8) << bit
    return flags


def _unpacked(flags: np.ndarray, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The inverse of `_packed`."""
    if (flags >> len(names)).any():
        raise Malformed(
            f"whisker flags {int(flags.max())} where {2 ** len(names) - 1} is the largest possible"
        )
    return {name: (flags >> bit & 1).astype(bool) for bit, name in enumerate(names)}


def _exactly(name: str, value: Any, dtype: np.dtype) -> np.ndarray:
    """The value with that dtype and shape; `InputError` if it cannot be held exactly."""
    array = np.asarray(value)
    base, shape = dtype.base, dtype.shape
    if array.shape != shape:
        raise InputError(
            name, f"shape {list(array.shape)}", f"{list(shape)}, as the recording was opened for"
        )
    if array.dtype != base:
        kinds = "biuf" if base.kind == "f" else "biu"
        if array.dtype.kind not in kinds or not np.array_equal(array.astype(base), array, equal_nan=True):
            raise InputError(name, f"{array.dtype} values", f"values that {base} holds exactly")
    return array
