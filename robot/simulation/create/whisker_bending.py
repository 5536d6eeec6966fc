"""Static bending of a fixed, tapered whisker whose straight shaft would enter a wall, in closed form.

A whisker is rotated about its base by the smallest angle that frees it, and stays on that side while in
contact. The contact is its tip on a wall, a wall along its shaft, or the corner of an object. It springs
back as soon as the straight shaft would be free.

Beam theory for a cone, exact for small angles: radius r0 (1 - k x) at x along the shaft. A rotation of the
line from base to contact at a needs the base moment 3 E I (1 / a - k) times the angle, and the shaft there
is tilted by (3 - 2 k a) / (2 (1 - k a)) times the angle. Once the tip lies flat on the wall, the contact
moves towards the base. The shortening of the line by bending is neglected.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MAX_JOINED_WALLS = 4
"""Largest number of adjacent walls that can block a whisker."""
JOINED_ANGLE = 1e-9
"""Largest angle between adjacent walls, rad."""
BISECTIONS = 24
"""Bisection steps in the search of the contact position, accurate to 10 nm."""


class Shaft(NamedTuple):
    """Attributes:
    length: m. radius: at its base, m. taper: k, 1/m.
    """

    length: float
    radius: float
    taper: float


class Bending(NamedTuple):
    """Bending of whiskers [T, W]; zero where free, with the length as reach.

    Attributes:
        turn: rotation of the line from base to contact, rad, counter-clockwise. reach: its length, m.
        lean: angle of the contact force against the perpendicular of that line, rad: its tangent is the
            ratio of the forces along and across the shaft. side: 1 counter-clockwise, -1 clockwise, 0 free.
    """

    turn: np.ndarray
    reach: np.ndarray
    lean: np.ndarray
    side: np.ndarray


def base_strain(shaft: Shaft, turn: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Surface strain at the base, M r0 / (E I), with the sign of the rotation."""
    return 3 * shaft.radius * (1 / reach - shaft.taper) * turn


def shaft_tilt(shaft: Shaft, reach: np.ndarray) -> np.ndarray:
    """Ratio of the shaft's tilt at the contact to the rotation of the line from base to contact."""
    narrow = shaft.taper * reach
    return (3 - 2 * narrow) / (2 * (1 - narrow))


def bend_shafts(
    shaft: Shaft, base: np.ndarray, direction: np.ndarray, segments: np.ndarray, side: np.ndarray
) -> Bending:
    """Bending of whiskers among walls.

    Args:
        base: [T, W, 2] positions of the bases in order of time, m. direction: [T, W] of straight shafts, rad.
        segments: [S, 4] m. side: [W] as in `Bending`, before the first row.
    """
    free, no_side = np.zeros(direction.shape), np.zeros(direction.shape, int)
    nothing = Bending(free, free + shaft.length, free, no_side)
    if not len(segments):
        return nothing
    low, high = _blocked_ends(shaft, base, direction, segments)
    blocked = np.any((low.angle < 0) & (high.angle > 0), axis=-1)
    if not blocked.any():
        return nothing
    row, whisker = np.nonzero(blocked)
    low, high = (_Ends(*(column[row, whisker] for column in ends)) for ends in (low, high))
    left = _free_ends(low, high)
    right = _free_ends(high._replace(angle=-high.angle), low._replace(angle=-low.angle))
    easier = no_side.copy()
    easier[row, whisker] = np.where(left.angle <= right.angle, 1, -1)
    sides = _bending_sides(blocked, easier, side)
    way = sides[row, whisker]
    chosen = _Ends(*(np.where(way > 0, a, b) for a, b in zip(left, right, strict=True)))
    turn, reach, lean = (free.copy() for _ in range(3))
    reach += shaft.length
    angle, reach[row, whisker], lean[row, whisker] = _solve_contacts(shaft, chosen)
    turn[row, whisker] = way * angle
    return Bending(turn, reach, lean, sides)


class _Ends(NamedTuple):
    """One end of the range of angles in which a wall blocks a whisker: the angle, rad; the distance of the
    contact from the base, m; the distances of the nearest reachable point of the wall and of the wall's
    line, m."""

    angle: np.ndarray
    radius: np.ndarray
    near: np.ndarray
    away: np.ndarray


