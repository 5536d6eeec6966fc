"""Forward and inverse kinematics of the UR10 and UR10e in closed form.

Rotations and poses are in the controller's notation: rotation vectors (rad), poses [6] (m, rotation vector).
Plain floats: a control step handles one pose at a time, where an array costs more than its arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[Vector3, Vector3, Vector3]  # rows


def vector6(numbers: Iterable[float]) -> Vector6:
    """Six numbers, such as a pose or joints, as a tuple."""
    a, b, c, d, e, f = numbers
    return a, b, c, d, e, f


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


def _product(first: Quaternion, second: Quaternion) -> Quaternion:
    """The rotation by `second`, then by `first`."""
    a, b, c, d = first
    e, f, g, h = second
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def _conjugate(rotation: Quaternion) -> Quaternion:
    """The inverse rotation."""
    w, x, y, z = rotation
    return w, -x, -y, -z


def _matrix(rotation: Quaternion) -> Matrix:
    """Rotation matrix; its columns are the rotated axes."""
    w, x, y, z = rotation
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def _rotate(rotation: Quaternion, vector: Sequence[float]) -> Vector3:
    """The vector [3] after the rotation."""
    x, y, z = vector
    first, second, third = (a * x + b * y + c * z for a, b, c in _matrix(rotation))
    return first, second, third


def compose_poses(frame: Sequence[float], pose: Sequence[float]) -> Vector6:
    """`pose`, which is given in `frame`, in the parent frame of `frame` (URScript's pose_trans)."""
    rotation = quaternion(frame[3:6])
    x, y, z = _rotate(rotation, pose[:3])
    rotate_by = rotation_vector(_product(rotation, quaternion(pose[3:6])))
    return (frame[0] + x, frame[1] + y, frame[2] + z, *rotate_by)


def invert_pose(pose: Sequence[float]) -> Vector6:
    """The inverse pose."""
    back = _conjugate(quaternion(pose[3:6]))
    x, y, z = _rotate(back, pose[:3])
    return (-x, -y, -z, *rotation_vector(back))


def rotation_between(start: Sequence[float], goal: Sequence[float]) -> Vector3:
    """Rotation vector in the base frame, rad, of the shortest rotation from pose `start` to pose `goal`."""
    return rotation_vector(_product(quaternion(goal[3:6]), _conjugate(quaternion(start[3:6]))))


def rotate_by(pose: Sequence[float], vector: Sequence[float]) -> Vector3:
    """Rotation vector of a pose after a rotation by a vector in the base frame, rad."""
    return rotation_vector(_product(quaternion(vector), quaternion(pose[3:6])))


def _quaternion_of(rows: Matrix) -> Quaternion:
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


EDGE = 1e-9  # rounding tolerance at full extension
FREE = 1e-6  # sine of joint 5 below which joints 4 and 6 count as coaxial


class Geometry(NamedTuple):
    """Denavit-Hartenberg lengths, m; alpha is (90, 0, 0, 90, -90, 0) degrees.

    Source: Universal Robots, "DH Parameters for calculations of kinematics and dynamics" (support article).
    """

    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float

    def forward(self, joints: Sequence[float]) -> Vector6:
        """Flange pose [6] (m, rotation vector rad) of joints [6], rad.

        Joints 2 to 4 are parallel: their angles add.
        """
        q1, q2, q3, q4, q5, q6 = joints
        c1, s1, c5, s5, c6, s6 = (f(q) for q in (q1, q5, q6) for f in (math.cos, math.sin))
        c, s = math.cos(q2 + q3 + q4), math.sin(q2 + q3 + q4)
        reach = self.a2 * math.cos(q2) + self.a3 * math.cos(q2 + q3)
        height = self.d1 + self.a2 * math.sin(q2) + self.a3 * math.sin(q2 + q3)
        # In the frame of the arm's plane: x outwards, y along -z of joint 2, z up.
        ax, ay, az = -c * s5, -c5, -s * s5  # the flange's z axis
        x = (c * c5 * c6 - s * s6, -s5 * c6, s * c5 * c6 + c * s6)
        y = (-c * c5 * s6 - s * c6, s5 * s6, -s * c5 * s6 + c * c6)
        px = reach + self.d5 * s + self.d6 * ax
        py = -self.d4 + self.d6 * ay
        pz = height - self.d5 * c + self.d6 * az
        rows = (
            (c1 * x[0] - s1 * x[1], c1 * y[0] - s1 * y[1], c1 * ax - s1 * ay),
            (s1 * x[0] + c1 * x[1], s1 * y[0] + c1 * y[1], s1 * ax + c1 * ay),
            (x[2], y[2], az),
        )
        place = (c1 * px - s1 * py, s1 * px + c1 * py, pz)
        return (*place, *rotation_vector(_quaternion_of(rows)))

    def solutions(self, pose: Sequence[float], sixth: float = 0.0) -> list[Vector6]:
        """All joint solutions [6], rad, for a flange pose: at most eight, none if it is out of reach.

        Args:
            sixth: angle of joint 6 if the pose leaves it free, rad.
        """
        if not all(math.isfinite(number) for number in pose):
            return []
        px, py, pz = pose[:3]
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = _matrix(quaternion(pose[3:6]))
        wx, wy, wz = px - self.d6 * r02, py - self.d6 * r12, pz - self.d6 * r22
        radius = math.hypot(wx, wy)
        if radius < self.d4 * (1 - EDGE):
            return []
        found = []
        bearing, lean = math.atan2(wy, wx), math.asin(min(1.0, self.d4 / radius))
        for q1 in (bearing + lean, bearing + math.pi - lean):
            c1, s1 = math.cos(q1), math.sin(q1)
            c5 = (px * s1 - py * c1 - self.d4) / self.d6
            if abs(c5) > 1 + EDGE:
                continue
            ahead_x, ahead_y, ahead_z = c1 * r00 + s1 * r10, c1 * r01 + s1 * r11, c1 * r02 + s1 * r12
            c5 = max(-1.0, min(1.0, c5))
            for q5 in (math.acos(c5), -math.acos(c5)):
                s5 = math.sin(q5)
                if abs(s5) > FREE:
                    q6 = math.atan2((-r01 * s1 + r11 * c1) / s5, (r00 * s1 - r10 * c1) / s5)
                else:
                    q6 = sixth
                c6, s6 = math.cos(q6), math.sin(q6)
                # With the rotations of joints 6 and 5 undone, in the arm's plane (out, up): the x axis is at
                # the sum of joints 2 to 4, and the y axis of joint 6's frame points along d5.
                out = c5 * (c6 * ahead_x - s6 * ahead_y) - s5 * ahead_z
                up = c5 * (c6 * r20 - s6 * r21) - s5 * r22
                total = math.atan2(up, out)
                x = c1 * wx + s1 * wy + self.d5 * (s6 * ahead_x + c6 * ahead_y)
                z = wz - self.d1 + self.d5 * (s6 * r20 + c6 * r21)
                c3 = (x * x + z * z - self.a2**2 - self.a3**2) / (2 * self.a2 * self.a3)
                if abs(c3) > 1 + EDGE:
                    continue
                c3 = max(-1.0, min(1.0, c3))
                for q3 in (math.acos(c3), -math.acos(c3)):
                    q2 = math.atan2(z, x) - math.atan2(self.a3 * math.sin(q3), self.a2 + self.a3 * c3)
                    found.append((q1, q2, q3, total - q2 - q3, q5, q6))
        return found

    def backward(self, pose: Sequence[float], near: Sequence[float]) -> Vector6 | None:
        """Joint solution nearest to `near` [6] for a flange pose [6], within +-2 pi rad; None without one."""
        best, least = None, math.inf
        for joints in self.solutions(pose, near[5]):
            way = [math.remainder(q - n, math.tau) for q, n in zip(joints, near, strict=True)]
            size = max(map(abs, way))
            if size < least:
                best, least = way, size
        if best is None:
            return None
        return vector6(
            n + w if abs(n + w) <= math.tau else math.remainder(n + w, math.tau)
            for n, w in zip(near, best, strict=True)
        )


UR10 = Geometry(0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922)
UR10E = Geometry(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655)
