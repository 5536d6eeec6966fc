"""Polygons in the plane, walls as boxes, and the first contact of whiskers of the UR-10 head with walls.

A whisker swings in a vertical plane through the axis of the head, from outside down and inwards. It first
touches the top of a box with its tip, or the far upper edge with its shaft. A box nearer to the axis than the
whisker's base is touched beyond the vertical, by the tip on the far face. Contacts are in closed form.

A polygon is [N, 2] corners in order, m, implicitly closed; a segment is a row x1, y1, x2, y2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.whisker_geometry import Head

BUCKET_SIDE = 0.18
"""Side length of the squares of the box index, m."""
NO_CONTACT = np.inf
"""Protraction of a whisker without contact."""


class Walls(NamedTuple):
    """Axis-aligned boxes on the floor.

    Attributes:
        box: [B, 4] west, south, east, north, m. height: [B] m.
    """

    box: np.ndarray
    height: np.ndarray


class Contact(NamedTuple):
    """First contacts of whiskers.

    Attributes:
        angle: [P, W] protraction, rad; infinite without contact.
        reach: [P, W] contact position along the shaft, as a fraction of its length; 1 at the tip.
        wall: [P, W] index of the box, -1 without contact.
    """

    angle: np.ndarray
    reach: np.ndarray
    wall: np.ndarray


class Surroundings:
    """Walls with an index for repeated contact queries.

    Args:
        head: all whisker planes must contain the vertical axis of base_link.

    Attributes:
        radius: [W] m, of the bases from that axis. outwards: [W, 2] directions of the planes. opening: [W]
            rad, of the whiskers at rest from straight down.
    """

    def __init__(self, walls: Walls, head: Head) -> None:
        self.walls, self.head = walls, head
        self.radius = np.hypot(head.base[:, 0], head.base[:, 1])
        self.outwards = head.rest[:, :2] / np.linalg.norm(head.rest[:, :2], axis=1, keepdims=True)
        self.opening = np.arctan2(np.hypot(head.rest[:, 0], head.rest[:, 1]), -head.rest[:, 2])
        self._range = float((self.radius + head.length).max())
        azimuth = np.arctan2(self.outwards[:, 1], self.outwards[:, 0])
        self._rays, self._ray = np.unique(np.round(azimuth, 12), return_inverse=True)
        self._near: dict[tuple[int, int], np.ndarray] = {}

    def contact(self, pose: np.ndarray) -> Contact:
        """First contacts of all whiskers of a resting head at poses [P, 3] (m, m, rad)."""
        pose = np.asarray(pose, float)
        count, whiskers = len(pose), len(self.radius)
        angle = np.full((count, whiskers), NO_CONTACT)
        reach, wall = np.zeros((count, whiskers)), np.full((count, whiskers), -1)
        buckets = np.floor(pose[:, :2] / BUCKET_SIDE).astype(int)
        places, place = np.unique(buckets, axis=0, return_inverse=True)
        for k, (i, j) in enumerate(places.tolist()):
            near, rows = self._nearby_boxes(i, j), np.flatnonzero(place.reshape(-1) == k)
            if len(near):
                angle[rows], reach[rows], wall[rows] = self._first_contacts(pose[rows], near)
        return Contact(angle, reach, wall)

    def _nearby_boxes(self, i: int, j: int) -> np.ndarray:
        """Boxes within range of any point of an index square."""
        if (i, j) not in self._near:
            low = np.array([i, j]) * BUCKET_SIDE - self._range
            high = np.array([i + 1, j + 1]) * BUCKET_SIDE + self._range
            box = self.walls.box
            inside = (box[:, 0] <= high[0]) & (box[:, 2] >= low[0])
            inside &= (box[:, 1] <= high[1]) & (box[:, 3] >= low[1])
            self._near[i, j] = np.flatnonzero(inside)
        return self._near[i, j]

    def _first_contacts(self, pose: np.ndarray, near: np.ndarray) -> Contact:
        """First contacts with the boxes `near` [B]."""
        enter, leave = self._crossings(pose, self.walls.box[near])  # [P, A, B]
        met = np.full((len(pose), len(self.radius)), NO_CONTACT)
        reach, wall = np.zeros(met.shape), np.full(met.shape, -1)
        row, ray, box = np.nonzero((leave > enter) & (leave > 0) & (enter < self._range))
        d1, d2, top = enter[row, ray, box], leave[row, ray, box], self.walls.height[near[box]]
        # A box crossed by a ray is within the plane of every whisker in that direction.
        crossing, whisker = np.nonzero(ray[:, None] == self._ray)
        row, box = row[crossing], box[crossing]
        angle, share = self._touch_from_above(whisker, d1[crossing], d2[crossing], top[crossing])
        # Of several boxes the first contact counts: the smallest protraction, which is written last.
        order = np.argsort(-angle, kind="stable")
        place = row[order], whisker[order]
        met[place], reach[place], wall[place] = angle[order], share[order], near[box[order]]
        free = ~np.isfinite(met)
        reach[free], wall[free] = 0.0, -1
        return Contact(met, reach, wall)

    def _crossings(self, pose: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances [P, A, B] at which each ray of each pose enters and leaves each box."""
        heading = pose[:, 2:3] + self._rays
        far = []
        for axis, direction in enumerate((np.cos(heading), np.sin(heading))):
            direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)[:, :, None]
            edges = [(box[:, k] - pose[:, axis, None])[:, None] / direction for k in (axis, axis + 2)]
            far.append((np.minimum(*edges), np.maximum(*edges)))
        return np.maximum(far[0][0], far[1][0]), np.minimum(far[0][1], far[1][1])

    def _touch_from_above(
        self, w: np.ndarray, d1: np.ndarray, d2: np.ndarray, top: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Protraction at which whiskers w [N] touch boxes d1 to d2 m away, and the position along the
        shaft."""
        radius, length, rest = self.radius[w], self.head.length[w], self.opening[w]
        drop = self.head.base[w, 2] - top
        # Distance of the tip from the axis when it is as high as the top of the box.
        opening = np.arccos(np.clip(drop / length, -1, 1))
        out = radius + length * np.sin(opening)
        low = np.abs(drop) <= length
        by_tip = low & (out >= d1) & (out <= d2)
        edge = np.hypot(drop, d2 - radius)
        by_edge = (low & (out > d2)) & (edge <= length)
        # A head below the tops, or above a box, is in contact at protraction 0.
        over = np.arctan2(d2 - radius, drop)
        # Beyond the vertical the tip touches the far face below that edge.
        inside = d2 < radius
        over = np.where(inside, np.arcsin(np.clip((d2 - radius) / length, -1, 1)), over)
        found = np.where(by_tip, opening, np.where(by_edge, over, -np.inf))
        share = np.where(by_tip | inside, 1.0, edge / length)
        angle = np.where(found > -np.inf, np.maximum(rest - found, 0.0), NO_CONTACT)
        return angle, np.where(np.isfinite(angle), np.clip(share, 0, 1), 0.0)


def polygon_edges(polygon: np.ndarray) -> np.ndarray:
    """The sides [N, 4] of a polygon."""
    return np.hstack([polygon, np.roll(polygon, -1, axis=0)])


def polygon_area(polygon: np.ndarray) -> float:
    """Area of a polygon, m^2; positive if its corners are in counter-clockwise order."""
    x, y = polygon.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def polygon_contains(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[...] bool, whether points [..., 2] are inside, by the number of sides to their right."""
    points = np.asarray(points, np.float64)[..., None, :]
    x1, y1, x2, y2 = polygon_edges(polygon).T
    x, y = points[..., 0], points[..., 1]
    spans = (y1 > y) != (y2 > y)
    run = np.where(y2 == y1, 1.0, y2 - y1)  # avoids a division by 0; a horizontal side spans no height
    right = x < x1 + (y - y1) * (x2 - x1) / run
    return np.logical_xor.reduce(spans & right, axis=-1)


def segment_distance(segments: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances [..., S] from points [..., 2] to segments [S, 4], m."""
    points = np.asarray(points, np.float64)[..., None, :]
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    away = points - start
    square = np.maximum((along**2).sum(axis=-1), 1e-300)
    share = np.clip((away * along).sum(axis=-1) / square, 0.0, 1.0)
    return np.linalg.norm(away - share[..., None] * along, axis=-1)


def segments_cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[S, R] bool, whether segments [S, 4] and [R, 4] cross; touching does not count."""

    def side(segments: np.ndarray, points: np.ndarray) -> np.ndarray:
        start, along = segments[:, None, :2], segments[:, None, 2:] - segments[:, None, :2]
        away = points[None] - start
        turned = along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0]
        size = np.linalg.norm(along, axis=-1) * np.maximum(np.linalg.norm(away, axis=-1), 1e-300)
        return np.sign(np.where(np.abs(turned) > 1e-9 * size, turned, 0.0))

    there = side(one, other[:, :2]) * side(one, other[:, 2:]) < 0
    back = side(other, one[:, :2]) * side(other, one[:, 2:]) < 0
    return there & back.T


def polygon_gap(one: np.ndarray, other: np.ndarray) -> float:
    """Distance between the outlines of two polygons, m; 0 if they cross or touch."""
    sides, others = polygon_edges(one), polygon_edges(other)
    if segments_cross(sides, others).any():
        return 0.0
    return float(min(segment_distance(sides, other).min(), segment_distance(others, one).min()))


def square(centre: np.ndarray, side: float, angle: float) -> np.ndarray:
    """Corners [4, 2] of a square that is rotated by an angle (rad)."""
    corner = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * side / 2
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(centre, np.float64) + corner @ np.array([[c, s], [-s, c]])
