"""What two maps have in common, and what differs."""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from ratslam.mapping.map import KeyframeMap
from tactile.base.se2 import compose, fit_rigid_motion, wrap


class MapContent(NamedTuple):
    """What of a map is compared.

    Attributes:
        poses: [N, 3] of its N places (keyframes, or steps): x m, y m, heading rad. names: [N] of the places;
            equal names in two maps are the same place. closures: [M, 2] places joined by accepted closures.
    """

    poses: np.ndarray
    names: list[bytes]
    closures: np.ndarray


class Difference(NamedTuple):
    """The difference between two maps.

    Attributes:
        common: places in both. removed, added: places only in the first, only in the second.
        closures_common, closures_removed, closures_added: the same of closures.
        moved_max, moved_rms: m, distance of common places after the second map was moved as a whole so that
            they lie closest. turned_max, turned_rms: rad, difference of their headings. All are NaN without
            common places.
    """

    common: int
    removed: int
    added: int
    closures_common: int
    closures_removed: int
    closures_added: int
    moved_max: float
    moved_rms: float
    turned_max: float
    turned_rms: float


def keyframe_content(map: KeyframeMap) -> MapContent:
    """The content of a keyframe map: a keyframe is known by its view and by the odometry into it."""
    graph, solution = map.keyframes(), map.solution()
    views, labels = map.appearance.stored(np.arange(graph.count))
    odometry = np.column_stack([graph.motion.rows, graph.length.rows, graph.turn.rows])
    rows = zip(odometry, np.asarray(views), labels, strict=True)
    names = [motion.tobytes() + view.tobytes() + label.tobytes() for motion, view, label in rows]
    closures = solution.log.table()[solution.log.accepted_rows(), :2].astype(int)
    return MapContent(solution.fit.poses, names, closures)


def difference(first: MapContent, second: MapContent) -> Difference:
    """What differs between two maps."""
    # Numbers of the common places in both; of places with one name, in order.
    places: dict[bytes, list[int]] = defaultdict(list)
    for number in range(len(second.names) - 1, -1, -1):
        places[second.names[number]].append(number)
    pairs = [(number, places[name].pop()) for number, name in enumerate(first.names) if places.get(name)]
    a, b = np.array([a for a, _ in pairs], int), np.array([b for _, b in pairs], int)
    before, after = _pairs(first.closures, a, len(first.names)), _pairs(second.closures, b, len(second.names))
    closures = len(before & after)
    moved = turned = np.zeros(0)
    if len(a):  # distances, m, and differences of heading, rad, after a motion of the second map as a whole
        apart = compose(fit_rigid_motion(second.poses[b], first.poses[a]), second.poses[b]) - first.poses[a]
        moved, turned = np.hypot(apart[:, 0], apart[:, 1]), np.abs(wrap(apart[:, 2]))
    return Difference(
        len(a),
        len(first.names) - len(a),
        len(second.names) - len(b),
        closures,
        len(first.closures) - closures,
        len(second.closures) - closures,
        *_largest(moved),
        *_largest(turned),
    )


def _pairs(closures: np.ndarray, common: np.ndarray, count: int) -> set[tuple[int, int]]:
    """The closures between common places, by their numbers among these."""
    number = np.full(count, -1)
    number[common] = np.arange(len(common))
    return {(i, j) for i, j in number[closures.astype(int)].reshape(-1, 2).tolist() if min(i, j) >= 0}


def _largest(values: np.ndarray) -> tuple[float, float]:
    """The largest of values [n] and their root mean square."""
    if not len(values):
        return np.nan, np.nan
    return float(values.max()), float(np.sqrt((values**2).mean()))
