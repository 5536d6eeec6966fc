"""Views of a bag from scans, clouds and images."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from robot.recordings.alignment import range_errors
from robot.recordings.bags.bag import Bag, Topic
from robot.recordings.bags.images import IMAGES, grey_image
from robot.recordings.bags.scans import (
    CLOUD,
    COVERED,
    SCAN,
    Extent,
    RangeView,
    cloud_view,
    extent_of,
    scan_limits,
    scan_view,
    wider_extent,
)
from robot.recordings.bags.stamps import Clock, Report, Series, as_series, read_usable
from robot.recordings.bags.topics_config import ViewsTopic
from robot.recordings.bags.transforms import FORWARD, Mount, mount_of
from robot.recordings.camera.image_view import ImageViewConfig
from robot.recordings.camera.rows import Frame, camera_rows
from robot.recordings.camera.visual_odometry import VisualOdometryConfig
from tactile.base.errors import InputError

KEY = "recording.topics.views"
LONGEST = 8.0  # m: of indoor scans, most show something nearer


def read_range_views(bag: Bag, config: ViewsTopic, body: str, clock: Clock, report: Report) -> Series:
    """Views [M, R, C, 1] of a topic of scans or clouds.

    Args:
        body: frame of the robot; '' if unknown.

    Raises:
        InputError: the messages are of another type, or do not fit the settings.
    """
    topic = bag.topic(config.topic, KEY)
    where = f"{bag.path}, {topic.name}"
    if topic.kind not in (SCAN, CLOUD):
        expected = f"one of {', '.join((SCAN, CLOUD, *IMAGES))}"
        raise InputError(where, f"messages of type {topic.kind}", expected)
    reader = _RangeReader(bag, topic, config, body, clock)
    read = list(read_usable(bag, topic, clock, reader.view))
    rows = [row for row in read if row[2] is not None and row[2].covered >= COVERED]
    empty = sum(view is None for *_, view in read)
    for count, fault in (
        (empty, "have no measured range"),
        (len(read) - len(rows) - empty, "cover less than half of the sectors"),
    ):
        if count:
            report(f"{where}: {count} of {topic.total} messages {fault} and are no views")
    if wider := reader.wider_span():
        cure = f"--set {KEY}.span=[{wider[0]:.4f},{wider[1]:.4f}]"
        report(f"{where}: the scans vary in direction; views have those of the first scan only; {cure}")
    numbers, stamps, found = [row[0] for row in rows], [row[1] for row in rows], [row[2] for row in rows]
    pixels = np.array([view.pixels for view in found]).reshape(-1, config.rows, config.columns, 1)
    series = as_series(where, numbers, stamps, pixels, clock, report)
    lowest, typical = np.array([(view.lowest, view.typical) for view in found]).T
    place, key = (lambda row: f"{where}, message {numbers[row]}"), f"{KEY}.max_range"
    reach = reader.reach or LONGEST
    errors = range_errors(lowest, float(np.median(typical)), reach, "a range", place, where, key)
    return series._replace(errors=series.errors + errors)


def read_image_views(
    bag: Bag,
    topic: Topic,
    image: ImageViewConfig,
    visual_odometry: VisualOdometryConfig | None,
    clock: Clock,
    report: Report,
) -> tuple[Series, np.ndarray | None]:
    """Views [M, R, C, 1] of a topic of images, and motions [M, 4] of visual odometry where it is configured;
    one image in memory at a time.

    Raises:
        InputError: an image cannot be decoded, or does not fit the settings.
    """
    where = f"{bag.path}, {topic.name}"
    numbers, stamps, sizes = list[int](), list[int](), list[tuple[int, ...]]()

    def image_of(content: Any, place: str) -> np.ndarray:
        grey = grey_image(content, topic.kind, place)
        sizes.append(grey.shape)
        if grey.shape != sizes[0]:
            found = f"{grey.shape[1]} x {grey.shape[0]} pixels"
            raise InputError(place, found, f"{sizes[0][1]} x {sizes[0][0]}, as in the first image")
        return grey

    def frames() -> Iterator[Frame]:
        for number, stamp, grey in read_usable(bag, topic, clock, image_of):
            numbers.append(number)
            stamps.append(stamp)
            yield Frame(stamp / 10**9, grey)

    rows = camera_rows(frames(), image, visual_odometry, where)
    views = as_series(where, numbers, stamps, rows.view, clock, report)
    motion = None if rows.motion is None else rows.motion[np.isin(numbers, views.numbers)]
    return views, motion


class _RangeReader:
    """Views of the messages of a topic; what the settings leave open is as in the first message.

    Attributes:
        reach: range that becomes 1, m.
    """

    def __init__(self, bag: Bag, topic: Topic, config: ViewsTopic, body: str, clock: Clock) -> None:
        self._bag, self._topic, self._config, self._body, self._clock = bag, topic, config, body, clock
        self.reach = config.max_range
        self._mounts = dict[str, Mount]()
        self._first = ""  # frame of the first scan
        self._shared: Extent | None = None  # directions of the sectors
        self._extents = list[Extent]()

    def view(self, content: Any, place: str) -> RangeView | None:
        """As `scan_view` and `cloud_view`."""
        config, sensor = self._config, content.header.frame_id
        longest = scan_limits(content)[1] if self._topic.kind == SCAN else LONGEST
        reach = self.reach or min(longest, LONGEST)
        pixels = config.rows * config.columns
        if self._topic.kind == CLOUD:
            view = cloud_view(content, self._mount(sensor), config.heights, pixels, reach, place)
        else:
            own, first = extent_of(content, place), sensor if self._shared is None else self._first
            if sensor != first:
                own = own.turned(self._mount(sensor), self._mount(first))
            shared = self._shared
            if shared is None and config.span is not None:
                shared = Extent(sum(config.span) / 2, config.span[1] - config.span[0], own.step)
            mount = self._mount(sensor) if (shared or own).ring else FORWARD
            view = scan_view(content, mount, pixels, reach, place, shared, own)
            self._first, self._shared = first, shared or own
            self._extents.append(own)
        self.reach = reach
        return view

    def wider_span(self) -> tuple[float, float] | None:
        """The directions of all scans, if the setting is missing and the first scan covers less."""
        known = self._config.span is not None or not self._extents
        wider = None if known else wider_extent(self._extents)
        return None if wider is None else wider.span

    def _mount(self, sensor: str) -> Mount:
        """The mount of a sensor's frame; one that is unknown is reported."""
        if sensor not in self._mounts:
            yaw, mount = self._config.yaw, None
            if yaw is not None:
                c, s = np.cos(yaw), np.sin(yaw)
                mount = Mount(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
            elif sensor:
                mount = mount_of(self._bag, self._body, sensor, self._clock)
            if mount is None:
                frames = f"from {self._body or 'the robot'} to {sensor or 'the sensor'}"
                cure = f"the sensor is taken to look ahead (else --set {KEY}.yaw=ANGLE)"
                self._bag.warn(f"{self._bag.path}: no transform {frames} in /tf_static; {cure}")
            self._mounts[sensor] = mount or FORWARD
        return self._mounts[sensor]
