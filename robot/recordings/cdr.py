"""Samples and live data as ROS 2 messages in little-endian CDR, which any ROS 2 or MCAP tool can read.

A message has four bytes (00 01 00 00) and the fields of its schema (`SCHEMAS`) back to back; an unbounded
array is preceded by its length (uint32). float64 values keep every bit. Every file stores the schemas, whose
fields are ordered so that CDR needs no padding. A changed text, even in a comment, is another format.

Live data are blocks of frames and of arm states, cuts and events. Frames are stored channel by channel as
differences from frame to frame: small numbers, which compress well.
"""

from __future__ import annotations

import struct
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
TOPICS = {
    OBSERVATION: "/ratslam/observation",
    CYCLE: "/ratslam/cycle",
    WHISK: "/ratslam/whisk",
    REPORT: "/ratslam/report",
    TRUTH: "/ratslam/truth",
    CUT: "/ratslam/cut",
    FRAMES: "/ratslam/frames",
    ARM: "/ratslam/arm",
    EVENT: "/ratslam/event",
}
SCHEMA_OF = {topic: name for name, topic in TOPICS.items()}


CDR = b"\x00\x01\x00\x00"
MAX_NUMBERS = 100_000_000  # in one message; a larger number is a damaged length
_FEATURES = ("touched", "highest", "reach")
"""Values of each whisker in the field `felt` of a Whisk message."""
FLAGS = {OBSERVATION: ("contact", "dead"), WHISK: ("alive", "contact", "held"), REPORT: ("alive", "contact")}
"""Meaning of the bits of `flags`, from the lowest."""
_SAMPLES_AT = {CYCLE: 44, REPORT: 56}
"""Byte position of the number of samples in a message."""
_TYPES = {"float64": "<f8", "int32": "<i4", "uint32": "<u4", "uint8": "u1", "bool": "?"}
"""NumPy types of the types in `SCHEMAS`."""


class Malformed(ValueError):
    """A message that does not fit its schema."""


