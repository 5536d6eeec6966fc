"""Views of a bag: Image and CompressedImage messages in grey, LaserScan and PointCloud2 messages as sectors.

A beam is *measured* unless its range is NaN, -inf or below `range_min`. Of measured beams, +inf and ranges
above `range_max` mean that nothing was there. A sector is the mean of min(range, max_range) / max_range over
its measured beams; without any it is 1. Where a scan has no beams at all, sectors are
interpolated between the nearest ones that have some.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.alignment import range_errors, range_pixels
from robot.recordings.bags.bag import Bag, Messages, Series, Topic, as_series
from robot.recordings.bags.topics_config import ViewsTopic
from robot.recordings.bags.transforms import FORWARD, Mount, mount_of
from robot.recordings.video import Frame, ImageViewConfig, VisualOdometryConfig, camera_rows
from tactile.base.errors import InputError

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGES = (RAW, COMPRESSED)
LARGEST = 1 << 26  # pixels

_ENCODINGS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("mono8", "8UC1"), ("u1", "y")),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", "y")),
    **dict.fromkeys(("rgb8",), ("u1", "rgb")),
    **dict.fromkeys(("bgr8", "8UC3"), ("u1", "bgr")),
    **dict.fromkeys(("rgba8",), ("u1", "rgba")),
    **dict.fromkeys(("bgra8", "8UC4"), ("u1", "bgra")),
    **dict.fromkeys(("yuv422", "uyvy"), ("u1", "-y")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), ("u1", "y-")),
    **dict.fromkeys(("nv12", "nv21", "nv24"), ("u1", "y")),  # the other planes come after the grey one
    **{
        f"bayer_{order}{bits}": (f"u{bits // 8}", "y")
        for order in ("rggb", "bggr", "gbrg", "grbg")
        for bits in (8, 16)
    },
}
"""Encodings of raw images: NumPy type and channels."""
_NO_DEPTH = "name a topic of grey or colour images with recording.topics.views"


def grey_image(message: Any, kind: str, where: str) -> np.ndarray:
    """[H, W] uint8 of an image message of this type.

    Raises:
        InputError: the encoding is unknown, or the data are damaged.
    """
    if kind == COMPRESSED:
        return _decoded(message, where)
    if message.encoding in ("32FC1", "64FC1"):
        raise InputError(where, f"distances ({message.encoding})", "a grey or colour image", _NO_DEPTH)
    if message.encoding not in _ENCODINGS:
        raise InputError(where, f"encoding {message.encoding!r}", f"one of {', '.join(_ENCODINGS)}")
    number, channels = _ENCODINGS[message.encoding]
    stored = np.dtype((">" if message.is_bigendian else "<") + number)
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, np.uint8)
    length = width * len(channels) * stored.itemsize
    if not (0 < height * width <= LARGEST and length <= step and len(data) >= step * (height - 1) + length):
        found = f"{width} x {height} pixels of {message.encoding}, {step} bytes a row, in {len(data)} bytes"
        raise InputError(where, found, "data that fit their description")
    strides = (step, len(channels) * stored.itemsize, stored.itemsize)
    pixels = np.ndarray((height, width, len(channels)), stored, data.tobytes(), strides=strides)
    if channels == "y":
        grey = (pixels[..., 0] >> 8).astype(np.uint8) if stored.itemsize == 2 else pixels[..., 0].copy()
        if not message.encoding.startswith("bayer"):
            return grey
        # Means of each pixel and its right and lower neighbours, one of each colour of the Bayer filter.
        near = np.pad(grey.astype(np.uint16), ((0, 1), (0, 1)), "reflect" if min(grey.shape) > 1 else "edge")
        return ((near[:-1, :-1] + near[1:, :-1] + near[:-1, 1:] + near[1:, 1:] + 2) // 4).astype(np.uint8)
    luma = {"y": 1000, "r": 299, "g": 587, "b": 114}  # per mille (BT.601), as Pillow weighs them
    weights = np.array([luma.get(name, 0) for name in channels], np.int32)
    return ((pixels.astype(np.int32) @ weights + 500) // 1000).astype(np.uint8)


def _decoded(message: Any, where: str) -> np.ndarray:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise InputError("pillow", "not installed", "", "pip install 'ratslam[ros]'") from None
    if "compressedDepth" in message.format:
        raise InputError(where, f"distances ({message.format})", "a grey or colour image", _NO_DEPTH)
    data = bytes(message.data)
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "PNG", "WEBP")) as image:
            if image.width * image.height > LARGEST:
                raise InputError(where, f"{image.width} x {image.height} pixels", f"at most {LARGEST}")
            if image.mode.startswith("I"):  # 16 bits
                return (np.asarray(image).astype(np.int64) >> 8).clip(0, 255).astype(np.uint8)
            return np.asarray(image.convert("L"))
    except InputError:
        raise
    except UnidentifiedImageError:
        found = f"{len(data)} bytes of format {message.format!r}"
        raise InputError(where, found, "a JPEG, PNG or WebP image") from None
    except Exception as error:
        found = f"an image that cannot be decoded ({error})"
        raise InputError(where, found, "a JPEG, PNG or WebP image") from error


SCAN, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
_RING_BEAMS = 360  # of a cloud: the nearest point of each degree
COVERED = 0.5
"""Share of the sectors in which a view has beams, at least."""


class RangeView(NamedTuple):
    """One view. Attributes: pixels: [P] in 0..1. lowest, typical: smallest and median range measured, m.
    covered: share of the sectors in which the message has beams."""

    pixels: np.ndarray
    lowest: float
    typical: float
    covered: float = 1.0


class Extent(NamedTuple):
    """The directions that a scan covers, half a beam beyond the outer ones. Attributes: middle: rad. width:
    rad, negative for beams in clockwise order. step: rad between beams."""

    middle: float
    width: float
    step: float

    @property
    def ring(self) -> bool:
        """Whether it is the whole turn."""
        return bool(abs(self.width) >= 2 * np.pi - 2 * self.step)

    @property
    def span(self) -> tuple[float, float]:
        """The first and the last direction, rad; a ring is all around."""
        if self.ring:
            return -np.pi, np.pi
        return self.middle - self.width / 2, self.middle + self.width / 2

    def turned(self, mount: Mount, other: Mount) -> Extent:
        """As seen from a sensor with another mount."""
        turn = (other.rotation.T @ mount.rotation)[:2, :2]
        ahead = turn @ np.array([np.cos(self.middle), np.sin(self.middle)])
        flip = float(np.sign(np.linalg.det(turn)))
        return Extent(float(np.arctan2(ahead[1], ahead[0])), self.width * flip, self.step)


def extent_of(message: Any, where: str) -> Extent:
    """The extent of a LaserScan.

    Raises:
        InputError: the angles are not numbers, or there are no beams.
    """
    first, step, beams = float(message.angle_min), float(message.angle_increment), len(message.ranges)
    if not beams:
        raise InputError(where, "0 beams", "at least one")
    if not (np.isfinite(first) and np.isfinite(step) and step != 0):
        raise InputError(where, f"angle_min is {first} and angle_increment {step}", "angles in rad")
    return Extent(first + step * (beams - 1) / 2, step * beams, abs(step))


def wider_extent(extents: Sequence[Extent]) -> Extent | None:
    """What scans cover together, in the order of the first; None if that is no more than the first covers, or
    if most scans cover less than `COVERED` of it."""
    first = extents[0]
    if first.ring:
        return None
    middle, width, step = np.array(extents).T
    middle, half = _wrapped(middle - first.middle), np.abs(width) / 2
    low, high = float((middle - half).min()), float((middle + half).max())
    whole = 2 * np.pi if any(extent.ring for extent in extents) else min(high - low, 2 * np.pi)
    if whole <= abs(first.width) + 2 * first.step or np.median(np.abs(width)) < COVERED * whole:
        return None
    return Extent(first.middle + (low + high) / 2, float(np.copysign(whole, first.width)), float(step.max()))


def scan_view(
    message: Any,
    mount: Mount,
    pixels: int,
    max_range: float,
    where: str,
    shared: Extent | None = None,
    own: Extent | None = None,
) -> RangeView | None:
    """The sectors of a LaserScan; None if no beam was measured.

    A whole ring is cut by the direction of its beams in the frame of the robot, counter-clockwise from behind
    it. Any other scan is a fan, cut into groups of consecutive beams in the order of the message.

    Args:
        shared: the directions that are cut into sectors; None: those of the scan. If the scan has others, its
            beams go to sectors by their directions, in the order of `shared`.
        own: the directions of the scan, if `shared` is of another sensor.

    Raises:
        InputError: the angles are not numbers, or there are fewer beams than pixels.
    """
    ranges, own = np.asarray(message.ranges, float), own or extent_of(message, where)
    if shared is None and len(ranges) < pixels:
        raise InputError(where, f"{len(ranges)} beams", f"at least one for each of {pixels} sectors")
    shared = shared or own
    apart = abs(_wrapped(own.middle - shared.middle)) + abs(abs(own.width) - abs(shared.width)) / 2
    low, high = scan_limits(message)
    measured = ~np.isnan(ranges) & (ranges >= low)
    ranges = np.where(ranges > high, np.inf, ranges)
    if shared.ring:
        angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
        ahead = mount.rotation[:2, :2] @ np.stack([np.cos(angles), np.sin(angles)])
        at = (np.arctan2(ahead[1], ahead[0]) + np.pi) / (2 * np.pi) % 1.0  # from behind, of a whole turn
    elif apart <= 0.51 * max(own.step, shared.step) and len(ranges) >= pixels:  # the same outer beams
        order = slice(None, None, 1 if own.width * shared.width > 0 else -1)
        return _fan_view(ranges[order], measured[order], pixels, max_range)
    else:
        angles = own.middle + own.width * ((np.arange(len(ranges)) + 0.5) / len(ranges) - 0.5)
        at = _wrapped(angles - shared.middle) / shared.width + 0.5
    inside = (at >= 0) & (at < 1)
    sector = np.minimum((at * pixels).astype(int), pixels - 1)[inside]
    view = _view(ranges[inside], measured[inside], sector, pixels, max_range)
    there = np.flatnonzero(np.bincount(sector, minlength=pixels))
    if view is None or len(there) == pixels or own.ring:
        return view
    around = pixels if shared.ring else None
    filled = np.interp(np.arange(pixels), there, view.pixels[there], period=around)
    return view._replace(pixels=filled, covered=len(there) / pixels)


def _wrapped(angle: Any) -> Any:
    """In [-pi, pi), rad."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def scan_limits(message: Any) -> tuple[float, float]:
    """The range limits of a LaserScan, m; 0 and inf if those in the message cannot be meant."""
    low, high = float(message.range_min), float(message.range_max)
    return (low, high) if 0 <= low < high else (0.0, np.inf)


