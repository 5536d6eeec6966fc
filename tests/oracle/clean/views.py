"""Recognising a view without a gate, ties broken by a tolerance (semantics, part 1)."""

from __future__ import annotations

from math import inf

import numpy as np

from tests.oracle.cells import Array
from tests.oracle.clean.settings import Settings
from tests.oracle.params import Params
from tests.oracle.views import Comparison, Match

SLACK = 1e-9  # errors this close are equal


class Views:
    """Templates by their pixels."""

    def __init__(self, params: Params, settings: Settings) -> None:
        self.compare = Comparison(params)
        self.threshold = params.vt_match_threshold
        self.column_angle = settings.column_angle
        self.templates: list[Array] = []

    def match(self, flat: Array) -> Match:
        """The earliest template, at its lowest offset, among those as good as the best; or a new one."""
        view = self.compare.shape(flat)
        best = inf
        if self.templates:
            errors = self.compare.errors(view, np.stack(self.templates))
            best = float(errors.min())
            if best <= self.threshold + SLACK:
                template, column = divmod(int((errors <= best + SLACK).argmax()), errors.shape[1])
                return Match(template, self._relative(self.compare.offsets[column]), best)
        self.templates.append(view)
        return Match(len(self.templates) - 1, 0.0, best)

    def _relative(self, offset: int) -> float:
        if self.compare.panoramic:
            return self.compare.turn(offset)
        return (offset - self.compare.margin) * self.column_angle


class Labels:
    """Templates by the labels they carry."""

    def __init__(self) -> None:
        self.templates: list[int] = []

    def match(self, row: Array) -> Match:
        """The earliest template with the label; labels say nothing about the heading."""
        label = int(row[0])
        if label in self.templates:
            return Match(self.templates.index(label), 0.0, 0.0)
        self.templates.append(label)
        return Match(len(self.templates) - 1, 0.0, inf)
