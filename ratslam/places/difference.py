"""What two maps have in common, and what differs.

A keyframe is known by its view and its odometry: keyframes that are equal to the bit in two maps are the
same. `overlap` finds the sessions that both hold, `difference` compares the places and closures of both.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from hashlib import blake2b

import numpy as np

from ratslam.mapping.map import KeyframeMap
from tactile.base.se2 import compose, fit_rigid_motion, wrap

MapContent = tuple[np.ndarray, list[bytes], np.ndarray]
"""What of a map is compared: poses [N, 3] of its N places (keyframes, or steps), x m, y m, heading rad; names
[N] of the places, of which equal ones in two maps are the same place; closures [M, 2], places joined by
accepted ones."""


def keyframe_content(map: KeyframeMap) -> MapContent:
    """The content of a keyframe map: a keyframe is known by its view and by the odometry into it."""
    solution = map.solution()
    names = _contents(map, solution.motion.rows, solution.length.rows, solution.turn.rows)
    closures = solution.log.table()[solution.log.accepted_rows(), :2].astype(int)
    return solution.pose.rows, names, closures


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


def _contents(map: KeyframeMap, *odometry: np.ndarray) -> list[bytes]:
    """[N] the bytes of odometry [N, ...], view and place label of each keyframe."""
    views, labels = map.appearance.stored(np.arange(map.state.total))
    rows = zip(np.column_stack(odometry), np.asarray(views), labels, strict=True)
    return [motion.tobytes() + view.tobytes() + label.tobytes() for motion, view, label in rows]


LEAST = 8
"""Number of different keyframes, equally far apart in both maps, from which on they are those of one session:
rows of coarse odometry and of views without contact may be equal by chance, but not in one order."""


Span = tuple[int, int]

Remembered = tuple[dict[bytes, int], np.ndarray]
"""The keyframes of a map, to be found again in other maps: the number of the first keyframe of each name,
where equal names are equal keyframes; and the steps [N] at which the keyframes were taken."""


def remembered(map: KeyframeMap) -> Remembered:
    """The keyframes of a map. They are named by view, place label, distance and turn by odometry, which stay
    as they are when a map is continued, corrected, cropped or merged."""
    state, first = map.state.unmerged, dict[bytes, int]()
    for number, content in enumerate(_contents(map, state.length.rows, state.turn.rows)):
        first.setdefault(blake2b(content, digest_size=16).digest(), number)
    return first, map.keyframe_steps()


def overlap(one: Remembered, other: Remembered) -> tuple[int, Span, Span] | None:
    """The number of keyframes of one session that two maps have, and their first and last step in each; None
    if there are none."""
    (known, steps), (again, other_steps) = one, other
    pairs = [(number, again[name]) for name, number in known.items() if name in again]
    apart = Counter(second - first for first, second in pairs)
    needed = min(LEAST, max(min(len(known), len(again)) - 1, 2))
    shifts = {shift for shift, count in apart.items() if count >= needed}
    common = np.array([pair for pair in pairs if pair[1] - pair[0] in shifts], int).reshape(-1, 2)
    if not len(common):
        return None
    held = steps[common[:, 0]], other_steps[common[:, 1]]
    one_span, other_span = ((int(at.min()), int(at.max())) for at in held)
    return len(common), one_span, other_span
