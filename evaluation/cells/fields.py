"""Firing fields of rate maps (number, size, peak) and the border score of maps in a rectangular box."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from tactile.base.errors import InputError


class Fields(NamedTuple):
    """The F fields of n cells.

    Attributes:
        label: [n, H, W] int32, 0 outside fields, otherwise 1 + the row of the field in the other arrays.
        cell: [F] index of the cell among the n, in order. bins: [F] size. peak: [F] highest rate.
    """

    label: np.ndarray
    cell: np.ndarray
    bins: np.ndarray
    peak: np.ndarray

    @property
    def number(self) -> np.ndarray:
        """[n] number of fields."""
        return np.bincount(self.cell, minlength=len(self.label))

    @property
    def largest(self) -> np.ndarray:
        """[n] size of the largest field, bins, 0 without."""
        largest = np.zeros(len(self.label), int)
        np.maximum.at(largest, self.cell, self.bins)
        return largest


def find_fields(rates: np.ndarray, share: float = 0.2, least_bins: int = 9) -> Fields:
    """Finds the fields of each map: bins joined by their sides whose rate is at least `share` of the peak.

    No field crosses a wall, and bins without a rate belong to none. opexebo instead lowers a threshold for
    each peak until the field jumps in size or joins another, at the lowest to 0.2 of the peak of the map
    opened by a disk of radius 1, which flattens the summit. Where its search ends there, `share` = 0.2 times
    that peak over the plain one gives the same fields.

    Args:
        rates: [n, H, W] smoothed rates, NaN where unknown. least_bins: smaller fields are dropped, bins.
    """
    if rates.ndim != 3:
        raise InputError("rates", f"an array of {rates.ndim} dimensions", "[cells, H, W]")
    filled = np.where(np.isfinite(rates), rates, 0.0)
    peak = filled.max(axis=(1, 2), keepdims=True)
    sides = np.zeros((3, 3, 3), int)
    sides[1] = [[0, 1, 0], [1, 1, 1], [0, 1, 0]]
    label_, count = label((filled >= share * peak) & (peak > 0), structure=sides, output=np.int32)
    bins = np.bincount(label_.ravel(), minlength=count + 1)
    large = bins >= least_bins
    large[0] = False
    number = np.where(large, np.cumsum(large), 0).astype(np.int32)
    label_ = number[label_]
    at = np.flatnonzero(label_)
    field = label_.ravel()[at] - 1
    cell, highest = np.zeros(large.sum(), int), np.zeros(large.sum())
    cell[field] = at // label_[0].size
    np.maximum.at(highest, field, filled.ravel()[at])
    return Fields(label_, cell, bins[large], highest)


def largest_field(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] size of the largest field, bins, 0 without; `seconds` [H, W] is not used."""
    return find_fields(rates).largest.astype(float)


def border_score(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] border score in [-1, 1] of the fields of at least 0.3 of the peak and 9 bins; `seconds` is not
    used.

    Solstad et al. 2008, with their share of the peak; their smallest field is 200 cm^2.
    """
    return score_borders(rates, find_fields(rates, share=0.3, least_bins=9))


def score_borders(rates: np.ndarray, fields: Fields) -> np.ndarray:
    """[n] (c - d) / (c + d), -1 for a cell without a field.

    c is the largest share of one wall that one field touches; d is the mean distance to the nearest wall of
    the bins in fields, weighted by rate, over half the shorter side. Solstad et al. 2008; as opexebo, the
    distance of a bin that touches the wall is 1 bin, so that 20 x 20 bins reach at most 9/11.

    Args:
        rates: [n, H, W], NaN where unknown. fields: of these maps.
    """
    coverage, distance = wall_coverage(rates, fields), wall_distance(rates, fields)
    found = coverage + distance > 0
    return np.where(found, (coverage - distance) / np.where(found, coverage + distance, 1.0), -1.0)


def wall_coverage(rates: np.ndarray, fields: Fields) -> np.ndarray:
    """[n] largest share of a wall that one field touches. Where bins beside a wall have no rate, the first
    bin towards the middle that has one takes their place; lines without any do not count."""
    cells, known = len(rates), np.isfinite(rates)
    coverage = np.zeros((len(fields.cell), 4))
    for side, (axis, flip) in enumerate([(1, False), (1, True), (2, False), (2, True)]):
        labels, seen = (np.flip(each, axis) if flip else each for each in (fields.label, known))
        first = np.expand_dims(seen.argmax(axis=axis), axis)
        touching = np.take_along_axis(labels, first, axis)
        lines = seen.any(axis=axis).sum(axis=1)[fields.cell]
        touched = np.bincount(touching.ravel(), minlength=len(fields.cell) + 1)[1:]
        coverage[:, side] = touched / np.maximum(lines, 1)
    largest = np.zeros(cells)
    np.maximum.at(largest, fields.cell, coverage.max(axis=1, initial=0.0))
    return largest


def wall_distance(rates: np.ndarray, fields: Fields) -> np.ndarray:
    """[n] mean distance of fields to the nearest wall, weighted by rate, over half the shorter side; 0
    without."""
    height, width = rates.shape[1:]
    down, right = (np.minimum(np.arange(n), np.arange(n)[::-1]) + 1.0 for n in (height, width))
    distance = np.minimum(down[:, None], right[None])
    inside = np.where(fields.label > 0, rates, 0.0).reshape(len(rates), -1)
    total = inside.sum(axis=1)
    return 2 * (inside @ distance.ravel()) / np.where(total > 0, total, 1.0) / min(height, width)