def _blocked_ends(
    shaft: Shaft, base: np.ndarray, direction: np.ndarray, segments: np.ndarray
) -> tuple[_Ends, _Ends]:
    """Lower and upper ends [T, W, S] of the angles, relative to the straight shaft, that walls block. For a
    wall out of reach the lower end is above the upper one."""
    c, s = np.cos(direction)[..., None], np.sin(direction)[..., None]
    x, y = segments[:, 0] - base[..., :1], segments[:, 1] - base[..., 1:]
    u, v = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    x, y, u, v = c * x + s * y, c * y - s * x, c * u + s * v, c * v - s * u
    # The part of each wall within reach of the base.
    square, middle = u * u + v * v, -(x * u + y * v)
    inner = middle**2 - square * (x * x + y * y - shaft.length**2)
    half = np.sqrt(np.maximum(inner, 0.0))
    first, last = np.maximum((middle - half) / square, 0.0), np.minimum((middle + half) / square, 1.0)
    there = (inner > 0) & (first < last)
    x1, y1, x2, y2 = x + first * u, y + first * v, x + last * u, y + last * v
    away = np.abs(x * v - y * u) / np.sqrt(square)
    start = np.arctan2(y1, x1)
    # Seen from the base a wall spans less than half a turn.
    span = np.arctan2(x1 * y2 - y1 * x2, x1 * x2 + y1 * y2)
    one, two = np.hypot(x1, y1), np.hypot(x2, y2)
    foot = middle / square
    near = np.where((first < foot) & (foot < last), away, np.minimum(one, two))
    up = span >= 0
    low = np.where(there, start + np.minimum(span, 0.0), np.inf)
    high = np.where(there, start + np.maximum(span, 0.0), -np.inf)
    return _Ends(low, np.where(up, one, two), near, away), _Ends(high, np.where(up, two, one), near, away)


def _free_ends(low: _Ends, high: _Ends) -> _Ends:
    """The end [K] at which blocked whiskers become free counter-clockwise, from ends [K, S]."""
    angle = np.zeros(len(low.angle))
    for _ in range(MAX_JOINED_WALLS):
        joined = low.angle <= angle[:, None] + JOINED_ANGLE
        angle = np.maximum(angle, np.where(joined, high.angle, 0.0).max(axis=1))
    # Of walls with the same end (a corner) the nearest one is the contact.
    last = np.abs(high.angle - angle[:, None]) <= JOINED_ANGLE
    which = np.argmin(np.where(last, high.radius, np.inf), axis=1)[:, None]
    radius, near, away = (np.take_along_axis(column, which, axis=1)[:, 0] for column in high[1:])
    return _Ends(angle, radius, near, away)


def _bending_sides(blocked: np.ndarray, easier: np.ndarray, side: np.ndarray) -> np.ndarray:
    """The bending side [T, W] of each whisker: the easier one at first contact, constant afterwards."""
    was = np.vstack([side != 0, blocked[:-1]])
    row = np.arange(len(blocked))[:, None]
    onset = np.maximum.accumulate(np.where(blocked & ~was, row, -1), axis=0)
    since = np.where(onset >= 0, np.take_along_axis(easier, np.maximum(onset, 0), axis=0), side)
    return np.where(blocked, since, 0)


def _solve_contacts(shaft: Shaft, end: _Ends) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation, reach and lean [K] of whiskers in contact at that end."""
    turn, reach = end.angle.copy(), end.radius.copy()
    tip = end.radius >= shaft.length * (1 - 1e-9)
    away = np.minimum(end.away, reach * (1 - 1e-12))
    slant = np.arcsin(away / reach)  # angle between the line to the contact and the wall
    lean = np.where(tip, slant, (shaft_tilt(shaft, reach) - 1) * turn)
    flat = np.flatnonzero(tip & ((shaft_tilt(shaft, reach) - 1) * turn > slant))
    if len(flat):
        wall = turn[flat] + slant[flat]  # angle between the straight shaft and the wall
        near, far = end.near[flat], np.full(len(flat), shaft.length)
        for _ in range(BISECTIONS):
            middle = (near + far) / 2
            slope = np.arcsin(np.minimum(away[flat] / middle, 1.0))
            beyond = (shaft_tilt(shaft, middle) - 1) * (wall - slope) > slope
            near, far = np.where(beyond, near, middle), np.where(beyond, middle, far)
        reach[flat] = far
        turn[flat] = wall - np.arcsin(np.minimum(away[flat] / far, 1.0))
        lean[flat] = (shaft_tilt(shaft, far) - 1) * turn[flat]
    return turn, reach, lean
