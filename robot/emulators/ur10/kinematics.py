"""Forward and inverse kinematics of the UR10 and UR10e in closed form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from robot.emulators.ur10.rotations import Vector6, matrix, quaternion, quaternion_of, rotation_vector

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


UR10 = Geometry(0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922)
UR10E = Geometry(0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655)


def forward(arm: Geometry, joints: Sequence[float]) -> Vector6:
    """Flange pose [6] (m, rotation vector rad) of joints [6], rad. Joints 2 to 4 are parallel: angles add."""
    q1, q2, q3, q4, q5, q6 = joints
    c1, s1, c5, s5, c6, s6 = (f(q) for q in (q1, q5, q6) for f in (math.cos, math.sin))
    c, s = math.cos(q2 + q3 + q4), math.sin(q2 + q3 + q4)
    reach = arm.a2 * math.cos(q2) + arm.a3 * math.cos(q2 + q3)
    height = arm.d1 + arm.a2 * math.sin(q2) + arm.a3 * math.sin(q2 + q3)
    # In the frame of the arm's plane: x outwards, y along -z of joint 2, z up.
    ax, ay, az = -c * s5, -c5, -s * s5  # the flange's z axis
    x = (c * c5 * c6 - s * s6, -s5 * c6, s * c5 * c6 + c * s6)
    y = (-c * c5 * s6 - s * c6, s5 * s6, -s * c5 * s6 + c * c6)
    px = reach + arm.d5 * s + arm.d6 * ax
    py = -arm.d4 + arm.d6 * ay
    pz = height - arm.d5 * c + arm.d6 * az
    rows = (
        (c1 * x[0] - s1 * x[1], c1 * y[0] - s1 * y[1], c1 * ax - s1 * ay),
        (s1 * x[0] + c1 * x[1], s1 * y[0] + c1 * y[1], s1 * ax + c1 * ay),
        (x[2], y[2], az),
    )
    place = (c1 * px - s1 * py, s1 * px + c1 * py, pz)
    return (*place, *rotation_vector(quaternion_of(rows)))


def solutions(arm: Geometry, pose: Sequence[float], sixth: float = 0.0) -> list[Vector6]:
    """All joint solutions [6], rad, for a flange pose: at most eight, none if it is out of reach.

    Args:
        sixth: angle of joint 6 if the pose leaves it free, rad.
    """
    if not all(math.isfinite(number) for number in pose):
        return []
    px, py, pz = pose[:3]
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = matrix(quaternion(pose[3:6]))
    wx, wy, wz = px - arm.d6 * r02, py - arm.d6 * r12, pz - arm.d6 * r22
    radius = math.hypot(wx, wy)
    if radius < arm.d4 * (1 - EDGE):
        return []
    found = []
    bearing, lean = math.atan2(wy, wx), math.asin(min(1.0, arm.d4 / radius))
    for q1 in (bearing + lean, bearing + math.pi - lean):
        c1, s1 = math.cos(q1), math.sin(q1)
        c5 = (px * s1 - py * c1 - arm.d4) / arm.d6
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
            # With the rotations of joints 6 and 5 undone, in the arm's plane (out, up): the x axis is at the
            # sum of joints 2 to 4, and the y axis of joint 6's frame points along d5.
            out = c5 * (c6 * ahead_x - s6 * ahead_y) - s5 * ahead_z
            up = c5 * (c6 * r20 - s6 * r21) - s5 * r22
            total = math.atan2(up, out)
            x = c1 * wx + s1 * wy + arm.d5 * (s6 * ahead_x + c6 * ahead_y)
            z = wz - arm.d1 + arm.d5 * (s6 * r20 + c6 * r21)
            c3 = (x * x + z * z - arm.a2**2 - arm.a3**2) / (2 * arm.a2 * arm.a3)
            if abs(c3) > 1 + EDGE:
                continue
            c3 = max(-1.0, min(1.0, c3))
            for q3 in (math.acos(c3), -math.acos(c3)):
                q2 = math.atan2(z, x) - math.atan2(arm.a3 * math.sin(q3), arm.a2 + arm.a3 * c3)
                found.append((q1, q2, q3, total - q2 - q3, q5, q6))
    return found


def backward(arm: Geometry, pose: Sequence[float], near: Sequence[float]) -> Vector6 | None:
    """Joint solution nearest to `near` [6] for a flange pose [6], within +-2 pi rad; None without one."""
    best, least = None, math.inf
    for joints in solutions(arm, pose, near[5]):
        way = [math.remainder(q - n, math.tau) for q, n in zip(joints, near, strict=True)]
        size = max(map(abs, way))
        if size < least:
            best, least = way, size
    if best is None:
        return None
    a, b, c, d, e, f = (
        n + w if abs(n + w) <= math.tau else math.remainder(n + w, math.tau)
        for n, w in zip(near, best, strict=True)
    )
    return a, b, c, d, e, f
