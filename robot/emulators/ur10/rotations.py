"""Rotations and poses in the controller's notation: rotation vectors (rad), poses [6] (m, rotation vector).

Plain floats: a control step handles one pose at a time, where an array costs more than its arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector3, Vector3, Vector3]  # rows


def quaternion(vector: Sequence[float]) -> Quaternion:
    """(w, x, y, z) of a rotation vector, rad."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    half = math.sin(angle / 2) / angle if angle > 1e-12 else 0.5
    return math.cos(angle / 2), x * half, y * half, z * half


def rotation_vector(rotation: Quaternion) -> Vector3:
    """Rotation vector of a quaternion, rad, of length at most pi."""
    w, x, y, z = rotation
    if w < 0:
        w, x, y, z = -w, -x, -y, -z
    length = math.sqrt(x * x + y * y + z * z)
    scale = 2 * math.atan2(length, w) / length if length > 1e-12 else 2.0
    return x * scale, y * scale, z * scale


def product(first: Quaternion, second: Quaternion) -> Quaternion:
    """The rotation by `second`, then by `first`."""
    a, b, c, d = first
    e, f, g, h = second
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def conjugate(rotation: Quaternion) -> Quaternion:
    """The inverse rotation."""
    w, x, y, z = rotation
    return w, -x, -y, -z


def matrix(rotation: Quaternion) -> Matrix:
    """Rotation matrix; its columns are the rotated axes."""
    w, x, y, z = rotation
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def rotate(rotation: Quaternion, vector: Sequence[float]) -> Vector3:
    """The vector [3] after the rotation."""
    x, y, z = vector
    first, second, third = matrix(rotation)
    return (
        first[0] * x + first[1] * y + first[2] * z,
        second[0] * x + second[1] * y + second[2] * z,
        third[0] * x + third[1] * y + third[2] * z,
    )


def compose_poses(frame: Sequence[float], pose: Sequence[float]) -> Vector6:
    """`pose`, which is given in `frame`, in the parent frame of `frame` (URScript's pose_trans)."""
    rotation = quaternion(frame[3:6])
    x, y, z = rotate(rotation, pose[:3])
    rotate_by = rotation_vector(product(rotation, quaternion(pose[3:6])))
    return (frame[0] + x, frame[1] + y, frame[2] + z, *rotate_by)


def invert_pose(pose: Sequence[float]) -> Vector6:
    """The inverse pose."""
    back = conjugate(quaternion(pose[3:6]))
    x, y, z = rotate(back, pose[:3])
    return (-x, -y, -z, *rotation_vector(back))


def rotation_between(start: Sequence[float], goal: Sequence[float]) -> Vector3:
    """Rotation vector in the base frame, rad, of the shortest rotation from pose `start` to pose `goal`."""
    return rotation_vector(product(quaternion(goal[3:6]), conjugate(quaternion(start[3:6]))))


def rotate_by(pose: Sequence[float], vector: Sequence[float]) -> Vector3:
    """Rotation vector of a pose after a rotation by a vector in the base frame, rad."""
    return rotation_vector(product(quaternion(vector), quaternion(pose[3:6])))


def quaternion_of(rows: Matrix) -> Quaternion:
    """Quaternion of a rotation matrix, by its largest component (Shepperd 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    parts = (a + e + i, a - e - i, e - a - i, i - a - e)
    largest = max(range(4), key=parts.__getitem__)
    root = math.sqrt(max(parts[largest] + 1, 0.0)) * 2
    if largest == 0:
        return root / 4, (h - f) / root, (c - g) / root, (d - b) / root
    if largest == 1:
        return (h - f) / root, root / 4, (b + d) / root, (c + g) / root
    if largest == 2:
        return (c - g) / root, (b + d) / root, root / 4, (f + h) / root
    return (d - b) / root, (c + g) / root, (f + h) / root, root / 4
