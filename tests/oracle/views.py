"""Views and the templates they are compared with (section 3; "1. View" of the engine's semantics)."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np

from tests.oracle.trace import Array, Parameters

# Initial error of the stock engine's search; it remains when nothing was compared.
NOTHING_COMPARED = sys.float_info.max


@dataclass(frozen=True)
class Match:
    """The matched template of a view, its error, and the turn, rad."""

    template: int
    error: float
    relative: float
    novel: bool


def wrapped(angle: float) -> float:
    """The angle in (-pi, pi]."""
    while angle > math.pi:
        angle -= 2 * math.pi
    while angle <= -math.pi:
        angle += 2 * math.pi
    return angle


def offsets(parameters: Parameters) -> range:
    """The offsets that are tried: around the ring, or up to twice the shift."""
    if parameters.vt_panoramic:
        return range(0, parameters.template_x_size, parameters.vt_step_match)
    return range(0, 2 * parameters.vt_shift_match + 1, parameters.vt_step_match)


def compared_pixels(parameters: Parameters) -> int:
    """Number of pixels in one comparison."""
    margin = 0 if parameters.vt_panoramic else 2 * parameters.vt_shift_match
    return (parameters.template_x_size - margin) * parameters.template_y_size


def summed_differences(view: Array, stored: Array, parameters: Parameters) -> Array:
    """Sums of absolute differences, one row per template and one column per offset.

    The sum runs pixel by pixel in row-major order (a cumulative sum does), because a pairwise one could
    break a tie between two templates the other way.
    """
    width, shift = view.shape[1], parameters.vt_shift_match
    sums = np.empty((len(stored), len(offsets(parameters))))
    for column, o in enumerate(offsets(parameters)):
        if parameters.vt_panoramic:
            difference = view[None] - np.roll(stored, -o, axis=2)
        else:
            difference = view[None, :, shift : width - shift] - stored[:, :, o : width - 2 * shift + o]
        sums[:, column] = np.abs(difference).reshape(len(stored), -1).cumsum(axis=1)[:, -1]
    return sums


class StockTemplates:
    """Section 3: the stock engine's templates. They are never updated, merged or deleted."""

    def __init__(self, parameters: Parameters) -> None:
        self.parameters = parameters
        self.stored: list[Array] = []
        self.means: list[float] = []

    def see(self, view: Array) -> Match:
        """The best template that passes the gate on the mean, or a new one."""
        p = self.parameters
        mean = float(view.mean())
        best, winner, relative = NOTHING_COMPARED, -1, 0.0
        error = best
        if self.stored:
            # The gate hides a template from the search even where it would win (Q18).
            passed = np.flatnonzero(np.abs(mean - np.array(self.means)) <= p.vt_match_threshold + 0.005)
            if len(passed):
                sums = summed_differences(view, np.stack([self.stored[k] for k in passed]), p)
                # The first minimum in row-major order: earliest template, then lowest offset.
                row, column = divmod(int(np.argmin(sums)), sums.shape[1])
                best, winner = float(sums[row, column]), int(passed[row])
                if p.vt_panoramic:
                    relative = wrapped(offsets(p)[column] / p.template_x_size * 2 * math.pi)
            error = best / compared_pixels(p)
        if winner >= 0 and error <= p.vt_match_threshold:
            return Match(winner, error, relative, novel=False)
        self.stored.append(view)
        self.means.append(mean)
        return Match(len(self.stored) - 1, error, 0.0, novel=True)
