"""Spacing and orientation of a lattice, from the peaks of its autocorrelogram.

The peaks nearest to the centre, three for a hexagonal and two for a square lattice in each half, give the
spacing (their mean distance) and the orientation (their mean direction, folded by the symmetry): Hafting et
al. 2005, Nature 436:801; Sargolini et al. 2006, Science 312:758.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from evaluation.cells.centre_field import centre_radii
from evaluation.cells.grid_score import HEXAGONAL, Lattice
from tactile.base.errors import InputError

_CLOSE = np.deg2rad(15.0)
"""Peaks whose directions differ by less belong to one row; the nearest counts, as in opexebo."""


class LatticeShape(NamedTuple):
    """Spacing and orientation of lattices; NaN where too few peaks are found.

    Attributes:
        spacing: [n] m. orientation: [n] rad from the x axis to the next row of peaks anticlockwise, in
            0 .. pi / 3 for a hexagonal and 0 .. pi / 2 for a square lattice.
    """

    spacing: np.ndarray
    orientation: np.ndarray


def measure_lattice(
    autocorrelograms: np.ndarray, bin_size: float, lattice: Lattice = HEXAGONAL
) -> LatticeShape:
    """Spacing and orientation of lattices.

    Peaks are the bins outside the central field that exceed 0 and their eight neighbours; a parabola through
    the neighbours places them between bins.

    Args:
        autocorrelograms: [n, h, w] as from `autocorrelogram`; rows rise with y, columns with x.
        bin_size: side of a bin, m. lattice: its symmetry.

    Raises:
        InputError: the size of a bin is not positive.
    """
    if not bin_size > 0:
        raise InputError("bin_size", f"{bin_size}", "a length above 0 m")
    maps = np.nan_to_num(np.asarray(autocorrelograms, float))
    period = np.deg2rad(lattice.onto[0])
    inner = centre_radii(np.ascontiguousarray(maps.transpose(1, 2, 0)))
    count = round(np.pi / period)
    vectors = [_nearest_peaks(image, radius, count) for image, radius in zip(maps, inner, strict=True)]
    spacing = [bin_size * np.abs(peaks).mean() for peaks in vectors]
    turns = [_mean_angle(np.angle(peaks) * 2 * np.pi / period) for peaks in vectors]
    return LatticeShape(np.array(spacing), np.array(turns) / (2 * np.pi) * period % period)


def _mean_angle(angles: np.ndarray) -> float:
    return float(np.arctan2(np.sin(angles).mean(), np.cos(angles).mean()))


def _nearest_peaks(image: np.ndarray, inner: int, count: int) -> np.ndarray:
    """The nearest `count` peaks of half an autocorrelogram in different directions: complex offsets, bins."""
    centre = image.shape[0] // 2, image.shape[1] // 2
    highest = (image == maximum_filter(image, size=3, mode="nearest")) & (image > 0)
    row, column = np.nonzero(highest[1:-1, 1:-1])
    y, x = row + 1 - centre[0], column + 1 - centre[1]
    chosen = ((y > 0) | ((y == 0) & (x > 0))) & (np.hypot(y, x) > inner) & (inner > 0)
    middle = complex(*centre[::-1])
    rows, columns = row[chosen] + 1, column[chosen] + 1
    peaks = [_place_peak(image, i, j) - middle for i, j in zip(rows, columns, strict=True)]
    nearest: list[complex] = []
    for peak in sorted(peaks, key=abs):
        if all(abs(np.angle((peak / other) ** 2)) >= 2 * _CLOSE for other in nearest):
            nearest.append(peak)
    return np.array(nearest[:count]) if len(nearest) >= count else np.full(count, np.nan + 0j)


def _place_peak(image: np.ndarray, row: int, column: int) -> complex:
    """Column + i row of a peak, bins, by parabolas through its neighbours in the row and in the column."""

    def shift(before: float, peak: float, after: float) -> float:
        curvature = before - 2 * peak + after
        return 0.5 * (before - after) / curvature if curvature < 0 else 0.0

    return complex(
        column + shift(*image[row, column - 1 : column + 2]), row + shift(*image[row - 1 : row + 2, column])
    )
