"""Samples and live data as ROS 2 messages in little-endian CDR, which any ROS 2 or MCAP tool can read.

A message has four bytes (00 01 00 00) and the fields of its schema (`SCHEMAS`) back to back; an unbounded
array is preceded by its length (uint32). float64 values keep every bit. Every file stores the schemas, whose
fields are ordered so that CDR needs no padding. A changed text, even in a comment, is another format.

A message is one NumPy record. rosbags writes the same bytes, but knows no shapes, and to check these takes as
much code.

Live data are blocks of frames and of arm states, cuts and events. Frames are stored channel by channel as
differences from frame to frame: small numbers, which compress well.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from robot.drivers.head.decoder import Cut, Frames
from robot.drivers.head.usb_protocol import CHANNELS
from robot.drivers.ur10.shared_state import ARM_STATE
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk

ODOMETRY = """float64 time        # s, on the recording's own clock
float64 dx          # motion since the sample before, in the body frame before it: forward, m
float64 dy          # left, m
float64 dtheta      # counter-clockwise, rad
float64 dt          # the motion's duration, s
"""
SCHEMAS = {
    "ratslam_msgs/msg/Observation": ODOMETRY
    + """float64[2] wall_point  # its nearest point, m in base_link, if wall
float64 wall_sd     # standard deviation of the wall's direction, rad
int32 motion        # 0 other, 1 forward, 2 back, 3 turn
int32 label         # place id given with the recording, -1 none
uint32[3] view_shape  # rows, columns, channels
float64[] view      # row-major, in 0..1, if view_seen
uint32 whiskers
float64[] point     # whiskers x 2, m in base_link, where contact
uint8[] flags       # of each whisker; bit 0: it touched something, bit 1: it is dead
bool view_seen
bool wall           # whether a wall's orientation was measured
""",
    "ratslam_msgs/msg/Cycle": ODOMETRY
    + """uint32 samples
float64[] sample_time  # samples, s
uint32 whiskers
float64[] angle     # samples x whiskers, rad
uint32 axes         # 2
float64[] deflection  # samples x whiskers x 2
""",
    "ratslam_msgs/msg/Whisk": ODOMETRY
    + """uint32 whiskers
float64[] felt      # whiskers x 3: angle at first contact, rad; largest angle, rad; share of the shaft
uint8[] flags       # of each whisker; bit 0: it reports, bit 1: it touched, bit 2: it did so to the end
""",
    "ratslam_msgs/msg/Report": ODOMETRY
    + """int32 motion        # 0 other, 1 forward, 2 back, 3 turn
int32 moment        # how the step ended: 0 as planned, 1 first contact, 2 a second one, 3 strained too much
uint32 whiskers
float64[] sample_time  # samples, s since the beginning of the step
uint32 axes         # 2
float64[] strain    # samples x whiskers x 2
uint8[] flags       # of each whisker; bit 0: it reports, bit 1: it touches something
""",
    "ratslam_msgs/msg/Truth": """float64 time        # s, as in the reading it belongs to
float64 x           # m
float64 y           # m
float64 heading     # rad
""",
    "ratslam_msgs/msg/Cut": ODOMETRY
    + """float64 start       # when the whisk began, s
int64 number        # of the whisk
int64 first         # sequence of its first frame
int64 last          # of its last one
uint32 frames       # how many from first to last stand before this message
bool seen           # whether they became an image; false: only the motion counts
""",
    "ratslam_msgs/msg/Frames": """float64 time        # s, when the newest of them came
uint32 frames
int64[] sequence    # frames; the first, then differences
uint32 whiskers
int64[] device_time # frames, us; likewise
uint32 channels     # 3: angle, x and y of the deflection
uint32[] flags      # of each; bit 0: others were lost before it, 1: feedback, 2: fault, 3: a whisk begins
int16[] values      # whiskers x channels x frames; the first, then differences modulo 2^16; pi / 32768 rad
""",
    "ratslam_msgs/msg/Arm": """float64 time        # s, when the newest of them came
uint32 states
int64[] counter     # states
uint32 numbers      # 26
float64[] number    # 26 x states: receipt, robot's time, s; 6 each: tool pose, speed, force, joints
uint32 words        # 5
int32[] word        # 5 x states: robot mode, safety bits, runtime state, operation, progress
""",
    "ratslam_msgs/msg/Event": """float64 time        # s
