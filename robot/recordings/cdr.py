"""Samples as ROS 2 messages in little-endian CDR, which any ROS 2 or MCAP tool can read.

A message has four bytes (00 01 00 00) and the fields of its schema (`robot.recordings.schemas`) back to
back; an unbounded array is preceded by its length (uint32). float64 values keep every bit.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.schemas import CYCLE, OBSERVATION, REPORT, SCHEMAS, WHISK
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk

CDR = b"\x00\x01\x00\x00"
MAX_NUMBERS = 100_000_000  # in one message; a larger number is a damaged length
FEATURES = ("touched", "highest", "reach")
"""Values of each whisker in the field `felt` of a Whisk message."""
FLAGS = {OBSERVATION: ("contact", "dead"), WHISK: ("alive", "contact", "held"), REPORT: ("alive", "contact")}
"""Meaning of the bits of `flags`, from the lowest."""
SCHEMA_OF_READING = {Observation: OBSERVATION, Cycle: CYCLE, Whisk: WHISK, Report: REPORT}
SAMPLES_AT = {CYCLE: 44, REPORT: 56}
"""Byte position of the number of samples in a message."""
TYPES = {"float64": "<f8", "int32": "<i4", "uint32": "<u4", "uint8": "u1", "bool": "?"}
"""NumPy types of the types in `SCHEMAS`."""


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
    name, samples = SCHEMA_OF_READING[type(reading)], 0
    values: dict[str, Any] = {**reading._asdict(), **reading.odometry._asdict()}
    if isinstance(reading, Cycle | Report):
        samples, values["sample_time"] = len(np.atleast_1d(reading.time)), reading.time
    elif isinstance(reading, Whisk):
        numbers = np.dtype(("<f8", (whiskers,)))
        columns = [_convert_exactly(field, values[field], numbers) for field in FEATURES]
        values["felt"] = np.stack(columns, axis=1)
    else:
        values["dead"] = ~_convert_exactly("alive", reading.alive, np.dtype(("?", (whiskers,)))).astype(bool)
    layout = message_layout(name, view_shape, whiskers, samples)
    if name in FLAGS:
        values["flags"] = _pack_flags(values, FLAGS[name], whiskers)
    values["time"] = sample.time
    record = layout.blank.copy()
    for field in layout.fields:
        record[field] = _convert_exactly(field, values[field], layout.dtype[field])
    return name, record.tobytes()


def decode(name: str, message: bytes, view_shape: tuple[int, int, int], whiskers: int) -> tuple[float, Any]:
    """(time, reading) of a message; the inverse of `encode`.

    Raises:
        Malformed: the message does not fit this schema, view shape and number of whiskers.
    """
    samples = 0
    if name in SAMPLES_AT:
        samples = int.from_bytes(message[SAMPLES_AT[name] :][:4], "little")
        if samples * (1 + 3 * whiskers) > MAX_NUMBERS:
            raise Malformed(f"a message of {samples} samples")
    layout = message_layout(name, view_shape, whiskers, samples)
    if len(message) != layout.dtype.itemsize:
        raise Malformed(f"a message of {len(message)} bytes where {layout.dtype.itemsize} were expected")
    if any(message[start:stop] != content for start, stop, content in layout.fixed):
        raise Malformed("a message with another shape than the recording's")
    record = np.frombuffer(message, layout.dtype)[0]
    odometry = Odometry(record["dx"], record["dy"], record["dtheta"], record["dt"])
    if name == CYCLE:
        time, angle, deflection = (record[field].copy() for field in ("sample_time", "angle", "deflection"))
        return float(record["time"]), Cycle(time, angle, deflection, odometry)
    flags = _unpack_flags(record["flags"], FLAGS[name])
    if name == WHISK:
        felt = {field: record["felt"][:, k].copy() for k, field in enumerate(FEATURES)}
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
    return CDR + np.array([time, *_convert_exactly("truth", truth, np.dtype(("<f8", (3,))))], "<f8").tobytes()


def decode_truth(message: bytes) -> tuple[float, np.ndarray]:
    """(time, truth [3]); raises `Malformed`."""
    if len(message) != 36 or not message.startswith(CDR):
        raise Malformed("malformed Truth message")
    time, *pose = np.frombuffer(message, "<f8", offset=4)
    return float(time), np.array(pose)


@lru_cache(maxsize=512)
def message_layout(name: str, view_shape: tuple[int, int, int], whiskers: int, samples: int) -> Layout:
    """The packed form of the schema of a reading for these sizes."""
    shapes = {
        "view": view_shape,
        "point": (whiskers, 2),
        "flags": (whiskers,),
        "felt": (whiskers, len(FEATURES)),
        "sample_time": (samples,),
        "angle": (samples, whiskers),
        "deflection": (samples, whiskers, 2),
        "strain": (samples, whiskers, 2),
    }
    fixed: dict[str, Any] = {"cdr": list(CDR)}
    fields: list[tuple[str, str, tuple[int, ...]]] = [("cdr", "u1", (4,))]
    for line in SCHEMAS[name].splitlines():
        kind, field = line.split()[:2]
        base, _, size = kind.partition("[")
        if size == "]":
            fixed[f"{field}_length"] = int(np.prod(shapes[field]))
            fields.append((f"{field}_length", "<u4", ()))
        fields.append((field, TYPES[base], (int(size[:-1]),) if size[:-1] else shapes.get(field, ())))
    sizes = {"view_shape": view_shape, "whiskers": whiskers, "samples": samples, "axes": 2}
    dtype = np.dtype(fields)
    fixed |= {field: size for field, size in sizes.items() if field in (dtype.names or ())}
    blank = np.zeros((), dtype)
    for field, value in fixed.items():
        blank[field] = value
    content = blank.tobytes()
    places = [(dtype.fields[field][1], dtype[field].itemsize) for field in fixed]  # type: ignore[index]
    return Layout(
        dtype=dtype,
        blank=blank,
        fixed=tuple((start, start + size, content[start : start + size]) for start, size in places),
        fields=tuple(field for field, *_ in fields if field not in fixed),
    )


def _pack_flags(values: dict[str, Any], names: tuple[str, ...], whiskers: int) -> np.ndarray:
    """[W] uint8, the boolean arrays [W] of these names as bits."""
    flags = np.zeros(whiskers, np.uint8)
    for bit, name in enumerate(names):
        flags |= _convert_exactly(name, values[name], np.dtype(("?", (whiskers,)))).astype(np.uint8) << bit
    return flags


def _unpack_flags(flags: np.ndarray, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """The inverse of `_pack_flags`."""
    if (flags >> len(names)).any():
        most = 2 ** len(names) - 1
        raise Malformed(f"whisker flags {int(flags.max())} where {most} is the largest possible")
    return {name: (flags >> bit & 1).astype(bool) for bit, name in enumerate(names)}


def _convert_exactly(name: str, value: Any, dtype: np.dtype) -> np.ndarray:
    """The value with that dtype and shape; `InputError` if it cannot be held exactly."""
    array = np.asarray(value)
    base, shape = dtype.base, dtype.shape
    if array.shape != shape:
        expected = f"{list(shape)}, as the recording was opened for"
        raise InputError(name, f"shape {list(array.shape)}", expected)
    if array.dtype != base:
        kinds = "biuf" if base.kind == "f" else "biu"
        if array.dtype.kind not in kinds or not np.array_equal(array.astype(base), array, equal_nan=True):
            raise InputError(name, f"{array.dtype} values", f"values that {base} holds exactly")
    return array
