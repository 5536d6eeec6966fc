"""Ids of the keyframes, given with the recording, of places or of markers."""

from __future__ import annotations

import numpy as np

from ratslam.alignment.gain_odds import GainPrior
from ratslam.core.growable_array import GrowableArray
from ratslam.keyframes.appearance import NEUTRAL_MISFIT, Appearance, ViewMetric
from ratslam.recall.memory import NO_LIKENESS
from ratslam.recall.observation_model import label_gains
from tactile.base.types import Observation

SAME_ID_LOG_ODDS = 3.0
"""Log-odds of one place where the given ids are equal, and against it where they differ."""
LABEL_SPREAD = 0.5
"""Standard deviation of the gain of an id, some of which were seen at several keyframes, nat."""


class LabelAppearance(Appearance):
    """Ids given with the recording. They are seen from anywhere within reach of a place."""

    NEAR_SHARE = 1.0

    def __init__(self) -> None:
        self._label = GrowableArray((), np.int64)

    def metric(self) -> ViewMetric:
        return ViewMetric(0.0, 0.0, NO_LIKENESS)

    def view_of(self, observation: Observation) -> np.ndarray:
        return np.zeros(0)

    def append(self, observation: Observation, turn: float, length: float) -> None:
        self._label.append(int(observation.label))

    def extend(self, other: Appearance) -> None:
        assert isinstance(other, LabelAppearance)
        self._label.extend(other._label.rows)

    def gain_prior(self, usual: GainPrior) -> GainPrior:
        """An id is the same at a true pose, and another one at a false pose."""
        same, other = label_gains(len(np.unique(self._label.rows)))
        return GainPrior(true=(same, LABEL_SPREAD), false=(other, LABEL_SPREAD))

    def take(self, frames: np.ndarray) -> None:
        self._label.replace(self._label.rows[frames])

    def stored(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((len(frames), 0)), self._label.rows[frames]

    def unlikeness(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        return (self._label.rows[others] != self._label.rows[frame]).astype(float)

    def log_odds(self, frame: int, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        return SAME_ID_LOG_ODDS * (1 - 2 * self.unlikeness(frame, others, reversed))

    def misfit(self, frame: int, near: np.ndarray, reversed: np.ndarray) -> float:
        if not len(near):
            return NEUTRAL_MISFIT
        return float(self.unlikeness(frame, near, reversed).min())