string event        # its name, ': ', what was found
""",
}
(OBSERVATION, CYCLE, WHISK, REPORT, TRUTH, CUT, FRAMES, ARM, EVENT) = SCHEMAS
READINGS = (OBSERVATION, CYCLE, WHISK, REPORT, CUT)
"""Messages that make a sample."""
TOPICS = {name: f"/ratslam/{name.rsplit('/')[-1].lower()}" for name in SCHEMAS}
SCHEMA_OF = {topic: name for name, topic in TOPICS.items()}


CDR = b"\x00\x01\x00\x00"
MAX_NUMBERS = 100_000_000  # in one message; a larger number is a damaged length
_FEATURES = ("touched", "highest", "reach")
"""Values of each whisker in the field `felt` of a Whisk message."""
FLAGS = {OBSERVATION: ("contact", "dead"), WHISK: ("alive", "contact", "held"), REPORT: ("alive", "contact")}
"""Meaning of the bits of `flags`, from the lowest."""
_KINDS: dict[str, Any] = {OBSERVATION: Observation, CYCLE: Cycle, WHISK: Whisk, REPORT: Report}
_COUNTS = {CYCLE: ("samples", 44), REPORT: ("samples", 56), FRAMES: ("frames", 12), ARM: ("states", 12)}
"""The field with the number of samples, frames or states in a message, and its byte position."""
NUMBERS = ("host", "robot", "tcp", "speed", "force", "joints")
WORDS = ("mode", "safety", "runtime", "operation", "progress")
"""Fields of an arm state: floating-point numbers and 32-bit words, in the order of the message."""
_WIDTHS = [ARM_STATE[field].itemsize // 8 for field in NUMBERS]


class Malformed(ValueError):
    """A message that does not fit its schema."""


PIECE, RESET = "piece", "reset"
"""Names of the event before a sample that begins a piece of the map, as no odometry leads to it, and of the
event that says why, which may come before the last samples of the piece before."""


class Event(NamedTuple):
    """An event of a live session. Attributes: time: s. name: one word, such as `fault` or `discontinuity`.
    text: details."""

    time: float
    name: str
    text: str


DOUBTFUL = {
    "lost": "the connection to the robot was lost",
    "vanished": "a topic was no longer advertised",
    "gap": "odometry was missing, and a pose bridges it",
    RESET: "the odometry did not go on, and a piece of the map begins",
    "unusable": "messages could not be used",
    "outside": "values of touch are outside of their span and count as 0 or 1",
    "garbage": "what came is no message",
    "remainders": "the robot may lose parts of its motion",
    "fault": "a fault ended it",
}
"""Events after which the input of a session is not clean, and what they say."""


def doubts_of(events: Iterable[Event]) -> list[str]:
    """What events say against the input, a sentence for each kind, with how often it came."""
    found = dict[str, list[str]]()
    for event in events:
        found.setdefault(event.name, []).append(event.text)
    said = ((DOUBTFUL[name], texts) for name, texts in found.items() if name in DOUBTFUL)
    return [f"live session: {what} ({len(texts)} x, first: {texts[0]})" for what, texts in said]


def encode(
    content: Sample | Cut | Frames | np.ndarray | Event,
    view_shape: tuple[int, int, int],
    whiskers: int,
    arrival: float = np.nan,
) -> tuple[str, float, bytes]:
    """A part of a recording as (schema, time in s, message).

    Args:
        content: a sample, whose truth is left out; a cut, frames, arm states [N] (`ARM_STATE`), N > 0, or an
            event.
        arrival: of frames, when the newest of them came, s.

    Raises:
        InputError: a field has another shape, or values that its type cannot hold exactly.
    """
    if isinstance(content, Event):
        if ": " in content.name:
            raise ValueError(f"a colon in the event name {content.name!r}")
        text = f"{content.name}: {content.text}".encode() + b"\0"
        return EVENT, content.time, struct.pack("<4sdI", CDR, content.time, len(text)) + text
    count = 0
    values: dict[str, Any]
    if isinstance(content, Sample):
        name, count, values = _of_reading(content, whiskers)
    elif isinstance(content, Cut):
        name, values = CUT, content._asdict() | content.odometry._asdict()
    elif isinstance(content, Frames):
        name, count = FRAMES, len(content.sequence)
        counts = np.moveaxis(content.values, 0, -1)
        values = {"time": arrival, "sequence": _steps(content.sequence), "flags": content.flags}
        values |= {"device_time": _steps(content.time), "values": _steps(counts)}
    else:
        name, count = ARM, len(content)
        values = {"time": content["host"][-1], "counter": content["counter"].astype("<i8")}
        values["number"] = np.concatenate([content[field].reshape(count, -1).T for field in NUMBERS])
        values["word"] = np.stack([content[field].astype("<i4") for field in WORDS])
    dtype, blank, _, fields = _message_layout(name, view_shape, whiskers, count)
    record = blank.copy()
    for field in fields:
        record[field] = _convert_exactly(field, values[field], dtype[field])
    return name, float(values["time"]), record.tobytes()


def _of_reading(sample: Sample, whiskers: int) -> tuple[str, int, dict[str, Any]]:
    """The schema of a sample's reading, its number of samples, and its values by field."""
    reading, count = sample.reading, 0
    name = {kind: name for name, kind in _KINDS.items()}[type(reading)]
    values: dict[str, Any] = {**reading._asdict(), **reading.odometry._asdict()}
    booleans = np.dtype(("?", (whiskers,)))
    if isinstance(reading, Cycle | Report):
        count, values["sample_time"] = len(np.atleast_1d(reading.time)), reading.time
    elif isinstance(reading, Whisk):
        numbers = np.dtype(("<f8", (whiskers,)))
        columns = [_convert_exactly(field, values[field], numbers) for field in _FEATURES]
        values["felt"] = np.stack(columns, axis=1)
    else:
        values["dead"] = ~_convert_exactly("alive", reading.alive, booleans).astype(bool)
    if name in FLAGS:
        flags = np.zeros(whiskers, np.uint8)
        for bit, field in enumerate(FLAGS[name]):
            flags |= _convert_exactly(field, values[field], booleans).astype(np.uint8) << bit
        values["flags"] = flags
    return name, count, values | {"time": sample.time}


