"""Ranges of LaserScan and PointCloud2 messages as sectors.

A beam is *measured* unless its range is NaN, -inf or below `range_min`. Of measured beams, +inf and ranges
above `range_max` mean that nothing was there. A sector is the mean of min(range, max_range) / max_range over
its measured beams; without any it is 1. Where a scan has no beams at all, sectors are
interpolated between the nearest ones that have some.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.alignment import range_pixels
from robot.recordings.bags.transforms import Mount
from tactile.base.errors import InputError

SCAN, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
RING_BEAMS = 360  # of a cloud: the nearest point of each degree
POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy types of PointField.datatype."""
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
