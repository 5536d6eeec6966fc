"""Angles, and rings of n cells."""

from __future__ import annotations

from math import floor, pi


def wrap(angle: float) -> float:
    """The angle in (-pi, pi]."""
    while angle > pi:
        angle -= 2 * pi
    while angle <= -pi:
        angle += 2 * pi
    return angle


def into_ring(x: float, n: int) -> float:
    """x wrapped once into [0, n)."""
    if x < 0:
        return x + n
    return x - n if x >= n else x


def distance(a: float, b: float, n: int) -> float:
    """How far apart a and b are on a ring of n cells."""
    apart = abs(a - b)
    return min(apart, n - apart)


def around(d: float, n: int) -> float:
    """The difference d taken the short way round a ring of n cells."""
    return d + n / 2 - n * floor((d + n / 2) / n) - n / 2