def decode(name: str, message: bytes, view_shape: tuple[int, int, int], whiskers: int) -> tuple[float, Any]:
    """(time, content) of a message; the inverse of `encode`: of a sample its reading, of a truth [3].

    Raises:
        Malformed: the message does not fit this schema, view shape and number of whiskers.
    """
    if name == EVENT:
        return _decode_event(message)
    count = 0
    if name in _COUNTS:
        count = int.from_bytes(message[_COUNTS[name][1] :][:4], "little")
        if 8 * count > len(message) or count * (1 + 3 * whiskers) > MAX_NUMBERS:
            raise Malformed(f"a message of {count} {_COUNTS[name][0]}")
    dtype, _, fixed, _ = _message_layout(name, view_shape, whiskers, count)
    if len(message) != dtype.itemsize:
        raise Malformed(f"a message of {len(message)} bytes where {dtype.itemsize} were expected")
    if any(message[start:stop] != content for start, stop, content in fixed):
        raise Malformed("a message with another shape than the recording's")
    record = np.frombuffer(message, dtype)[0]
    time = float(record["time"])
    if name == TRUTH:
        return time, np.array([record["x"], record["y"], record["heading"]])
    if name == FRAMES:
        return time, _frames(record)
    if name == ARM:
        return time, _states(record, count)
    odometry = Odometry(record["dx"], record["dy"], record["dtheta"], record["dt"])
    if name == CUT:
        number, first, last, frames = (int(record[field]) for field in ("number", "first", "last", "frames"))
        start, seen = float(record["start"]), bool(record["seen"])
        return time, Cut(number, time, start, first, last, frames, odometry, seen)
    kind = _KINDS[name]
    fields = [field for field in kind._fields if field in (dtype.names or ())]
    values = {field: record[field].copy() for field in fields}  # copies are aligned and writable
    for bit, field in enumerate(FLAGS.get(name, ())):
        values[field] = (record["flags"] >> bit & 1).astype(bool)
    if name in FLAGS and (record["flags"] >> len(FLAGS[name])).any():
        most = 2 ** len(FLAGS[name]) - 1
        raise Malformed(f"whisker flags {int(record['flags'].max())} where {most} is the largest possible")
    if name == OBSERVATION:
        values["alive"] = ~values.pop("dead")
    elif name == WHISK:
        values |= {field: record["felt"][:, k].copy() for k, field in enumerate(_FEATURES)}
    else:
        values["time"] = record["sample_time"].copy()
    if name == REPORT:
        values |= {field: int(record[field]) for field in ("motion", "moment")}
    return time, kind(odometry=odometry, **values)


