"""Sessions that two maps have in common: keyframes that are equal to the bit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from hashlib import blake2b
from typing import NamedTuple

import numpy as np

from ratslam.mapping.map import KeyframeMap

LEAST = 8
"""Number of different keyframes, equally far apart in both maps, from which on they are those of one session:
rows of coarse odometry and of views without contact may be equal by chance, but not in one order."""


class Remembered(NamedTuple):
    """The keyframes of a map, to be found again in other maps.

    Attributes:
        first: number of the first keyframe of each name; equal names are equal keyframes. steps: [N] at which
            the keyframes were taken.
    """

    first: dict[bytes, int]
    steps: np.ndarray


class Overlap(NamedTuple):
    """Keyframes of one session in two maps.

    Attributes:
        keyframes: their number. one, other: first and last step of them in each map.
    """

    keyframes: int
    one: tuple[int, int]
    other: tuple[int, int]


def remembered(map: KeyframeMap) -> Remembered:
    """The keyframes of a map. They are named by view, place label, distance and turn by odometry, which stay
    as they are when a map is continued, corrected, cropped or merged."""
    graph = map.keyframes()
    views, labels = map.appearance.stored(np.arange(graph.count))
    odometry = np.column_stack([graph.length.rows, graph.turn.rows])
    first: dict[bytes, int] = {}
    for number, (motion, view, label) in enumerate(zip(odometry, np.asarray(views), labels, strict=True)):
        content = motion.tobytes() + view.tobytes() + label.tobytes()
        first.setdefault(blake2b(content, digest_size=16).digest(), number)
    return Remembered(first, map.keyframe_steps())


def overlap(one: Remembered, other: Remembered) -> Overlap | None:
    """What two maps have of one session; None if nothing."""
    pairs = [(number, other.first[name]) for name, number in one.first.items() if name in other.first]
    apart = Counter(second - first for first, second in pairs)
    needed = min(LEAST, max(min(len(one.first), len(other.first)) - 1, 2))
    shifts = {shift for shift, count in apart.items() if count >= needed}
    common = np.array([pair for pair in pairs if pair[1] - pair[0] in shifts], int).reshape(-1, 2)
    if not len(common):
        return None
    return Overlap(len(common), _ends(one.steps[common[:, 0]]), _ends(other.steps[common[:, 1]]))


def _ends(steps: Sequence[int] | np.ndarray) -> tuple[int, int]:
    return int(np.min(steps)), int(np.max(steps))