class _Layout(NamedTuple):
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
    names = {Observation: OBSERVATION, Cycle: CYCLE, Whisk: WHISK, Report: REPORT}
    name, samples = names[type(reading)], 0
    values: dict[str, Any] = {**reading._asdict(), **reading.odometry._asdict()}
    if isinstance(reading, Cycle | Report):
        samples, values["sample_time"] = len(np.atleast_1d(reading.time)), reading.time
    elif isinstance(reading, Whisk):
        numbers = np.dtype(("<f8", (whiskers,)))
        columns = [_convert_exactly(field, values[field], numbers) for field in _FEATURES]
        values["felt"] = np.stack(columns, axis=1)
    else:
        values["dead"] = ~_convert_exactly("alive", reading.alive, np.dtype(("?", (whiskers,)))).astype(bool)
    layout = _message_layout(name, view_shape, whiskers, samples)
    if name in FLAGS:
        flags, booleans = np.zeros(whiskers, np.uint8), np.dtype(("?", (whiskers,)))
        for bit, field in enumerate(FLAGS[name]):
            flags |= _convert_exactly(field, values[field], booleans).astype(np.uint8) << bit
        values["flags"] = flags
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
    if name in _SAMPLES_AT:
        samples = int.from_bytes(message[_SAMPLES_AT[name] :][:4], "little")
        if samples * (1 + 3 * whiskers) > MAX_NUMBERS:
            raise Malformed(f"a message of {samples} samples")
    layout = _message_layout(name, view_shape, whiskers, samples)
    if len(message) != layout.dtype.itemsize:
        raise Malformed(f"a message of {len(message)} bytes where {layout.dtype.itemsize} were expected")
    if any(message[start:stop] != content for start, stop, content in layout.fixed):
        raise Malformed("a message with another shape than the recording's")
    record = np.frombuffer(message, layout.dtype)[0]
    odometry = Odometry(record["dx"], record["dy"], record["dtheta"], record["dt"])
    if name == CYCLE:
        time, angle, deflection = (record[field].copy() for field in ("sample_time", "angle", "deflection"))
        return float(record["time"]), Cycle(time, angle, deflection, odometry)
    bits, names = record["flags"], FLAGS[name]
    if (bits >> len(names)).any():
        most = 2 ** len(names) - 1
        raise Malformed(f"whisker flags {int(bits.max())} where {most} is the largest possible")
    flags = {field: (bits >> bit & 1).astype(bool) for bit, field in enumerate(names)}
    if name == WHISK:
        felt = {field: record["felt"][:, k].copy() for k, field in enumerate(_FEATURES)}
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
def _message_layout(name: str, view_shape: tuple[int, int, int], whiskers: int, samples: int) -> _Layout:
    """The packed form of the schema of a reading for these sizes."""
    shapes = {
        "view": view_shape,
        "point": (whiskers, 2),
        "flags": (whiskers,),
        "felt": (whiskers, len(_FEATURES)),
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
        fields.append((field, _TYPES[base], (int(size[:-1]),) if size[:-1] else shapes.get(field, ())))
    sizes = {"view_shape": view_shape, "whiskers": whiskers, "samples": samples, "axes": 2}
    dtype = np.dtype(fields)
    fixed |= {field: size for field, size in sizes.items() if field in (dtype.names or ())}
    blank = np.zeros((), dtype)
    for field, value in fixed.items():
        blank[field] = value
    content = blank.tobytes()
    places = [(dtype.fields[field][1], dtype[field].itemsize) for field in fixed]  # type: ignore[index]
    return _Layout(
        dtype=dtype,
        blank=blank,
        fixed=tuple((start, start + size, content[start : start + size]) for start, size in places),
        fields=tuple(field for field, *_ in fields if field not in fixed),
    )


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


NUMBERS = ("host", "robot", "tcp", "speed", "force", "joints")
WORDS = ("mode", "safety", "runtime", "operation", "progress")
"""Fields of an arm state: floating-point numbers and 32-bit words, in the order of the message."""


class Event(NamedTuple):
    """An event of a live session. Attributes: time: s. name: one word, such as `fault` or `discontinuity`.
    text: details."""

    time: float
    name: str
    text: str


def encode_frames(time: float, frames: Frames) -> bytes:
    """Encode a block of frames; `time` is the arrival of the newest one, s."""
    count, whiskers, channels = frames.values.shape
    planes = frames.values.reshape(count, whiskers * channels).T
    parts = [
        struct.pack("<4sd2I", CDR, time, count, count),
        _encode_steps(frames.sequence, "<i8"),
        struct.pack("<2I", whiskers, count),
        _encode_steps(frames.time, "<i8"),
        struct.pack("<2I", channels, count),
        frames.flags.astype("<u4").tobytes(),
        struct.pack("<I", planes.size),
        _encode_steps(planes, "<i2"),
    ]
    return b"".join(parts)


def decode_frames(message: bytes, whiskers: int) -> tuple[float, Frames]:
    """Decode (time, frames) of a head with this number of whiskers; raises `Malformed`."""
    fields = _Fields(message)
    time = fields.number("<d")
    count = fields.size()
    sequence = fields.array("<i8", count)
    if fields.size() != whiskers:
        raise Malformed(f"frames with another number of whiskers than the recording, {whiskers}")
    device = fields.array("<i8", count)
    if fields.size() != CHANNELS:
        raise Malformed(f"frames without exactly {CHANNELS} channels")
    flags = fields.array("<u4", count)
    planes = fields.array("<i2", count * whiskers * CHANNELS).reshape(whiskers * CHANNELS, count)
    fields.end()
    if (flags > 255).any():
        raise Malformed(f"frame flags {int(flags.max())} where 255 is the largest possible")
    values = np.cumsum(planes, axis=1, dtype=np.int16).T.reshape(count, whiskers, CHANNELS)
    return time, Frames(
        np.cumsum(sequence, dtype=np.int64),
        np.cumsum(device, dtype=np.int64),
        flags.astype(np.uint8),
        np.ascontiguousarray(values),
    )


def encode_states(states: np.ndarray) -> bytes:
    """Encode arm states [N], N > 0 (`robot.drivers.ur10.shared_state.ARM_STATE`)."""
    count = len(states)
    numbers = np.concatenate([states[name].reshape(count, -1) for name in NUMBERS], axis=1)
    words = np.stack([states[name].astype("<i4") for name in WORDS])
    parts = [
        struct.pack("<4sd2I", CDR, states["host"][-1], count, count),
        states["counter"].astype("<i8").tobytes(),
        struct.pack("<2I", numbers.shape[1], numbers.size),
        np.ascontiguousarray(numbers.T, "<f8").tobytes(),
        struct.pack("<2I", len(words), words.size),
        words.tobytes(),
    ]
    return b"".join(parts)


def decode_states(message: bytes) -> tuple[float, np.ndarray]:
    """Decode (time, states [N]); raises `Malformed`."""
    fields = _Fields(message)
    time = fields.number("<d")
    count = fields.size()
    counter = fields.array("<i8", count)
    rows = fields.size()
    numbers = fields.array("<f8", rows * count).reshape(rows, count)
    width = fields.size()
    words = fields.array("<i4", width * count).reshape(width, count)
    fields.end()
    if width != len(WORDS) or rows != sum(ARM_STATE[name].itemsize // 8 for name in NUMBERS):
        raise Malformed(f"arm states of {rows} numbers and {width} words")
    states = np.zeros(count, ARM_STATE)
    states["counter"] = counter
    row = 0
    for name in NUMBERS:
        wide = ARM_STATE[name].itemsize // 8
        states[name] = numbers[row : row + wide].T.reshape(states[name].shape)
        row += wide
    for name, word in zip(WORDS, words, strict=True):
        states[name] = word.astype(ARM_STATE[name])
    return time, states


_CUT = struct.Struct("<4s6d3qI?")


def encode_cut(cut: Cut) -> bytes:
    """Encode a cut."""
    return _CUT.pack(
        CDR, cut.time, *cut.odometry, cut.start, cut.number, cut.first, cut.last, cut.frames, cut.seen
    )


def decode_cut(message: bytes) -> Cut:
    """Decode a cut; raises `Malformed`."""
    if len(message) != _CUT.size or not message.startswith(CDR):
        raise Malformed("malformed Cut message")
    _, time, *motion, start, number, first, last, frames, seen = _CUT.unpack(message)
    odometry = Odometry(*(np.float64(value) for value in motion))
    return Cut(number, time, start, first, last, frames, odometry, seen)


def encode_event(event: Event) -> bytes:
    """Encode an event."""
    if ": " in event.name:
        raise ValueError(f"a colon in the event name {event.name!r}")
    text = f"{event.name}: {event.text}".encode() + b"\0"
    return struct.pack("<4sdI", CDR, event.time, len(text)) + text


def decode_event(message: bytes) -> Event:
    """Decode an event; raises `Malformed`."""
    fields = _Fields(message)
    time = fields.number("<d")
    text = fields.array("u1", None).tobytes()
    fields.end()
    name, colon, found = text[:-1].decode().partition(": ")
    if not (colon and text.endswith(b"\0")):
        raise Malformed("an event without a name")
    return Event(time, name, found)


def _encode_steps(value: np.ndarray, kind: str) -> bytes:
    """The first value along the last axis, then differences; both wrap around."""
    return np.diff(value, axis=-1, prepend=value.dtype.type(0)).astype(kind).tobytes()


class _Fields:
    """Reads the fields of a message in order."""

    def __init__(self, message: bytes) -> None:
        if not message.startswith(CDR):
            raise Malformed("a message with another encoding than little-endian CDR")
        self._message, self._place = message, len(CDR)

    def number(self, kind: str) -> float:
        """Read one number."""
        return float(self._take(kind, 1)[0])

    def size(self) -> int:
        """Read a uint32."""
        return int(self._take("<u4", 1)[0])

    def array(self, kind: str, count: int | None) -> np.ndarray:
        """Read an array, which must have `count` numbers if that is given."""
        found = self.size()
        if count is not None and found != count:
            raise Malformed(f"an array of {found} numbers where {count} were expected")
        return self._take(kind, found)

    def end(self) -> None:
        """Require the end of the message."""
        if self._place != len(self._message):
            raise Malformed(f"{len(self._message) - self._place} bytes after the end of the message")

    def _take(self, kind: str, count: int) -> np.ndarray:
        size = np.dtype(kind).itemsize * count
        if count > MAX_NUMBERS or self._place + size > len(self._message):
            raise Malformed("a message that ends too early")
        found = np.frombuffer(self._message, kind, count, self._place)
        self._place += size
        return found