def cloud_view(
    message: Any, mount: Mount, heights: tuple[float, float], pixels: int, max_range: float, where: str
) -> RangeView | None:
    """The sectors of a PointCloud2, counter-clockwise from behind the robot; None without points.

    The nearest point of each degree, among those between two heights (m, frame of the robot), is a beam.

    Raises:
        InputError: the message has no x, y and z, or other data than it says.
    """
    points = cloud_points(message, where)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    points = points @ mount.rotation.T + mount.position
    points = points[(heights[0] <= points[:, 2]) & (points[:, 2] <= heights[1])]
    turn = (np.arctan2(points[:, 1], points[:, 0]) + np.pi) / (2 * np.pi)
    beams = np.full(_RING_BEAMS, np.inf)
    degree = np.minimum((turn % 1.0 * _RING_BEAMS).astype(int), _RING_BEAMS - 1)
    np.minimum.at(beams, degree, np.hypot(points[:, 0], points[:, 1]))
    return _fan_view(beams, np.ones(_RING_BEAMS, bool), pixels, max_range)


def cloud_points(message: Any, where: str) -> np.ndarray:
    """[N, 3] points of a PointCloud2 in the frame of the sensor, m."""
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= fields.keys():
        raise InputError(where, f"a cloud of {', '.join(fields) or 'no fields'}", "fields x, y and z")
    order = ">" if message.is_bigendian else "<"
    data = np.asarray(message.data, np.uint8)
    step, row, height, width = message.point_step, message.row_step, message.height, message.width
    try:
        if height * width * step > len(data):
            raise ValueError("too few")
        types = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), 1))  # PointField.datatype
        kinds = [order + types[fields[name].datatype] for name in "xyz"]
        offsets = [fields[name].offset for name in "xyz"]
        kind = np.dtype({"names": list("xyz"), "formats": kinds, "offsets": offsets, "itemsize": step})
        rows = np.ndarray((height, width), kind, data.tobytes(), strides=(row, step))
    except (KeyError, TypeError, ValueError) as error:
        found = f"{height} x {width} points of {step} bytes in {len(data)} bytes ({error})"
        raise InputError(where, found, "data that fit their description") from None
    return np.stack([rows[name].astype(float).reshape(-1) for name in "xyz"], axis=1)


