"""Bags written with the writers of rosbags: ROS 1, and ROS 2 as sqlite3 or MCAP, compressed or not."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
for store in (ROS1, ROS2):
    store.register(get_types_from_msg("float32 energy\nstring note", "lab_msgs/msg/Custom"))
CREATE = {
    "irobot_create_msgs/msg/HazardDetection": "uint8 BUMP=1\nstd_msgs/Header header\nuint8 type",
    "irobot_create_msgs/msg/HazardDetectionVector": (
        "std_msgs/Header header\nirobot_create_msgs/HazardDetection[] detections"
    ),
    "irobot_create_msgs/msg/IrIntensity": "std_msgs/Header header\nint16 value",
    "irobot_create_msgs/msg/IrIntensityVector": (
        "std_msgs/Header header\nirobot_create_msgs/IrIntensity[] readings"
    ),
    "create_msgs/msg/Bumper": (
        "std_msgs/Header header\nbool is_left_pressed\nbool is_right_pressed\nuint16 light_signal_left"
    ),
}
"""Messages of a Create, which ROS itself does not define."""
for kind, text in CREATE.items():
    for store in (ROS1, ROS2):
        store.register(get_types_from_msg(text, kind))
for early in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
    ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", early))

KINDS = {
    "ros1": ("run.bag", None),
    "ros1-bz2": ("run.bag", rosbag1.Writer.CompressionFormat.BZ2),
    "ros1-lz4": ("run.bag", rosbag1.Writer.CompressionFormat.LZ4),
    "sqlite3": (StoragePlugin.SQLITE3, CompressionMode.NONE),
    "sqlite3-file": (StoragePlugin.SQLITE3, CompressionMode.FILE),
    "sqlite3-message": (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    "mcap": (StoragePlugin.MCAP, CompressionMode.NONE),
    "mcap-file": (StoragePlugin.MCAP, CompressionMode.FILE),
    "mcap-message": (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    "mcap-storage": (StoragePlugin.MCAP, CompressionMode.STORAGE),
}


class Entry(NamedTuple):
    """A message of a bag: time of receipt, ns; nested fields, of which absent ones are 0."""

    topic: str
    kind: str
    time: int
    fields: Mapping[str, Any]


def write_bag(folder: Path, kind: str, entries: Sequence[Entry], *, little_endian: bool = True) -> Path:
    """Writes a bag; returns the file (ROS 1) or folder (ROS 2)."""
    plugin, compression = KINDS[kind]
    first = kind.startswith("ros1")
    path = folder / (plugin if first else "run")
    typestore = ROS1 if first else ROS2
    writer: Any = rosbag1.Writer(path) if first else rosbag2.Writer(path, version=9, storage_plugin=plugin)
    if first and compression is not None:
        writer.set_compression(compression)
    elif not first:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, msgtype, time, fields in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=typestore)
            message = built(typestore, msgtype, fields)
            if first:
                raw = typestore.serialize_ros1(message, msgtype)
            else:
                raw = typestore.serialize_cdr(message, msgtype, little_endian=little_endian)
            writer.write(connections[topic], time, raw)
    return path


def built(typestore: Any, msgtype: str, fields: Mapping[str, Any]) -> Any:
    found = {}
    for name, description in typestore.fielddefs[msgtype][1]:
        found[name] = _value(typestore, description, fields.get(name))
    return typestore.types[msgtype](**found)


def _value(typestore: Any, description: Any, given: Any) -> Any:
    node, (inner, *size) = (
        description[0],
        description[1] if isinstance(description[1], tuple) else (description[1],),
    )
    if node == Nodetype.NAME:
        return built(typestore, inner, given or {})
    if node == Nodetype.BASE:
        if inner == "string":
            return given or ""
        return given if given is not None else (0.0 if inner.startswith("float") else 0)
    if inner[0] == Nodetype.NAME:
        return [built(typestore, inner[1], each) for each in given or []]
    base = inner[1][0]
    if base == "string":
        return list(given or [])
    kind = {"bool": "bool", "char": "uint8", "byte": "uint8"}.get(base, base)
    if given is None:
        return np.zeros(size[0] if node == Nodetype.ARRAY else 0, kind)
    return np.asarray(given, kind)


def header(time: int, frame: str = "") -> dict[str, Any]:
    return {"stamp": {"sec": time // 10**9, "nanosec": time % 10**9}, "frame_id": frame}


def quaternion(yaw: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def pose(x: float, y: float, yaw: float) -> dict[str, Any]:
    return {"position": {"x": x, "y": y, "z": 0.0}, "orientation": quaternion(yaw)}


def odometry(
    time: int, x: float, y: float, yaw: float, twist: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Entry:
    forward, left, turn = twist
    velocity = {"linear": {"x": forward, "y": left, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": turn}}
    fields = {
        "header": header(time, "odom"),
        "child_frame_id": "base_link",
        "pose": {"pose": pose(x, y, yaw)},
        "twist": {"twist": velocity},
    }
    return Entry("/odom", "nav_msgs/msg/Odometry", time, fields)


def scan(time: int, ranges: Sequence[float] | np.ndarray, first: float, step: float, **fields: Any) -> Entry:
    given = {
        "header": header(time, "laser"),
        "angle_min": first,
        "angle_max": first + step * (len(ranges) - 1),
        "angle_increment": step,
        "range_min": 0.0,
        "range_max": 80.0,
        "ranges": np.asarray(ranges, np.float32),
    }
    return Entry("/scan", "sensor_msgs/msg/LaserScan", time, given | fields)


def image(
    time: int, pixels: np.ndarray, encoding: str = "mono8", topic: str = "/image", **fields: Any
) -> Entry:
    """A raw image of pixels [H, W] or [H, W, C]."""
    data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
    size = {"height": len(pixels), "width": pixels.shape[1], "step": len(data) // len(pixels)}
    given = {"header": header(time), "encoding": encoding, "data": data} | size
    return Entry(topic, "sensor_msgs/msg/Image", time, given | fields)


def transform(
    time: int, parent: str, child: str, x: float, y: float, turn: Mapping[str, float]
) -> dict[str, Any]:
    moved = {"translation": {"x": x, "y": y, "z": 0.0}, "rotation": turn}
    return {"header": header(time, parent), "child_frame_id": child, "transform": moved}


def tf(time: int, *transforms: Mapping[str, Any], topic: str = "/tf") -> Entry:
    return Entry(topic, "tf2_msgs/msg/TFMessage", time, {"transforms": list(transforms)})
