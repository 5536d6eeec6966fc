"""Signed touch images of the keyframes, compared by log-odds that are learned from the session."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ratslam.core.backend import Evidence
from ratslam.core.growable_array import GrowableArray
from ratslam.mapping.appearance import (
    LOG_ODDS_INTERVAL,
    MIN_KEYFRAMES,
    NEUTRAL_IMAGE_MISFIT,
    NEW_IMAGE_LOG_ODDS,
    Appearance,
    ConfirmedPairs,
    ViewMetric,
)
from ratslam.mapping.view_sectors import NO_ESTIMATE, BiasEstimate
from ratslam.recall.memory import NO_LIKENESS
from ratslam.recall.signed_likelihood import ImagePairs, learn, log_odds, pack, project, stored_image, unpack
from ratslam.recall.whisker_likelihood import live_pixels
from tactile.base.types import Observation

APART = np.arange(1, 9) / 9
"""Shares of all keyframes by which the second image of a pair of different places is moved on in memory."""


class SignedAppearance(Appearance):
    """Images of signed pixels compared by the two-covariance model (`ratslam.recall.signed_likelihood`).

    Args:
        size: number of pixels of an image, D.
    """

    VALUES = ("_likeness",)

    def __init__(self, size: int) -> None:
        self._image = GrowableArray((size,), np.float64)
        self._likeness = NO_LIKENESS

    def metric(self) -> ViewMetric:
        return ViewMetric(0.0, NEW_IMAGE_LOG_ODDS if self._likeness.size else 0.0, self._likeness)

    def view_of(self, observation: Observation) -> np.ndarray:
        view = np.asarray(observation.view, float).reshape(-1)
        return stored_image(view, live_pixels(observation).reshape(-1))

    def append(self, observation: Observation, turn: float, length: float) -> None:
        self._image.append(self.view_of(observation))

    def extend(self, other: Appearance) -> None:
        assert isinstance(other, SignedAppearance)
        self._image.extend(other._image.rows)

    def relearn(self, pairs: ConfirmedPairs) -> None:
        images, count = self._image.rows, len(self._image.rows)
        row = np.arange(count)
        moved = (row + (count * APART[:, None]).astype(int)) % count
        apart = np.column_stack([np.tile(row, len(APART)), moved.ravel()])
        known = ImagePairs(images[pairs.frame], images[pairs.match])
        self._likeness = pack(learn(images, known, apart))

    def take(self, frames: np.ndarray) -> None:
        self._image.replace(self._image.rows[frames])

    def stored(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._image.rows[frames], np.full(len(frames), -1)

    def learn(self, evidence: Evidence, confirmed_pairs: Callable[[], ConfirmedPairs]) -> BiasEstimate:
        count = len(self._image.rows)
        if count >= MIN_KEYFRAMES and count % LOG_ODDS_INTERVAL == 0:
            self.relearn(confirmed_pairs())
        return NO_ESTIMATE

    def unlikeness(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """Negative log-odds; zeros while these are not learned."""
        if not self._likeness.size:
            return np.zeros(len(others))
        model, images = unpack(self._likeness), self._image.rows
        first = project(model, images[np.atleast_1d(frame)].T)
        return -log_odds(model, first, project(model, images[others].T))

    def log_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        return -self.unlikeness(frame, others, reversed)

    def misfit(self, frame: int, near: np.ndarray, reversed: np.ndarray) -> float:
        """log(1 + 1 / odds) of the most similar of the keyframes."""
        if not len(near) or not self._likeness.size:
            return NEUTRAL_IMAGE_MISFIT
        return float(np.log1p(np.exp(self.unlikeness(frame, near, reversed).min())))