def _fan_view(ranges: np.ndarray, measured: np.ndarray, pixels: int, max_range: float) -> RangeView | None:
    if len(ranges) % pixels:
        return _view(ranges, measured, np.arange(len(ranges)) * pixels // len(ranges), pixels, max_range)
    if not measured.any():
        return None
    values = range_pixels(ranges[None], pixels, max_range, measured[None])[0]
    return RangeView(values, *_extent(ranges[measured], max_range))


def _view(
    ranges: np.ndarray, measured: np.ndarray, sector: np.ndarray, pixels: int, max_range: float
) -> RangeView | None:
    """The view of beams of which each belongs to a sector [B]."""
    if not measured.any():
        return None
    near = np.minimum(ranges[measured], max_range)
    total = np.bincount(sector[measured], near, pixels)
    count = np.bincount(sector[measured], minlength=pixels)
    values = np.where(count > 0, total / np.maximum(count, 1) / max_range, 1.0)
    return RangeView(np.minimum(values, 1.0), *_extent(ranges[measured], max_range))


def _extent(ranges: np.ndarray, max_range: float) -> tuple[float, float]:
    """The smallest and the median range, m, where nothing in range counts as `max_range`."""
    ranges = np.where(np.isinf(ranges), max_range, ranges)
    return float(ranges.min()), float(np.median(ranges))


KEY = "recording.topics.views"
LONGEST = 8.0  # m: of indoor scans, most show something nearer


def read_range_views(bag: Bag, config: ViewsTopic, body: str) -> Series:
    """Views [M, R, C, 1] of a topic of scans or clouds; for images see `read_image_views`.

    Args:
        body: frame of the robot; '' if unknown.

    Raises:
        InputError: the messages are of another type, or do not fit the settings.
    """
    topic = bag.topic(config.topic, KEY, (SCAN, CLOUD, *IMAGES))
    where = f"{bag.path}, {topic.name}"
    reader = RangeReader(bag, topic.kind, config, body)
    read = list(bag.stamped(topic, reader.view))
    rows = [row for row in read if row[2] is not None and row[2].covered >= COVERED]
    empty = sum(view is None for *_, view in read)
    few = len(read) - len(rows) - empty
    for count, fault in ((empty, "have no measured range"), (few, "cover less than half of the sectors")):
        if count:
            bag.warn(f"{where}: {count} of {topic.total} messages {fault} and are no views")
    if wider := reader.wider_span():
        cure = f"--set {KEY}.span=[{wider[0]:.4f},{wider[1]:.4f}]"
        bag.warn(f"{where}: the scans vary in direction; views have those of the first scan only; {cure}")
    numbers, stamps, found = [row[0] for row in rows], [row[1] for row in rows], [row[2] for row in rows]
    pixels = np.array([view.pixels for view in found]).reshape(-1, config.rows, config.columns, 1)
    series = as_series(bag, where, numbers, stamps, pixels)
    lowest, typical = np.array([(view.lowest, view.typical) for view in found]).T
    place, key = (lambda row: f"{where}, message {numbers[row]}"), f"{KEY}.max_range"
    reach = reader.reach or LONGEST
    errors = range_errors(lowest, float(np.median(typical)), reach, "a range", place, where, key)
    return series._replace(errors=series.errors + errors)


def read_image_views(
    bag: Bag, topic: Topic, image: ImageViewConfig, visual_odometry: VisualOdometryConfig | None
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
        for number, stamp, grey in bag.stamped(topic, image_of):
            numbers.append(number)
            stamps.append(stamp)
            yield stamp / 10**9, grey

    _, view, motion = camera_rows(frames(), image, visual_odometry, where)
    views = as_series(bag, where, numbers, stamps, view)
    return views, None if motion is None else motion[np.isin(numbers, views.numbers)]


class RangeReader:
    """Views of the messages of a topic; what the settings leave open is as in the first message.

    Args:
        bag: of the transforms. kind: type of the messages. body: frame of the robot; '' if unknown.

    Attributes:
        reach: range that becomes 1, m.
    """

    def __init__(self, bag: Messages, kind: str, config: ViewsTopic, body: str) -> None:
        self._bag, self._kind, self._config, self._body = bag, kind, config, body
        self.reach = config.max_range
        self._mounts = dict[str, Mount]()
        self._first = ""  # frame of the first scan
        self._shared: Extent | None = None  # directions of the sectors
        self._extents = list[Extent]()

    def view(self, content: Any, place: str) -> RangeView | None:
        """As `scan_view` and `cloud_view`."""
        config, sensor = self._config, content.header.frame_id
        longest = scan_limits(content)[1] if self._kind == SCAN else LONGEST
        reach = self.reach or min(longest, LONGEST)
        pixels = config.rows * config.columns
        if self._kind == CLOUD:
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
                mount = mount_of(self._bag, self._body, sensor)
            if mount is None:
                frames = f"from {self._body or 'the robot'} to {sensor or 'the sensor'}"
                cure = f"the sensor is taken to look ahead (else --set {KEY}.yaw=ANGLE)"
                self._bag.warn(f"{self._bag.path}: no transform {frames} in /tf_static; {cure}")
            self._mounts[sensor] = mount or FORWARD
        return self._mounts[sensor]
