"""Planar rigid motions (SE(2)) for NumPy and JAX, and the wrapping of angles.

A pose is an array [..., 3] of x (m), y (m), heading (rad, counter-clockwise); REP-103 axes. The functions
compute in the namespace of the arrays they are given: JAX arrays give JAX arrays. Also distances of points
from straight segments in the plane, and the line of a pose in a TUM file.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = Any


def wrap(angle: Array) -> Array:
    """The angle in (-pi, pi], rad, of a float or an array."""
    return np.pi - (np.pi - angle) % (2 * np.pi)


def compose(a: Array, b: Array) -> Array:
    """[..., 3] the motion a followed by b, which is given in the frame of a."""
    if _is_single(a) and _is_single(b):
        x, y, heading = a.tolist()
        dx, dy, turn = b.tolist()
        c, s = float(np.cos(heading)), float(np.sin(heading))
        return np.array([x + c * dx - s * dy, y + s * dx + c * dy, wrap(heading + turn)])
    xp, a, b = _arrays(a, b)
    c, s = xp.cos(a[..., 2]), xp.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return xp.stack([x, y, wrap(a[..., 2] + b[..., 2])], axis=-1)


def between(a: Array, b: Array) -> Array:
    """[..., 3] b in the frame of a, so that compose(a, between(a, b)) == b."""
    if _is_single(a) and _is_single(b):
        x, y, heading = a.tolist()
        to_x, to_y, to_heading = b.tolist()
        c, s, dx, dy = float(np.cos(heading)), float(np.sin(heading)), to_x - x, to_y - y
        return np.array([c * dx + s * dy, c * dy - s * dx, wrap(to_heading - heading)])
    xp, a, b = _arrays(a, b)
    c, s = xp.cos(a[..., 2]), xp.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return xp.stack([c * dx + s * dy, c * dy - s * dx, wrap(b[..., 2] - a[..., 2])], axis=-1)


def inverse(a: Array) -> Array:
    """[..., 3] the inverse motion."""
    xp, a = _arrays(a)
    return between(a, xp.zeros_like(a))


def correct_heading(motion: Array, length: Array, bias: Array, turn_error: Array = 0.0) -> Array:
    """Motions [..., 3] turned by a heading correction that grows evenly along the motion.

    Args:
        length: [...] distance travelled in each motion, m. bias: correction, rad/m. turn_error: correction as
            a share of the turn of each motion, rad/rad.
    """
    if _is_single(motion):
        return bend_motion(motion, bias * length + turn_error * motion[2])
    xp, motion = _arrays(motion)
    return bend_motion(motion, bias * xp.asarray(length) + turn_error * motion[..., 2])


def bend_motion(motion: Array, turn: Array) -> Array:
    """Motions [..., 3] turned by [...] rad that grow evenly along each motion."""
    if _is_single(motion) and np.ndim(turn) == 0:
        x, y, heading = motion.tolist()
        turn = float(turn)
        c, s = float(np.cos(turn / 2)), float(np.sin(turn / 2))
        return np.array([c * x - s * y, s * x + c * y, wrap(heading + turn)])
    xp, motion, turn = _arrays(motion, turn)
    c, s = xp.cos(turn / 2), xp.sin(turn / 2)
    x, y = motion[..., 0], motion[..., 1]
    return xp.stack([c * x - s * y, s * x + c * y, wrap(motion[..., 2] + turn)], axis=-1)


def _is_single(pose: Array) -> bool:
    """Whether this is one pose [3] of NumPy in double precision: such are computed as numbers, with the same
    bits and a third of the time."""
    return type(pose) is np.ndarray and pose.shape == (3,) and pose.dtype == np.float64


def _arrays(*values: Array) -> tuple[Any, ...]:
    """The array namespace of the values, NumPy unless an array has another, and the values as its arrays."""
    spaces = {value.__array_namespace__() for value in values if hasattr(value, "__array_namespace__")}
    xp = next(iter(spaces - {np}), np)
    return xp, *(xp.asarray(value) for value in values)


def integrate(motions: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """[N, 3] poses after each of the body-frame motions [N, 3], from `start` (default: the origin).

    Computed without a loop: cumulative headings first, then each motion rotated by the heading before it.
    """
    motions = np.asarray(motions, np.float64)
    start = np.zeros(3) if start is None else np.asarray(start, np.float64)
    heading = start[2] + np.cumsum(motions[:, 2])
    before = np.concatenate([[start[2]], heading[:-1]])
    c, s = np.cos(before), np.sin(before)
    x = start[0] + np.cumsum(c * motions[:, 0] - s * motions[:, 1])
    y = start[1] + np.cumsum(s * motions[:, 0] + c * motions[:, 1])
    return np.stack([x, y, wrap(heading)], axis=-1)


def fit_rigid_motion(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[3] the rigid motion m that aligns the positions of poses a [N, 3] with those of b: compose(m, a) ~ b.

    Least squares over rotation and translation, without scale (Umeyama 1991, in the plane).
    """
    x, y = (np.asarray(rows)[:, 0] + 1j * np.asarray(rows)[:, 1] for rows in (a, b))
    turn = np.angle(np.vdot(x - x.mean(), y - y.mean()))
    shift = y.mean() - np.exp(1j * turn) * x.mean()
    return np.array([shift.real, shift.imag, turn])


def tum_line(time: float, pose: np.ndarray) -> str:
    """One line `t x y z qx qy qz qw` of a TUM trajectory; floats are written exactly (repr)."""
    x, y, heading = map(float, pose)
    values = (float(time), x, y, 0.0, 0.0, 0.0, float(np.sin(heading / 2)), float(np.cos(heading / 2)))
    return " ".join(map(repr, values)) + "\n"


def segment_distances(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n, E] distances of points [n, 2] from the segments between a and b [E, 2], in their unit."""
    points, along = np.asarray(points, float).reshape(-1, 1, 2), b - a
    size = (along**2).sum(axis=-1)
    size = np.where(size > 0, size, 1.0)  # a segment may be a point
    share = np.clip(((points - a) * along).sum(axis=-1) / size, 0.0, 1.0)
    return np.linalg.norm(points - (a + share[..., None] * along), axis=-1)


def line_distances(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """[n] distances of points [n, 2] from the line through points [K, 2], K >= 1."""
    ends = (line[:-1], line[1:]) if len(line) > 1 else (line, line)
    return segment_distances(points, *ends).min(axis=1)
