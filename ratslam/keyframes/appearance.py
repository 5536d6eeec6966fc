"""What the map knows of the looks of its frames, and what it tells recall of them: given ids, views, touch.

Each keeps the looks of all frames, tells recall by what measure to compare them, and answers how badly a
frame would fit somewhere else. What has to be known about the sensor is found out from the session itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from ratslam.core.backend import Evidence
from ratslam.core.growable_array import GrowableArray
from ratslam.keyframes.view_sectors import NO_ESTIMATE, BiasEstimate, SectorFan
from ratslam.recall.memory import NO_LIKENESS
from ratslam.recall.whisker_likelihood import Pixels, background, levels, table, variation
from tactile.base.types import Observation

EVERY = 16
"""Frames between two looks at the bias that the views show."""
EARLIEST = 40
"""Frames before the first, and before images are compared."""
ENOUGH = 400
"""Errors against ruled-out frames before their quantile is taken for the scale of errors."""
BACKGROUND = (0.005, 0.01, 0.02, 0.04, 0.08)
"""The quantiles whose geometric mean is the scale: errors so small are still seen between different places.
Several, because the errors of places that look exactly alike make a step in the quantiles, and a scale taken
from one quantile falls down that step."""
ALIKE = 1e-3
"""Least such quantile, as a share of the largest: places may look alike to the last bit."""
LEARN = 40
"""Frames between two lessons in the likeness of whisker images."""
NEVER = 3.0
"""Log-odds that stand for a whisker image never felt before."""
DOUBT = 0.5
"""How much a frame misfits where there is nothing to compare it with."""
UNTOLD = float(np.log(2))
"""The same for whisker images: what one misfits that says nothing."""


class ViewMetric(NamedTuple):
    """What recall compares by: see `MapFeedback`."""

    angle: float
    scale: float
    likeness: np.ndarray


class ConfirmedPairs(NamedTuple):
    """Pairs of frames [P] that the map takes for one place, and whether one was turned about [P] bool."""

    frame: np.ndarray
    match: np.ndarray
    about: np.ndarray


class Appearance(Protocol):
    """The looks of all frames."""

    def measure(self) -> ViewMetric:
        """What recall compares by now."""

    def append(self, observation: Observation, turn: float, length: float) -> None:
        """One more frame: what was seen, and turn (rad) and way (m) since the one before."""

    def learn(self, evidence: Evidence, known: Callable[[], ConfirmedPairs]) -> BiasEstimate:
        """Takes up what the newest frame's recollection tells, and asks, now and then, for pairs that the map
        is sure of; answers the heading bias that the views show, if it was looked at."""

    def misfit(self, frame: int, near: np.ndarray, about: np.ndarray) -> float:
        """How badly a frame would fit among frames [n], faced as they are or turned `about` [n]; 0 and up."""

    def arrays(self) -> dict[str, np.ndarray]:
        """All of its state."""

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""


class LabelAppearance:
    """Ids given with the recording."""

    def __init__(self) -> None:
        self._label = GrowableArray((), np.int64)

    def measure(self) -> ViewMetric:
        return ViewMetric(0.0, 0.0, NO_LIKENESS)

    def append(self, observation: Observation, turn: float, length: float) -> None:
        self._label.append(int(observation.label))

    def learn(self, evidence: Evidence, known: Callable[[], ConfirmedPairs]) -> BiasEstimate:
        return NO_ESTIMATE

    def misfit(self, frame: int, near: np.ndarray, about: np.ndarray) -> float:
        if not len(near):
            return DOUBT
        return float(not np.any(self._label.rows[near] == self._label.rows[frame]))

    def arrays(self) -> dict[str, np.ndarray]:
        return {"label": self._label.rows.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self._label.replace(arrays["label"])


class ViewAppearance:
    """Views that are compared by their mean absolute difference.

    Args:
        size: values of a view. fan: its width in rad, 0: to be found out; None: not a fan. normalise: what
            recall does to a view before it compares it.
    """

    def __init__(
        self, size: int, fan: float | None, normalise: Callable[[np.ndarray], np.ndarray] = np.asarray
    ) -> None:
        self._normalise = normalise
        self._fan = None if fan is None or not size else SectorFan(size, fan / size)
        self._view = GrowableArray((size,), np.float64)
        self._background = GrowableArray((), np.float64)
        self._scale = (0, 0.0)  # errors it was taken from, and the scale

    def measure(self) -> ViewMetric:
        return ViewMetric(self._fan.angle if self._fan else 0.0, self._scale[1], NO_LIKENESS)

    def append(self, observation: Observation, turn: float, length: float) -> None:
        size = self._view.rows.shape[1]
        view = self._normalise(np.asarray(observation.view, float)) if size else np.zeros(0)
        self._view.append(np.asarray(view, float).reshape(-1)[:size])
        if self._fan:
            self._fan.append(self._view.rows[-1], turn, length)

    def learn(self, evidence: Evidence, known: Callable[[], ConfirmedPairs]) -> BiasEstimate:
        for error in np.asarray(evidence.background)[np.isfinite(evidence.background)]:
            self._background.append(error)
        self._rescale()
        count = len(self._view.rows) - 1
        if self._fan is None or count % EVERY or count < EARLIEST:
            return NO_ESTIMATE
        before, told = self._fan.angle, self._fan.estimate()
        if not before and self._fan.angle:
            # Errors are smaller now that views may shift: those known so far are of another kind.
            self._background.replace(self._background.rows[:0])
            self._scale = 0, 0.0
        return told

    def misfit(self, frame: int, near: np.ndarray, about: np.ndarray) -> float:
        """0..1: the error of the best of them, against the scale."""
        if not len(near):
            return DOUBT
        apart = np.abs(self._view.rows[near] - self._view.rows[frame]).mean(axis=1).min()
        return float(min(apart / max(2 * self._scale[1], 1e-300), 1.0))

    def _rescale(self) -> None:
        """The error below which different places seldom come; taken anew when a tenth more is known."""
        count = len(self._background.rows)
        if count >= max(ENOUGH, 1.1 * self._scale[0]):
            small = np.quantile(self._background.rows, BACKGROUND)
            # As shares of the largest, so that the sensor's unit drops out to the last bit.
            share = small / small[-1] if small[-1] > 0 else small
            scale = float(small[-1] * np.exp(np.log(np.maximum(share, ALIKE)).mean()))
            self._scale = count, scale

    def arrays(self) -> dict[str, np.ndarray]:
        kept = {"view": self._view.rows.copy(), "background": self._background.rows.copy()}
        kept["scale"] = np.array(self._scale)
        return kept | {
            f"fan/{name}": rows for name, rows in (self._fan.arrays() if self._fan else {}).items()
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self._view.replace(arrays["view"])
        self._background.replace(arrays["background"])
        count, scale = np.asarray(arrays["scale"])
        self._scale = int(count), float(scale)
        if self._fan:
            self._fan.restore(
                {name.removeprefix("fan/"): rows for name, rows in arrays.items() if name.startswith("fan/")}
            )


class WhiskerAppearance:
    """Whisker images, compared by log-odds that are learned from the session.

    Args:
        temper: share of the log-odds that counts, see `RecallConfig`. normalise: what recall does to an image
            before it compares it.
    """

    def __init__(
        self, pixels: Pixels, temper: float, normalise: Callable[[np.ndarray], np.ndarray] = np.asarray
    ) -> None:
        self._pixels, self._temper, self._normalise = pixels, temper, normalise
        self._level = GrowableArray((len(pixels.group),), np.int64)
        self._likeness = NO_LIKENESS

    def measure(self) -> ViewMetric:
        return ViewMetric(np.pi, NEVER if self._likeness.size else 0.0, self._likeness)

    def append(self, observation: Observation, turn: float, length: float) -> None:
        view = self._normalise(np.asarray(observation.view, float))
        self._level.append(levels(view.reshape(-1), alive(observation).reshape(-1)).astype(np.int64))

    def learn(self, evidence: Evidence, known: Callable[[], ConfirmedPairs]) -> BiasEstimate:
        if len(self._level.rows) >= EARLIEST and len(self._level.rows) % LEARN == 0:
            frame, match, about = known()
            image, pixels = self._level.rows, self._pixels
            then = np.where(about[:, None], image[match][:, pixels.behind], image[match])
            common = background(image, pixels.group)
            self._likeness = table(common, variation(image[frame], then))
        return NO_ESTIMATE

    def misfit(self, frame: int, near: np.ndarray, about: np.ndarray) -> float:
        """By how much the image is less likely there than the likeliest there is, at most."""
        if not len(near) or not self._likeness.size:
            return UNTOLD
        image, pixels = self._level.rows, self._pixels
        then = np.where(about[:, None], image[near][:, pixels.behind], image[near])
        odds = self._likeness[pixels.group, image[frame], then].sum(axis=1).max()
        return float(np.log1p(np.exp(-self._temper * odds)))

    def arrays(self) -> dict[str, np.ndarray]:
        return {"level": self._level.rows.copy(), "likeness": self._likeness.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self._level.replace(arrays["level"])
        self._likeness = np.asarray(arrays["likeness"], float)


def alive(observation: Observation) -> np.ndarray:
    """[R, C, K] bool, the pixels whose whiskers report; all of them where nothing is said about whiskers."""
    rows, columns, channels = np.shape(observation.view)
    told = np.asarray(observation.alive)
    if told.size != rows * columns:
        return np.ones((rows, columns, channels), bool)
    return np.repeat(told.reshape(rows, columns, 1), channels, axis=2)
