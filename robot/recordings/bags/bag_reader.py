"""Bags as sources: odometry, views or touch (JointState and MultiArray messages), and truth, each from a
topic.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from robot.recordings.alignment import blank_rows, interpolated_poses, judged, nearest_rows, no_overlap_error
from robot.recordings.bags.bag import Bag, Series, as_series, bag_files
from robot.recordings.bags.topics_config import OdometryTopic, TopicsConfig, TouchTopic, ViewsTopic
from robot.recordings.bags.transforms import read_odometry, read_poses
from robot.recordings.bags.views import IMAGES, KEY, read_image_views, read_range_views
from robot.recordings.bags.wrench_pokes import read_forces, read_rings
from robot.recordings.input_judge import InputJudge, MotionTrack, limits_of, unit_cure
from robot.recordings.recording_config import RecordingConfig
from robot.recordings.sanity_checks import SPOILT
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of, missing_error, raise_errors
from robot.sources.odometry import from_poses
from robot.sources.source import SourceInfo
from tactile.base.errors import InputError
from tactile.base.se2 import integrate
from tactile.base.types import Observation
from tactile.pokes import PokeConfig

JOINTS = "sensor_msgs/msg/JointState"
ARRAYS = ("std_msgs/msg/Float32MultiArray", "std_msgs/msg/Float64MultiArray")
HAZARDS, PROXIMITY = (
    f"irobot_create_msgs/msg/{name}" for name in ("HazardDetectionVector", "IrIntensityVector")
)
NAMED: dict[str, tuple[str, ...]] = {
    HAZARDS: tuple(f"bump_{side}" for side in ("left", "front_left", "front_center", "front_right", "right")),
    PROXIMITY: (),
    "create_msgs/msg/Bumper": ("is_left_pressed", "is_right_pressed"),
}
"""Messages of a Create whose sensors have names, and those that are used unless `joints` names others, from
the left; (): all of the first message."""
TOUCHES = (JOINTS, *ARRAYS, *NAMED)
"""Types of messages that can be touch."""


class TouchReader:
    """Values of the messages of a topic; what the settings leave open is as in the first message.

    Attributes:
        shape: (R, C) of the sensors, None before the first message. known: names of all joints so far.
    """

    def __init__(self, kind: str, config: TouchTopic) -> None:
        self._kind, self._config, self._names = kind, config, config.joints
        self.shape: tuple[int, int] | None = None
        self.known = dict[str, None]()

    def values(self, content: Any, place: str) -> np.ndarray | None:
        """[R * C] of a message, as recorded; None if it has not the joints that the settings name.

        Raises:
            InputError: values are missing or not finite, or not as many as in the first message.
        """
        joints = self._kind == JOINTS
        if self._kind in NAMED:
            found = named_values(self._kind, content)
            self._names = self._names or NAMED[self._kind] or tuple(found)
            absent = [name for name in self._names if name not in found and self._kind != HAZARDS]
            if absent:
                expected = f"one of {', '.join(found)}"
                raise InputError(
                    place, f"no sensor {absent[0]!r}", expected, "set recording.topics.touch.joints"
                )
            value = np.array([found.get(name, 0.0) for name in self._names])
        elif joints:
            self.known.update(dict.fromkeys(content.name))
            if self._names and not set(self._names) <= set(content.name):
                return None
            value = _joint_values(content, self._names or tuple(content.name), self._config.use, place)
        else:
            value, skip = np.asarray(content.data, float), int(content.layout.data_offset)
            if skip > len(value):
                raise InputError(place, f"data_offset {skip} of {len(value)} values", "at most their number")
            value = value[skip:]
        if not np.isfinite(value).all():
            raise InputError(place, f"touch is {value[~np.isfinite(value)][0]}", "a finite number")
        self.shape = self.shape or _shape(content, len(value), self._config, place)
        if len(value) != self.shape[0] * self.shape[1]:
            expected = f"{self.shape[0]} x {self.shape[1]}, as in the first message"
            raise InputError(place, f"{len(value)} values", expected)
        if joints:
            self._names = self._names or tuple(content.name)
        return value

    def scaled(self, values: np.ndarray) -> np.ndarray:
        """Values in the span of the settings, of which 0 to 1 is not exceeded."""
        return (values - self._config.low) / (self._config.high - self._config.low)


def named_values(kind: str, content: Any) -> dict[str, float]:
    """The values of the sensors in a message whose sensors have names (`NAMED`); of hazards those that are
    there, each 1."""
    if kind == HAZARDS:
        return {str(each.header.frame_id): 1.0 for each in content.detections}
    if kind == PROXIMITY:
        return {str(each.header.frame_id): float(each.value) for each in content.readings}
    fields = ((name, value) for name, value in vars(content).items() if not hasattr(value, "stamp"))
    return {name: float(value) for name, value in fields if isinstance(value, (bool, int, float))}


def _read_touch(bag: Bag, config: TouchTopic) -> Series:
    """Touch [M, R, C, 1] in 0..1."""
    topic = bag.topic(config.topic, "recording.topics.touch", TOUCHES)
    where, reader = f"{bag.path}, {topic.name}", TouchReader(topic.kind, config)
    rows = [row for row in bag.stamped(topic, reader.values) if row[2] is not None]
    numbers, stamps, values = ([row[k] for row in rows] for k in range(3))
    if not values:
        absent = next((name for name in config.joints if name not in reader.known), None)
        if absent is not None:
            raise missing_error(where, "joint", absent, list(reader.known), "recording.topics.touch.joints")
    scaled = reader.scaled(np.array(values))
    series = as_series(bag, where, numbers, stamps, scaled)
    errors = list(series.errors)
    outside = float(np.mean((scaled < 0) | (scaled > 1)))
    if outside > 0.5:
        found = f"values from {np.nanmin(values):.4g} to {np.nanmax(values):.4g}, most of them outside"
        expected = f"{config.low:g} to {config.high:g}"
        errors.append(InputError(where, found, expected, "set recording.topics.touch.low and high"))
    assert reader.shape is not None
    views = np.clip(series.values, 0.0, 1.0).reshape(-1, *reader.shape, 1)
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


NO_VIEWS = (3, 6, 1)  # shape of the masked views of a recording without any


@np.errstate(all="ignore")  # what is no number, or far too large, is reported
def read_bag(settings: RecordingConfig, judge: InputJudge, pokes: PokeConfig) -> InMemorySource:
    """A bag as a `Source`: one sample for each odometry message, or for each view.

    Args:
        judge: is told of every message that is left out, and judges the odometry. pokes: of another program,
            for `topics.wrench`.

    Raises:
        InputError: the bag is damaged, topics are missing or of another type, or values are impossible.
    """
    path, config = settings.file, settings.topics or TopicsConfig()
    assert path is not None
    with Bag(path, judge.say, judge.stretch, config.clock) as bag:
        config = _with_preset(bag, config)
        if config.odometry is None and (settings.visual_odometry is None or config.views is None):
            expected = "topics: {odometry: TOPIC}, or images as views and visual_odometry"
            listed = ", ".join(f"{topic.name} ({topic.kind})" for topic in bag.topics.values())
            raise InputError("recording.topics", "no odometry", expected, f"the bag has {listed}")
        odometry, views = _read_steps(bag, config, settings)
        truth = None if config.truth is None else read_poses(bag, config.truth)
    found = [*odometry.errors, *(views.errors if views else []), *(truth.errors if truth else [])]
    raise_errors(list(dict.fromkeys(found)))
    raise_errors(_judge(odometry, judge))
    rings, info = list[Observation](), SourceInfo(drives=config.touch is not None)
    if views is not None and config.wrench is not None:
        views, rings = read_rings(bag, odometry, views, config.wrench, pokes)
        info = SourceInfo(pokes=pokes)
    if views is not None and config.samples == "views":
        odometry, views = _sample_views(bag, odometry, views)
    shape, whiskers = NO_VIEWS, 0
    if views is not None:
        shape = (*views.values.shape[1:3], 1)
        whiskers = 0 if config.views is not None else shape[0] * shape[1]
    errors, time = list[InputError](), odometry.time
    rows = blank_rows(path, time, odometry.values, shape)
    if views is not None:
        part = config.views or config.touch
        errors += _place_views(bag, rows, views, part.tolerance if part else None)
    if rings:
        rows |= {name: np.array([getattr(ring, name) for ring in rings]) for name in ("contact", "point")}
    if truth is not None:
        rows["truth"], faults = interpolated_poses(time, truth.time, truth.values, "time", truth.where)
        errors += faults
    alive = np.ones(whiskers, bool)
    source = InMemorySource(digest=digest_of(bag_files(path)), alive=alive, info=info, **rows)
    # The odometry is judged: only the truth is compared.
    judge = replace(judge, warn=None, limits=limits_of(info.interval, judge.limits))
    return judged(source, errors, judge, str(path))


def _judge(odometry: Series, judge: InputJudge) -> list[InputError]:
    """Judges the odometry as recorded, each step by the number of its message."""
    time, clock = odometry.time, odometry.clock
    track = MotionTrack(time, np.ones(len(time), bool), odometry.values, None, odometry.held, odometry.poses)

    def cures(quantity: str, unit: str) -> str:
        receipt = clock or "--set recording.topics.clock=bag"
        return receipt if quantity == "time" else unit_cure(quantity, unit)

    return judge.errors(track, odometry.place, odometry.where, clock, cures)


def _with_preset(bag: Bag, config: TopicsConfig) -> TopicsConfig:
    """The topics, with those of OpenRatSLAM where only their root is given."""
    if config.openratslam is None:
        return config
    root = f"/{config.openratslam.strip('/')}"
    wheels, image = f"{root}/odom", f"{root}/camera/image"
    images = [name for name in (image, f"{image}/compressed") if name in bag.topics]
    if wheels not in bag.topics and not images:
        key = "recording.topics.openratslam"
        raise missing_error(str(bag.path), "topic", wheels, list(bag.topics), key)
    found: dict[str, OdometryTopic | ViewsTopic] = {}
    if config.odometry is None and wheels in bag.topics:
        found["odometry"] = OdometryTopic(topic=wheels, use="twist")
    if config.views is None and config.touch is None and config.wrench is None and images:
        found["views"] = ViewsTopic(topic=images[0])
    return config.model_copy(update=found)


def _read_steps(bag: Bag, config: TopicsConfig, settings: RecordingConfig) -> tuple[Series, Series | None]:
    """The odometry, and the views, touch readings or forces if there are any."""
    odometry = None if config.odometry is None else read_odometry(bag, config.odometry)
    if config.views is not None and (topic := bag.topic(config.views.topic, KEY)).kind in IMAGES:
        wanted = None if odometry is not None else settings.visual_odometry
        views, motion = read_image_views(bag, topic, settings.image, wanted)
        if odometry is not None:
            return odometry, views
        assert motion is not None
        return views._replace(values=motion), views
    if odometry is None:
        raise InputError("recording.visual_odometry", "views without images", "images, or topics.odometry")
    if config.views is not None:
        return odometry, read_range_views(bag, config.views, config.body or odometry.body)
    if config.wrench is not None:
        return odometry, read_forces(bag, config.wrench)
    return odometry, None if config.touch is None else _read_touch(bag, config.touch)


def _sample_views(bag: Bag, odometry: Series, views: Series) -> tuple[Series, Series]:
    """Odometry at the times of the views, and the views within the odometry."""
    path = integrate(odometry.values[:, :3])
    poses, _ = interpolated_poses(views.time, odometry.time, path, "time", views.where)
    inside = (odometry.time[0] <= views.time) & (views.time <= odometry.time[-1])
    if not inside.any():
        raise no_overlap_error(views.time, odometry.time, "time", views.where)
    _report_unused(bag, views, ~inside, "outside the times of the odometry")
    columns = {name: getattr(views, name)[inside] for name in ("time", "values", "numbers")}
    views = views._replace(**columns)
    return odometry._replace(time=views.time, values=from_poses(views.time, poses[inside])), views


def _place_views(
    bag: Bag, source: dict[str, Any], views: Series, tolerance: float | None
) -> list[InputError]:
    """Gives each view to the nearest row of a source; of several for one row the nearest is used."""
    rows, away, reach = nearest_rows(views.time, source["time"], tolerance)
    near = away <= reach
    if not near.any():
        return [no_overlap_error(views.time, source["time"], "time", views.where)]
    _report_unused(bag, views, ~near, f"over {reach:.3g} s away from every sample")
    order = np.lexsort([away, rows])
    order = order[near[order]]
    first = np.concatenate([[True], np.diff(rows[order]) > 0])
    use = np.sort(order[first])
    beaten = near.copy()
    beaten[use] = False
    why = "farther from their sample than another (or set recording.topics.samples: views)"
    _report_unused(bag, views, beaten, why)
    source["views"][rows[use]], source["seen"][rows[use]] = views.values[use], True
    return []


def _report_unused(bag: Bag, views: Series, unused: np.ndarray, why: str) -> None:
    if unused.any():
        first = float(views.time[int(unused.argmax())])
        count = f"{int(unused.sum())} of {len(unused)} views, the first at {first:.3f} s"
        few = "note: " if unused.mean() <= SPOILT else ""
        bag.warn(f"{few}{views.where}: {count}, are {why}; they are left out")
