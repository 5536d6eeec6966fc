"""Pose cells of the stock engine: inhibition, shifts, decoding, injection."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.oracle import compare
from tests.oracle.cells import Attractor, StockCells, circular_mean, decoded, rotated, translated_leaky
from tests.oracle.plain import PlainCells
from tests.oracle.trace import Parameters
from tests.oracle.trace_cases import SETTINGS


def test_the_attractor_equals_the_dense_one() -> None:
    """Computing the occupied box alone is exact, also across the edges of the torus."""
    p = Parameters(pc_dim_xy=12, pc_dim_th=16)
    activity = np.zeros((16, 12, 12))
    activity[15, 0, 11], activity[1, 3, 10] = 0.7, 0.3
    dense = activity

    def gaussian(width: int, sigma: float) -> dict[tuple[int, int, int], float]:
        reach = range(-(width // 2), width // 2 + 1)
        cube = {
            (a, b, c): math.exp(-(a * a + b * b + c * c) / (2 * sigma**2))
            for a in reach
            for b in reach
            for c in reach
        }
        total = sum(cube.values())
        return {o: weight / total for o, weight in cube.items()}

    def convolved(kernel: dict[tuple[int, int, int], float]) -> np.ndarray:
        return sum(weight * np.roll(dense, o, axis=(0, 1, 2)) for o, weight in kernel.items())

    dense = convolved(gaussian(7, 1))
    dense = dense - convolved(gaussian(5, 2))
    dense = np.where(dense >= 2e-5, dense - 2e-5, 0.0)
    ours = Attractor(p).inhibited(activity)
    np.testing.assert_allclose(ours, dense, atol=1e-15)
    assert np.array_equal(ours != 0, dense != 0)


def test_translation_is_mirrored_and_leaks() -> None:
    """x moves with the sine and y with the cosine of the heading; the corner loses activity."""
    activity = np.zeros((36, 11, 11))
    activity[0, 5, 5] = activity[9, 5, 5] = 1.0
    moved = translated_leaky(activity, 1.0)
    assert moved[0, 6, 5] == pytest.approx(1.0)
    assert moved[9, 5, 6] == pytest.approx(1.0)
    assert translated_leaky(activity, -1.0)[0, 4, 5] == pytest.approx(1.0)

    corner = np.zeros((36, 11, 11))
    corner[4, 10, 0] = 1.0
    assert 0.2 < translated_leaky(corner, 0.8).sum() < 0.9
    middle = np.zeros((36, 11, 11))
    middle[4, 5, 5] = 1.0
    assert translated_leaky(middle, 0.8).sum() == pytest.approx(1.0)
    assert translated_leaky(middle, 1.7).min() < 0


def test_rotation() -> None:
    """Shifts by cells are exact, shifts by parts of cells interpolate, in both directions."""
    activity = np.zeros((8, 3, 3))
    activity[0, 1, 1] = 1.0
    cell = math.pi / 4
    assert rotated(activity, 2 * cell)[2, 1, 1] == 1.0
    assert rotated(activity, -0.25 * cell)[7, 1, 1] == pytest.approx(0.25)
    assert rotated(activity, 0.0) is activity


def test_decoding() -> None:
    """The first of equal peaks, and a mean that can reach the ring's length but not exceed it."""
    activity = np.zeros((9, 9, 9))
    activity[8, 8, 8] = activity[0, 0, 0] = 0.5
    assert decoded(activity) == pytest.approx((8.5, 8.5, 8.5))
    assert circular_mean(np.array([1.0]), np.array([3]), 9) == pytest.approx(3.0)


def test_injection_truncates_the_pose() -> None:
    """Energy goes to the cell below, and out of the grid at its upper edge."""
    p = Parameters(pc_dim_xy=9, pc_dim_th=12)
    cells = StockCells(p)
    truncate = compare.truncated
    assert cells.inject(0.5, (2.9, 3.1, 11.999), truncate) == (2, 3, 11)
    assert cells.activity[11, 3, 2] == 0.5
    assert cells.inject(0.5, (9.0, 3.0, 0.0), truncate) is None

    plain = PlainCells(p, SETTINGS)
    plain.activity[:] = 0.0
    plain.deposit(1.0, (8.5, 3.0, 11.25))
    assert plain.activity[11, 3, 8] == pytest.approx(0.375)
    assert plain.activity[0, 3, 0] == pytest.approx(0.125)
