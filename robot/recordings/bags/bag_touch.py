"""Touch sensors in JointState and MultiArray messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from robot.recordings.bags.bag import Bag
from robot.recordings.bags.stamps import Clock, Report, Series, as_series, read_usable
from robot.recordings.bags.topics_config import TouchTopic
from robot.sources.input_files import missing_error
from tactile.base.errors import InputError

JOINTS = "sensor_msgs/msg/JointState"
ARRAYS = ("std_msgs/msg/Float32MultiArray", "std_msgs/msg/Float64MultiArray")


def read_touch(bag: Bag, config: TouchTopic, clock: Clock, report: Report) -> Series:
    """Touch [M, R, C, 1] in 0..1.

    Raises:
        InputError: the topic does not exist, has another type, or its values do not fill rows and columns.
    """
    topic = bag.topic(config.topic, "recording.topics.touch")
    where = f"{bag.path}, {topic.name}"
    if topic.kind not in (JOINTS, *ARRAYS):
        expected = f"one of {JOINTS}, {', '.join(ARRAYS)}"
        raise InputError(where, f"messages of type {topic.kind}", expected)
    names, shape, known = config.joints, None, list[str]()

    def read(content: Any, place: str) -> np.ndarray | None:
        nonlocal names, shape
        if topic.kind == JOINTS:
            known.extend(name for name in content.name if name not in known)
            if names and not set(names) <= set(content.name):
                return None
            value = _joint_values(content, names or tuple(content.name), config.use, place)
        else:
            value = _array_values(content, place)
        if not np.isfinite(value).all():
            raise InputError(place, f"touch is {value[~np.isfinite(value)][0]}", "a finite number")
        shape = shape or _shape(content, len(value), config, place)
        if len(value) != shape[0] * shape[1]:
            expected = f"{shape[0]} x {shape[1]}, as in the first message"
            raise InputError(place, f"{len(value)} values", expected)
        if topic.kind == JOINTS:
            names = names or tuple(content.name)
        return value

    rows = [row for row in read_usable(bag, topic, clock, read) if row[2] is not None]
    numbers, stamps, values = ([row[k] for row in rows] for k in range(3))
    if not values:
        absent = next((name for name in names if name not in known), None)
        if absent is not None:
            raise missing_error(where, "joint", absent, known, "recording.topics.touch.joints")
    scaled = (np.array(values) - config.low) / (config.high - config.low)
    series = as_series(where, numbers, stamps, scaled, clock, report)
    errors = list(series.errors)
    outside = float(np.mean((scaled < 0) | (scaled > 1)))
    if outside > 0.5:
        found = f"values from {np.nanmin(values):.4g} to {np.nanmax(values):.4g}, most of them outside"
        expected = f"{config.low:g} to {config.high:g}"
        errors.append(InputError(where, found, expected, "set recording.topics.touch.low and high"))
    assert shape is not None
    views = np.clip(series.values, 0.0, 1.0).reshape(-1, *shape, 1)
    return series._replace(values=views, errors=errors)


def _joint_values(content: Any, names: tuple[str, ...], use: str, place: str) -> np.ndarray:
    given = np.asarray(getattr(content, use), float)
    if len(given) != len(content.name):
        found = f"{len(content.name)} joints and {len(given)} values of {use}"
        raise InputError(place, found, "one for each joint", "set recording.topics.touch.use")
    at = {name: index for index, name in enumerate(content.name)}
    absent = next((name for name in names if name not in at), None)
    if absent is not None:
        cure = "name the joints of the touch sensors in recording.topics.touch.joints"
        raise InputError(place, f"no joint {absent!r}", f"the joints {', '.join(names)}", cure)
    return given[[at[name] for name in names]]


def _array_values(content: Any, place: str) -> np.ndarray:
    data, skip = np.asarray(content.data, float), int(content.layout.data_offset)
    if skip > len(data):
        raise InputError(place, f"data_offset {skip} of {len(data)} values", "at most their number")
    return data[skip:]


def _shape(content: Any, size: int, config: TouchTopic, place: str) -> tuple[int, int]:
    """(R, C) of the sensors."""
    rows, columns = config.rows, config.columns
    laid = [int(dim.size) for dim in content.layout.dim] if hasattr(content, "layout") else []
    if rows is None and columns is None and len(laid) == 2 and laid[0] * laid[1] == size:
        return laid[0], laid[1]
    rows = rows or (size // columns if columns else 1)
    columns = columns or size // rows
    if size == 0 or rows * columns != size:
        found, cure = f"{size} values", "set recording.topics.touch.rows and columns"
        raise InputError(place, found, f"{rows} x {columns}", cure)
    return rows, columns
