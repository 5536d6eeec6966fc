"""What two maps have in common, and what differs."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from ratslam.mapping.map import KeyframeMap
from tactile.base.se2 import compose, fit_rigid_motion, wrap

MapContent = tuple[np.ndarray, list[bytes], np.ndarray]
"""What of a map is compared: poses [N, 3] of its N places (keyframes, or steps), x m, y m, heading rad; names
[N] of the places, of which equal ones in two maps are the same place; closures [M, 2], places joined by
accepted ones."""


def keyframe_content(map: KeyframeMap) -> MapContent:
    """The content of a keyframe map: a keyframe is known by its view and by the odometry into it."""
    graph, solution = map.keyframes(), map.solution()
    views, labels = map.appearance.stored(np.arange(graph.count))
    odometry = np.column_stack([graph.motion.rows, graph.length.rows, graph.turn.rows])
    rows = zip(odometry, np.asarray(views), labels, strict=True)
    names = [motion.tobytes() + view.tobytes() + label.tobytes() for motion, view, label in rows]
    closures = solution.log.table()[solution.log.accepted_rows(), :2].astype(int)
    return solution.fit.poses, names, closures


def difference(first: MapContent, second: MapContent) -> dict[str, float]:
    """What differs between two maps.

    Returns:
        common: places in both. removed, added: places only in the first, only in the second.
        closures_common, closures_removed, closures_added: the same of closures.
        moved_max, moved_rms: m, distance of common places after the second map was moved as a whole so that
        they lie closest. turned_max, turned_rms: rad, difference of their headings. All are NaN without
        common places.
    """
    (one, names, first_closures), (other, other_names, second_closures) = first, second
    # Numbers of the common places in both; of places with one name, in order.
    places: dict[bytes, list[int]] = defaultdict(list)
    for number in range(len(other_names) - 1, -1, -1):
        places[other_names[number]].append(number)
    pairs = [(number, places[name].pop()) for number, name in enumerate(names) if places.get(name)]
    a, b = np.array([a for a, _ in pairs], int), np.array([b for _, b in pairs], int)
    before, after = _pairs(first_closures, a, len(names)), _pairs(second_closures, b, len(other_names))
    closures = len(before & after)
    moved = turned = np.zeros(0)
    if len(a):  # distances, m, and differences of heading, rad, after a motion of the second map as a whole
        apart = compose(fit_rigid_motion(other[b], one[a]), other[b]) - one[a]
        moved, turned = np.hypot(apart[:, 0], apart[:, 1]), np.abs(wrap(apart[:, 2]))
    found: dict[str, float] = {
        "common": len(a),
        "removed": len(names) - len(a),
        "added": len(other_names) - len(b),
        "closures_common": closures,
        "closures_removed": len(first_closures) - closures,
        "closures_added": len(second_closures) - closures,
    }
    for name, values in (("moved", moved), ("turned", turned)):
        found[f"{name}_max"] = float(values.max()) if len(a) else np.nan
        found[f"{name}_rms"] = float(np.sqrt((values**2).mean())) if len(a) else np.nan
    return found


def _pairs(closures: np.ndarray, common: np.ndarray, count: int) -> set[tuple[int, int]]:
    """The closures between common places, by their numbers among these."""
    number = np.full(count, -1)
    number[common] = np.arange(len(common))
    return {(i, j) for i, j in number[closures.astype(int)].reshape(-1, 2).tolist() if min(i, j) >= 0}
