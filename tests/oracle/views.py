"""Views and how much two of them differ (section 3)."""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np

from tests.oracle.cells import Array
from tests.oracle.circle import wrap
from tests.oracle.params import Params


class Match(NamedTuple):
    """The template a view was taken for.

    Attributes:
        template: its id; the number of templates before if the view is new.
        relative: heading of the view relative to the template, rad.
        error: mean absolute difference to the best template there was, whether taken or not.
    """

    template: int
    relative: float
    error: float


class Comparison:
    """A view against stored ones at every offset that the parameters allow, as mean absolute differences."""

    def __init__(self, params: Params) -> None:
        self.rows, self.columns = params.template_y_size, params.template_x_size
        self.panoramic = bool(params.vt_panoramic)
        self.margin = 0 if self.panoramic else params.vt_shift_match
        end = self.columns if self.panoramic else 2 * self.margin + 1
        self.offsets = range(0, end, params.vt_step_match)
        if self.columns <= 2 * self.margin:
            raise ValueError(f"vt_shift_match {self.margin} leaves nothing of {self.columns} columns")
        self.pixels = self.rows * (self.columns - 2 * self.margin)

    def shape(self, view: Array) -> Array:
        """A flat view as rows and columns."""
        return view.reshape(self.rows, self.columns)

    def errors(self, view: Array, stored: Array) -> Array:
        """[template, offset] mean absolute differences of a view [y, x] from stored ones [template, y, x]."""
        X, S = self.columns, self.margin
        seen = view[:, S : X - S]
        table = np.empty((len(stored), len(self.offsets)))
        for n, o in enumerate(self.offsets):
            shifted = np.roll(stored, -o, axis=2) if self.panoramic else stored[:, :, o : o + X - 2 * S]
            table[:, n] = np.abs(seen - shifted).sum(axis=(1, 2))
        return table / self.pixels

    def turn(self, offset: int) -> float:
        """Heading of a panoramic view found at `offset`, rad."""
        return wrap(offset / self.columns * 2 * pi) if self.panoramic else 0.0


class GivenViews:
    """A stream whose views are already recognised: a row is (template id, relative heading)."""

    def __init__(self) -> None:
        self.count = 0

    def match(self, view: Array) -> Match:
        """The id as given; a new one must be the next."""
        template, relative = int(view[0]), float(view[1])
        self.count = max(self.count, template + 1)
        return Match(template, relative, 0.0)
