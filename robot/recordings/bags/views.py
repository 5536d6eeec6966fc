"""Views of a bag from scans, clouds and images."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.alignment import range_errors
from robot.recordings.bags.bag import Bag, Topic
from robot.recordings.bags.config import ViewsTopic
from robot.recordings.bags.images import IMAGES, grey_image
from robot.recordings.bags.scans import CLOUD, SCAN, RangeView, cloud_view, is_ring, scan_limits, scan_view
from robot.recordings.bags.stamps import Clock, Report, Series, as_series, read_messages
from robot.recordings.bags.transforms import Mount, mount_of
from robot.recordings.camera.image_view import ImageViewConfig
from robot.recordings.camera.rows import Frame, camera_rows
from robot.recordings.camera.visual_odometry import VisualOdometryConfig
from tactile.base.errors import InputError

KEY = "recording.topics.views"
LONGEST = 8.0  # m: of indoor scans, most show something nearer


class BagImages(NamedTuple):
    """Views of a camera.

    Attributes:
        views: [M, R, C, 1] over time. motion: [M, 4] visual odometry, or None.
    """

    views: Series
    motion: np.ndarray | None


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
    numbers, stamps, found = list[int](), list[int](), list[RangeView]()
    mount, reach, empty = None, config.max_range, 0
    for number, stamp, content in read_messages(bag, topic, clock):
        place = f"{where}, message {number}"
        mount = mount or _mount(bag, config, body, content, clock, report)
        reach = reach or _reach(content)
        view = _range_view(topic, content, mount, config, reach, place)
        if view is None:
            empty += 1
            continue
        found.append(view)
        numbers.append(number)
        stamps.append(stamp)
    if empty:
        report(f"{where}: {empty} of {topic.total} messages have no measured range and are no views")
    pixels = np.array([view.pixels for view in found]).reshape(-1, config.rows, config.columns, 1)
    series = as_series(where, numbers, stamps, pixels, clock, report)
    lowest, typical = (np.array([getattr(view, name) for view in found]) for name in ("lowest", "typical"))
    errors = range_errors(
        lowest,
        float(np.median(typical)),
        reach or LONGEST,
        "a range",
        lambda row: f"{where}, message {numbers[row]}",
        where,
        f"{KEY}.max_range",
    )
    return series._replace(errors=series.errors + errors)


def read_image_views(
    bag: Bag,
    topic: Topic,
    image: ImageViewConfig,
    visual_odometry: VisualOdometryConfig | None,
    clock: Clock,
    report: Report,
) -> BagImages:
    """Views of a topic of images, and visual odometry where it is configured; one image in memory at a time.

    Raises:
        InputError: an image cannot be decoded, or does not fit the settings.
    """
    where = f"{bag.path}, {topic.name}"
    numbers, stamps = list[int](), list[int]()

    def frames() -> Iterator[Frame]:
        for number, stamp, content in read_messages(bag, topic, clock):
            numbers.append(number)
            stamps.append(stamp)
            yield Frame(stamp / 10**9, grey_image(content, topic.kind, f"{where}, message {number}"))

    rows = camera_rows(frames(), image, visual_odometry, where)
    views = as_series(where, numbers, stamps, rows.view, clock, report)
    motion = None if rows.motion is None else rows.motion[np.isin(numbers, views.numbers)]
    return BagImages(views, motion)


def _range_view(
    topic: Topic, content: Any, mount: Mount, config: ViewsTopic, reach: float, place: str
) -> RangeView | None:
    pixels = config.rows * config.columns
    if topic.kind == SCAN:
        return scan_view(content, mount, pixels, reach, place)
    return cloud_view(content, mount, config.heights, pixels, reach, place)


def _mount(bag: Bag, config: ViewsTopic, body: str, content: Any, clock: Clock, report: Report) -> Mount:
    """The mount of the sensor of a message; that of a whole ring must be known or is reported."""
    if config.yaw is not None:
        c, s = np.cos(config.yaw), np.sin(config.yaw)
        return Mount(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    sensor = content.header.frame_id
    mount = mount_of(bag, body, sensor, clock) if sensor else None
    if mount is not None:
        return mount
    if not hasattr(content, "ranges") or is_ring(content):
        frames = f"from {body or 'the robot'} to {sensor or 'the sensor'}"
        cure = f"the sensor is taken to look ahead (else set {KEY}.yaw)"
        report(f"{bag.path}: no transform {frames} in /tf_static; {cure}")
    return Mount(np.eye(3), np.zeros(3))


def _reach(content: Any) -> float:
    """The range that becomes 1 where none is given, m."""
    return min(scan_limits(content)[1], LONGEST) if hasattr(content, "ranges") else LONGEST
