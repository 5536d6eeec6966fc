"""Recognising a view, with the mean gate and the strict order of ties (section 3, Q18)."""

from __future__ import annotations

import sys

import numpy as np

from tests.oracle.cells import Array
from tests.oracle.params import Params
from tests.oracle.views import Comparison, Match

GATE_SLACK = 0.005  # on top of the threshold, for the difference of two means
NOTHING = sys.float_info.max  # the sum of differences to no template at all


class Views:
    """The templates seen so far; none is ever changed, merged or forgotten."""

    def __init__(self, params: Params) -> None:
        self.compare = Comparison(params)
        self.threshold = params.vt_match_threshold
        self.templates: list[Array] = []
        self.means: list[float] = []

    @property
    def count(self) -> int:
        return len(self.templates)

    def match(self, flat: Array) -> Match:
        """The earliest template at the lowest offset among the best, or a new one."""
        view = self.compare.shape(flat)
        mean = float(view.mean())
        near = np.flatnonzero(np.abs(mean - np.array(self.means)) <= self.threshold + GATE_SLACK)
        if len(near):
            errors = self.compare.errors(view, np.stack([self.templates[k] for k in near]))
            template, offset = divmod(int(errors.argmin()), len(self.compare.offsets))
            error = float(errors[template, offset])
            if error <= self.threshold:
                return Match(int(near[template]), self.compare.turn(self.compare.offsets[offset]), error)
        else:  # the very first view is not even compared
            error = NOTHING / self.compare.pixels if self.templates else NOTHING
        self.templates.append(view)
        self.means.append(mean)
        return Match(self.count - 1, 0.0, error)
