"""Planar rigid motions (SE(2)) and the one place where angles are wrapped.

A pose is an array [..., 3] of x (m), y (m), heading (rad, counter-clockwise); REP-103 axes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Array = Any


def wrap(angle: Array) -> Array:
    """The angle in (-pi, pi]. Operators only, so it serves floats, NumPy and JAX alike."""
    return np.pi - (np.pi - angle) % (2 * np.pi)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a followed by b, b in the frame of a: [..., 3]."""
    a, b = np.asarray(a), np.asarray(b)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap(a[..., 2] + b[..., 2])], axis=-1)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """b in the frame of a, so that compose(a, between(a, b)) == b: [..., 3]."""
    a, b = np.asarray(a), np.asarray(b)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * dx + s * dy, c * dy - s * dx, wrap(b[..., 2] - a[..., 2])], axis=-1)


def inverse(a: np.ndarray) -> np.ndarray:
    """The motion that undoes a: [..., 3]."""
    a = np.asarray(a)
    return between(a, np.zeros_like(a))


def integrate(motions: np.ndarray, start: np.ndarray | None = None) -> np.ndarray:
    """Poses after each of the body-frame motions [N, 3], from `start` (default the origin): [N, 3].

    The running sum in closed form: heading first, then each motion turned by the heading before it.
    """
    motions = np.asarray(motions, np.float64)
    start = np.zeros(3) if start is None else np.asarray(start, np.float64)
    heading = start[2] + np.cumsum(motions[:, 2])
    before = np.concatenate([[start[2]], heading[:-1]])
    c, s = np.cos(before), np.sin(before)
    x = start[0] + np.cumsum(c * motions[:, 0] - s * motions[:, 1])
    y = start[1] + np.cumsum(s * motions[:, 0] + c * motions[:, 1])
    return np.stack([x, y, wrap(heading)], axis=-1)


def fitted(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rigid motion [3] that brings poses [N, 3] nearest to others by position: compose(fitted(a, b), a).

    Least squares over rotation and translation, without scale (Umeyama 1991, in the plane).
    """
    x, y = (np.asarray(rows)[:, 0] + 1j * np.asarray(rows)[:, 1] for rows in (a, b))
    turn = np.angle(np.vdot(x - x.mean(), y - y.mean()))
    shift = y.mean() - np.exp(1j * turn) * x.mean()
    return np.array([shift.real, shift.imag, turn])


def tum_line(time: float, pose: np.ndarray) -> str:
    """One line `t x y z qx qy qz qw` of a TUM trajectory; floats are written so that they read back equal."""
    x, y, heading = map(float, pose)
    values = (float(time), x, y, 0.0, 0.0, 0.0, float(np.sin(heading / 2)), float(np.cos(heading / 2)))
    return " ".join(map(repr, values)) + "\n"
