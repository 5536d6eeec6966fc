"""Ranges of LaserScan and PointCloud2 messages as sectors.

A beam is *measured* unless its range is NaN, -inf or below `range_min`. Of measured beams, +inf and ranges
above `range_max` mean that nothing was there. A sector is the mean of min(range, max_range) / max_range over
its measured beams; without any it is 1.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from robot.recordings.alignment import range_pixels
from robot.recordings.bags.transforms import Mount
from tactile.base.errors import InputError

SCAN, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
RING_BEAMS = 360  # of a cloud: the nearest point of each degree
POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy types of PointField.datatype."""


class RangeView(NamedTuple):
    """One view.

    Attributes:
        pixels: [P] in 0..1. lowest, typical: smallest and median range measured, m.
    """

    pixels: np.ndarray
    lowest: float
    typical: float


def scan_view(message: Any, mount: Mount, pixels: int, max_range: float, where: str) -> RangeView | None:
    """The sectors of a LaserScan; None if no beam was measured.

    A whole ring is cut by the direction of its beams in the frame of the robot, counter-clockwise from behind
    it. Any other scan is a fan, cut into groups of consecutive beams in the order of the message.

    Raises:
        InputError: the angles are not numbers, or there are fewer beams than pixels.
    """
    ranges, first, step = np.asarray(message.ranges, float), message.angle_min, message.angle_increment
    if not (np.isfinite(first) and np.isfinite(step) and step != 0):
        raise InputError(where, f"angle_min is {first} and angle_increment {step}", "angles in rad")
    if len(ranges) < pixels:
        raise InputError(where, f"{len(ranges)} beams", f"at least one for each of {pixels} sectors")
    low, high = scan_limits(message)
    measured = ~np.isnan(ranges) & (ranges >= low)
    ranges = np.where(ranges > high, np.inf, ranges)
    if is_ring(message):
        angles = first + step * np.arange(len(ranges))
        ahead = mount.rotation[:2, :2] @ np.stack([np.cos(angles), np.sin(angles)])
        turn = (np.arctan2(ahead[1], ahead[0]) + np.pi) / (2 * np.pi)  # from behind, of a whole turn
        sector = np.minimum((turn % 1.0 * pixels).astype(int), pixels - 1)
        return _view(ranges, measured, sector, pixels, max_range)
    return _fan_view(ranges, measured, pixels, max_range)


def scan_limits(message: Any) -> tuple[float, float]:
    """The range limits of a LaserScan, m; 0 and inf if those in the message cannot be meant."""
    low, high = float(message.range_min), float(message.range_max)
    return (low, high) if 0 <= low < high else (0.0, np.inf)


def is_ring(message: Any) -> bool:
    """Whether a LaserScan covers the whole turn."""
    return len(message.ranges) * abs(message.angle_increment) >= 2 * np.pi - 2 * abs(message.angle_increment)


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
    beams = np.full(RING_BEAMS, np.inf)
    degree = np.minimum((turn % 1.0 * RING_BEAMS).astype(int), RING_BEAMS - 1)
    np.minimum.at(beams, degree, np.hypot(points[:, 0], points[:, 1]))
    return _fan_view(beams, np.ones(RING_BEAMS, bool), pixels, max_range)


def cloud_points(message: Any, where: str) -> np.ndarray:
    """[N, 3] points of a PointCloud2 in the frame of the sensor, m.

    Raises:
        InputError: as `cloud_view`.
    """
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= fields.keys():
        raise InputError(where, f"a cloud of {', '.join(fields) or 'no fields'}", "fields x, y and z")
    order = ">" if message.is_bigendian else "<"
    data = np.asarray(message.data, np.uint8)
    step, row, height, width = message.point_step, message.row_step, message.height, message.width
    try:
        if height * width * step > len(data):
            raise ValueError("too few")
        kinds = [order + POINT_TYPES[fields[name].datatype] for name in "xyz"]
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