def _frames(record: Any) -> Frames:
    flags = record["flags"]
    if (flags > 255).any():
        raise Malformed(f"frame flags {int(flags.max())} where 255 is the largest possible")
    values = np.cumsum(record["values"], axis=-1, dtype=np.int16)
    number, time = (np.cumsum(record[name], dtype=np.int64) for name in ("sequence", "device_time"))
    return Frames(number, time, flags.astype(np.uint8), np.ascontiguousarray(np.moveaxis(values, -1, 0)))


def _states(record: Any, count: int) -> np.ndarray:
    states = np.zeros(count, ARM_STATE)
    states["counter"] = record["counter"]
    columns = np.split(record["number"], np.cumsum(_WIDTHS)[:-1])
    for field, column in zip(NUMBERS, columns, strict=True):
        states[field] = column.T.reshape(states[field].shape)
    for field, word in zip(WORDS, record["word"], strict=True):
        states[field] = word.astype(ARM_STATE[field])
    return states


def _decode_event(message: bytes) -> tuple[float, Event]:
    head, text = message[:16], message[16:]
    if len(head) < 16 or head[:4] != CDR or int.from_bytes(head[12:], "little") != len(text):
        raise Malformed("an event of another length than it says")
    name, colon, found = text[:-1].decode().partition(": ")
    if not (colon and text.endswith(b"\0")):
        raise Malformed("an event without a name")
    (time,) = struct.unpack("<d", head[4:12])
    return time, Event(time, name, found)


def encode_truth(time: float, truth: np.ndarray) -> bytes:
    """A truth [3] as a message."""
    return CDR + np.array([time, *_convert_exactly("truth", truth, np.dtype(("<f8", (3,))))], "<f8").tobytes()


@lru_cache(maxsize=512)
def _message_layout(
    name: str, view_shape: tuple[int, int, int], whiskers: int, count: int
) -> tuple[np.dtype, np.ndarray, list[tuple[int, int, bytes]], list[str]]:
    """The byte layout of a message of this schema, for these sizes: the message as a packed record; a record
    with lengths and shapes filled in; (start, stop, bytes) of all parts that are equal in every message of
    this layout; names of the variable fields."""
    shapes = {
        "view": view_shape,
        "point": (whiskers, 2),
        "flags": (count,) if name == FRAMES else (whiskers,),
        "felt": (whiskers, len(_FEATURES)),
        "angle": (count, whiskers),
        "deflection": (count, whiskers, 2),
        "strain": (count, whiskers, 2),
        "values": (whiskers, CHANNELS, count),
        "number": (sum(_WIDTHS), count),
        "word": (len(WORDS), count),
        **dict.fromkeys(("sample_time", "sequence", "device_time", "counter"), (count,)),
    }
    sizes: dict[str, Any] = {"view_shape": view_shape, "whiskers": whiskers, "axes": 2, "channels": CHANNELS}
    sizes |= {"numbers": sum(_WIDTHS), "words": len(WORDS)}
    if name in _COUNTS:
        sizes[_COUNTS[name][0]] = count
    fixed: dict[str, Any] = {"cdr": list(CDR)}
    fields: list[tuple[str, Any, tuple[int, ...]]] = [("cdr", "u1", (4,))]
    for line in SCHEMAS[name].splitlines():
        kind, field = line.split()[:2]
        base, _, size = kind.partition("[")
        shape: tuple[int, ...] = (int(size[:-1]),) if size[:-1] else ()
        if size == "]":
            shape = shapes[field]
            fixed[f"{field}_length"] = int(np.prod(shape))
            fields.append((f"{field}_length", "<u4", ()))
        elif field in sizes:
            fixed[field] = sizes[field]
        fields.append((field, np.dtype(base).newbyteorder("<"), shape))  # both have the same names
    dtype = np.dtype(fields)
    blank = np.zeros((), dtype)
    for field, value in fixed.items():
        blank[field] = value
    content = blank.tobytes()
    places = [(dtype.fields[field][1], dtype[field].itemsize) for field in fixed]  # type: ignore[index]
    parts = [(start, start + size, content[start : start + size]) for start, size in places]
    return dtype, blank, parts, [field for field, *_ in fields if field not in fixed]


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


def _steps(value: np.ndarray) -> np.ndarray:
    """The first value along the last axis, then differences; both wrap around."""
    return np.diff(value, axis=-1, prepend=value.dtype.type(0))
