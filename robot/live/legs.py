"""Straight legs of a way: what a robot drives that turns on the spot and then moves without turning.

Odometry errs most in turns, and views are those remembered only at the headings at which the way was driven.
So a way over experiences, whose poses scatter, is driven in long straight legs, each at one heading.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tactile.base.se2 import wrap
from tactile.base.segments import line_distances

SCATTER = 0.02
"""Largest distance of the poses of a way from its legs, m."""
ALONG = 0.35
"""Largest difference between a heading on a leg and its direction, or the reverse, at which it was driven so,
rad."""


class Leg(NamedTuple):
    """A straight move at one heading.

    Attributes:
        start, end: [2] m. heading: rad.
    """

    start: np.ndarray
    end: np.ndarray
    heading: float


def legs_of(way: np.ndarray) -> list[Leg]:
    """The legs of a way [K, 3] (m, m, rad), K >= 1: its poses within `SCATTER` of the legs (Douglas &
    Peucker 1973). A way of one place is one leg without length."""
    if len(way) == 1:
        return [Leg(way[0, :2], way[0, :2], float(way[0, 2]))]
    marks = _vertices(way[:, :2])
    return [Leg(way[a, :2], way[b, :2], leg_heading(way[a : b + 1])) for a, b in pairwise(marks)]


def leg_heading(poses: np.ndarray) -> float:
    """The heading of a leg over poses [K, 3]: its direction or the reverse, if at least half of it was driven
    so; otherwise the mean of the headings, each weighted by the length beside it."""
    length = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    weight = np.convolve(length, [0.5, 0.5])
    weight = weight if weight.sum() > 0 else np.ones(len(poses))
    step = poses[-1, :2] - poses[0, :2]
    direction = float(np.arctan2(step[1], step[0]))
    for candidate in (direction, direction + np.pi):
        along = np.abs(wrap(poses[:, 2] - candidate)) <= ALONG
        if np.hypot(*step) > SCATTER and weight[along].sum() >= weight.sum() / 2:
            return float(wrap(candidate))
    return float(np.angle(np.sum(weight * np.exp(1j * poses[:, 2]))))


def _vertices(line: np.ndarray) -> list[int]:
    """Numbers of the points of a line [K, 2] between which it is straight."""
    kept, open_parts = {0, len(line) - 1}, [(0, len(line) - 1)]
    while open_parts:
        a, b = open_parts.pop()
        if b - a < 2:
            continue
        off = line_distances(line[a + 1 : b], line[[a, b]])
        far = int(np.argmax(off))
        if off[far] > SCATTER:
            middle = a + 1 + far
            kept.add(middle)
            open_parts += [(a, middle), (middle, b)]
    return sorted(kept)
