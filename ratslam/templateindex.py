"""Which of very many views a view looks like: exact, on the host, without comparing it with all of them.

Views are points, their mean absolute difference is a distance, and within a threshold few points are near: a
KD-tree finds them. Trees do not grow, so new views wait in a short tail that is compared one by one, and
trees of ever larger size take them over (Bentley & Saxe 1980). Says what `templates.match_view` says of views
that are not shifted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

TIE = 1e-9
"""Errors this close tie, as in `ratslam.classic.view_templates`: the earliest template wins."""

TAIL = 256
"""Views that are compared one by one before a tree takes them over."""

RATIO = 8
"""A tree is built anew when what came after it has an eighth of its size: so there are few trees."""


class Nearest(NamedTuple):
    """The earliest best template and its mean absolute difference; -1 and infinity where none is within the
    threshold."""

    template: int
    error: float


class _Block(NamedTuple):
    """A tree over the views from `start` on."""

    start: int
    tree: cKDTree


class TemplateIndex:
    """Views of D values each, numbered as they come.

    Attributes:
        threshold: largest mean absolute difference of a match, in units of the values.
        built: views put into trees so far, again and again: what appending has cost.
    """

    def __init__(self, size: int, threshold: float) -> None:
        if size < 1 or not 0 <= threshold < np.inf:
            raise ValueError(
                f"views of {size} values and threshold {threshold}: expected 1 or more, and 0 or more"
            )
        self.threshold, self.built = threshold, 0
        self._room, self._count = np.zeros((TAIL, size)), 0
        self._blocks: list[_Block] = []

    def __len__(self) -> int:
        return self._count

    @property
    def views(self) -> np.ndarray:
        """[N, D] all views, not to be written to."""
        return self._room[: self._count]

    def append(self, view: np.ndarray) -> int:
        """Adds a view of D values; returns its number."""
        self.extend(np.reshape(view, (1, -1)))
        return self._count - 1

    def extend(self, views: np.ndarray) -> None:
        """Adds views [M, D]; many at once cost one tree."""
        views = np.asarray(views, float)
        if views.ndim != 2:
            raise ValueError(f"views of shape {views.shape}: expected [M, {self._room.shape[1]}]")
        self._check(views)
        count = self._count + len(views)
        if count > len(self._room):
            # Trees keep the room they were built on: nothing written there changes again.
            room = np.zeros((max(count, 2 * len(self._room)), self._room.shape[1]))
            room[: self._count] = self.views
            self._room = room
        self._room[self._count : count] = views
        self._count = count
        self._settle()

    def query(self, view: np.ndarray) -> Nearest:
        """The template that a view of D values looks like."""
        view = np.asarray(view, float).ravel()
        self._check(view)
        limit, tail = self.threshold + TIE, self._tail()
        errors = _errors(self._room[tail : self._count], view)
        best, near = errors.min(initial=np.inf), []
        for block in self._blocks:  # the largest first: what it finds, the others need not look beyond
            reach = (min(best, limit) + 2 * TIE) * len(view)
            _, row = block.tree.query(view, p=1, distance_upper_bound=reach)
            if row < block.tree.n:
                best = min(best, _errors(block.tree.data[[row]], view)[0])
                near.append(block)
        if best > limit:
            return Nearest(-1, np.inf)
        for block in near:  # the earliest first
            rows = np.sort(block.tree.query_ball_point(view, (best + 2 * TIE) * len(view), p=1)).astype(int)
            tied = rows[_errors(block.tree.data[rows], view) <= best + TIE]
            if len(tied):
                return Nearest(block.start + int(tied[0]), float(best))
        return Nearest(tail + int(np.argmax(errors <= best + TIE)), float(best))

    def _tail(self) -> int:
        return self._blocks[-1].start + self._blocks[-1].tree.n if self._blocks else 0

    def _settle(self) -> None:
        start = self._tail()
        if self._count - start < TAIL:
            return
        while self._blocks and self._blocks[-1].tree.n <= RATIO * (self._count - start):
            start = self._blocks.pop().start
        # Not balanced: medians among views of few values leave boxes that overlap at their faces.
        tree = cKDTree(self._room[start : self._count], balanced_tree=False)
        self._blocks.append(_Block(start, tree))
        self.built += tree.n

    def _check(self, views: np.ndarray) -> None:
        if views.shape[-1] != self._room.shape[1]:
            raise ValueError(f"views of {views.shape[-1]} values: expected {self._room.shape[1]}")
        if not np.isfinite(views).all():
            raise ValueError("a view with a value that is not finite looks like nothing")


def _errors(views: np.ndarray, view: np.ndarray) -> np.ndarray:
    """[N] mean absolute differences of views [N, D] from a view [D]."""
    return np.abs(views - view).sum(axis=1) / len(view)
