"""Border score of rate maps in a rectangular box."""

from __future__ import annotations

import numpy as np

from evaluation.cells.fields import Fields, find_fields


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
    inside = np.where(fields.label > 0, np.nan_to_num(rates), 0.0).reshape(len(rates), -1)
    total = inside.sum(axis=1)
    return 2 * (inside @ distance.ravel()) / np.where(total > 0, total, 1.0) / min(height, width)
