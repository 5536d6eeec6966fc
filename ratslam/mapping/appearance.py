"""Views of the keyframes and the metric by which recall compares them: camera views, whisker images, ids.

Each class stores the views of all keyframes, gives recall its metric, and measures how badly a keyframe
would fit at another pose (its misfit). The properties of the sensor are estimated from the session itself:
the scale of view errors, the log-odds of whisker levels, the covariances of signed touch images.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from copy import copy, deepcopy
from typing import ClassVar, NamedTuple

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.core.backend import Evidence
from ratslam.mapping.ground import NEAR, GainPrior
from ratslam.mapping.odometry_calibration import NO_ESTIMATE, BiasEstimate, SectorFan
from ratslam.recall.memory import NO_LIKENESS
from ratslam.recall.observation_model import label_gains
from ratslam.recall.signed_likelihood import learn, log_odds, pack, project, stored_image, unpack
from ratslam.recall.whisker_likelihood import (
    PixelLayout,
    estimate_background,
    estimate_variation,
    live_pixels,
    log_odds_table,
    pixel_levels,
)
from tactile.base.compiled import compiled
from tactile.base.types import Observation

BIAS_INTERVAL = 16
"""Keyframes between two estimates of the heading bias from views."""
MIN_KEYFRAMES = 40
"""Keyframes before the first estimate, of the heading bias or of log-odds."""
MIN_ERRORS = 400
"""Errors against ruled-out keyframes before the scale of errors is estimated."""
QUANTILES = (0.005, 0.01, 0.02, 0.04, 0.08)
"""Quantiles of the errors between different places, whose geometric mean is the scale. There are several,
because identical places make a step in the quantiles, and one quantile alone could lie below the step."""
LEAST_QUANTILE = 1e-3
"""Least such quantile as a share of the largest, because views of different places may be identical."""
LOG_ODDS_INTERVAL = 40
"""Keyframes between two estimates of the log-odds of whisker images."""
NEW_IMAGE_LOG_ODDS = 3.0
"""Log-odds of a whisker image never seen before."""
NEUTRAL_MISFIT = 0.5
"""Misfit of a keyframe without others to compare it with."""
NEUTRAL_IMAGE_MISFIT = float(np.log(2))
"""Misfit of a whisker image without evidence."""


Normalise = Callable[[np.ndarray], np.ndarray]
"""The preprocessing of views that recall uses."""


class ViewMetric(NamedTuple):
    """The metric of recall; see `MapFeedback`."""

    angle: float
    scale: float
    likeness: np.ndarray


class Appearance(Checkpointed, ABC):
    """Views of all keyframes."""

    VIEWS: ClassVar[str]
    """Name of the array of the views, one row for each keyframe."""
    NEAR_SHARE: ClassVar = NEAR
    """See `Ground.near_share`."""
    JUDGED: ClassVar = False
    """Whether `ratslam.mapping.closure_judge` has weights for such views."""

    @property
    def _views(self) -> GrowableArray:
        views: GrowableArray = getattr(self, self.VIEWS)
        return views

    def present(self) -> Appearance:
        """The present metric with the views so far, whose memory is shared: a view never changes."""
        other = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, GrowableArray):  # views added or replaced later are not those of the copy
                setattr(other, name, copy(value))
        for name in self.PARTS:
            setattr(other, name, deepcopy(getattr(self, name)))
        return other

    @abstractmethod
    def metric(self) -> ViewMetric:
        """The present metric of recall."""

    @abstractmethod
    def view_of(self, observation: Observation) -> np.ndarray:
        """[D] the view of an observation, as `stored` gives it of a keyframe."""

    def append(self, observation: Observation, turn: float, length: float) -> None:
        """Adds a keyframe, after a turn (rad) and a distance (m) since the one before."""
        self._views.append(self.view_of(observation))

    def learn(self, evidence: Evidence, confirmed_pairs: Callable[[], np.ndarray]) -> BiasEstimate:
        """Updates the metric from the newest keyframe's evidence and, at intervals, from confirmed pairs.

        Returns:
            the heading bias that the views show, `NO_ESTIMATE` if it was not estimated.
        """
        return NO_ESTIMATE

    def extend(self, other: Appearance) -> None:
        """Adds the views of another map of the same sensor; the metric is learned anew by `relearn`."""
        self._views.extend(other._views.rows)

    def gain_prior(self, usual: GainPrior) -> GainPrior:
        """Gains of views before any were counted; `usual` if nothing else is known of them."""
        return usual

    def relearn(self, pairs: np.ndarray) -> None:
        """Learns the metric anew from all views and confirmed pairs [P, 3], see
        `Archive.confirmed_pairs`."""

    def take(self, frames: np.ndarray) -> None:
        """Reduces the views to those of keyframes [n]; what was learned of the sensor stays."""
        self._views.replace(self._views.rows[frames])

    def stored(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The views [n, D] and ids [n], -1 for none, of keyframes [n], as recall stores them."""
        return self._views.rows[frames], np.full(len(frames), -1)

    @abstractmethod
    def misfits(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """[n] misfit of the view of a keyframe, or of each of the keyframes [n], and that of each of the
        keyframes `others` [n], in units of its own; `reversed` as in `least_misfit`."""

    @abstractmethod
    def log_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """[n] log-odds that the view of a keyframe and that of each of the keyframes `others` [n] are of
        one place, nat; `reversed` as in `least_misfit`."""

    @abstractmethod
    def least_misfit(self, frame: int, near: np.ndarray, reversed: np.ndarray) -> float:
        """Misfit of a keyframe with the most similar of the keyframes [n], seen in the same or in the
        opposite direction (`reversed` [n] bool); 0 or more."""


class ViewAppearance(Appearance):
    """Views compared by their mean absolute difference.

    Args:
        size: number of values of a view. fan: field of view, rad; 0: to be estimated; None: the views are
            not ordered sectors. normalise: the preprocessing of recall.
    """

    VIEWS = "_view"
    VALUES = ("_scale",)
    PARTS = ("_fan",)

    def __init__(self, size: int, fan: float | None, normalise: Normalise = np.asarray) -> None:
        self._normalise = normalise
        self._fan = None if fan is None or not size else SectorFan(size, fan / size)
        self._view = GrowableArray((size,), np.float64)
        self._background = GrowableArray((), np.float64)
        self._scale = (0, 0.0)  # number of errors it was estimated from, and the scale

    def metric(self) -> ViewMetric:
        return ViewMetric(self._fan.angle if self._fan else 0.0, self._scale[1], NO_LIKENESS)

    def view_of(self, observation: Observation) -> np.ndarray:
        size = self._view.rows.shape[1]
        view = self._normalise(np.asarray(observation.view, float)) if size else np.zeros(0)
        return np.asarray(view, float).reshape(-1)[:size]

    def append(self, observation: Observation, turn: float, length: float) -> None:
        super().append(observation, turn, length)
        if self._fan:
            self._fan.append(self._view.rows[-1], turn, length)

    def extend(self, other: Appearance) -> None:
        assert isinstance(other, ViewAppearance)
        if self._fan and other._fan and len(other._view.rows) > len(self._view.rows):
            self._fan = deepcopy(other._fan)  # the longer session knows the sectors better
        super().extend(other)
        self._background.extend(other._background.rows)

    def relearn(self, pairs: np.ndarray) -> None:
        self._scale = 0, self._scale[1]
        self._rescale()

    def learn(self, evidence: Evidence, confirmed_pairs: Callable[[], np.ndarray]) -> BiasEstimate:
        errors = np.asarray(evidence.background)
        self._background.extend(errors[np.isfinite(errors)])
        self._rescale()
        count = len(self._view.rows) - 1
        if self._fan is None or count % BIAS_INTERVAL or count < MIN_KEYFRAMES:
            return NO_ESTIMATE
        before, estimate = self._fan.angle, self._fan.estimate()
        if not before and self._fan.angle:
            # Shifted views have smaller errors, so the errors so far no longer count.
            self._background.replace(self._background.rows[:0])
            self._scale = 0, 0.0
        return estimate

    def misfits(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """Mean absolute differences."""
        return _mean_differences(self._view.rows, np.broadcast_to(frame, len(others)), others)

    def log_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """1 for equal views, 0 at the scale of errors, which few different places stay below."""
        return 1 - self.misfits(frame, others, reversed) / max(self._scale[1], 1e-300)

    def least_misfit(self, frame: int, near: np.ndarray, reversed: np.ndarray) -> float:
        """0..1: the smallest error against the keyframes, relative to twice the scale."""
        if not len(near):
            return NEUTRAL_MISFIT
        error = self.misfits(frame, near, reversed).min()
        return float(min(error / max(2 * self._scale[1], 1e-300), 1.0))

    def _rescale(self) -> None:
        """Estimates the scale when there are a tenth more errors than at the last estimate."""
        count = len(self._background.rows)
        if count >= max(MIN_ERRORS, 1.1 * self._scale[0]):
            small = np.quantile(self._background.rows, QUANTILES)
            # As shares of the largest, so that the result does not depend on the sensor's unit.
            share = small / small[-1] if small[-1] > 0 else small
            scale = float(small[-1] * np.exp(np.log(np.maximum(share, LEAST_QUANTILE)).mean()))
            self._scale = count, scale


class _LearnedAppearance(Appearance):
    """Images compared by log-odds that are learned from the session.

    Args:
        temper: factor on the log-odds, see `RecallConfig`. angle: turn per sector shift, rad.
    """

    VALUES = ("_likeness",)

    def __init__(self, temper: float, angle: float) -> None:
        self._temper, self._angle, self._likeness = temper, angle, NO_LIKENESS

    def metric(self) -> ViewMetric:
        return ViewMetric(self._angle, NEW_IMAGE_LOG_ODDS if self._likeness.size else 0.0, self._likeness)

    def learn(self, evidence: Evidence, confirmed_pairs: Callable[[], np.ndarray]) -> BiasEstimate:
        count = len(self._views.rows)
        if count >= MIN_KEYFRAMES and count % LOG_ODDS_INTERVAL == 0:
            self.relearn(confirmed_pairs())
        return NO_ESTIMATE

    @abstractmethod
    def learned_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """`log_odds`, once they are learned, without the temper."""

    def misfits(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        """Negative log-odds; zeros while these are not learned."""
        if not self._likeness.size:
            return np.zeros(len(others))
        return -self.learned_odds(frame, others, reversed)

    def log_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        return -self._temper * self.misfits(frame, others, reversed)

    def least_misfit(self, frame: int, near: np.ndarray, reversed: np.ndarray) -> float:
        """log(1 + 1 / odds) of the most similar of the keyframes."""
        if not len(near) or not self._likeness.size:
            return NEUTRAL_IMAGE_MISFIT
        return float(np.log1p(np.exp(self._temper * self.misfits(frame, near, reversed).min())))


class WhiskerAppearance(_LearnedAppearance):
    """Whisker images compared by the log-odds of the levels of their pixels.

    Args:
        temper: see `_LearnedAppearance`. normalise: the preprocessing of recall. half_turns: whether images
            are also compared as seen in the opposite direction.
    """

    VIEWS = "_level"
    JUDGED = True

    def __init__(
        self, pixels: PixelLayout, temper: float, normalise: Normalise = np.asarray, half_turns: bool = True
    ) -> None:
        super().__init__(temper, np.pi if half_turns else 0.0)
        self.layout, self._normalise = pixels, normalise
        self._level = GrowableArray((len(pixels.group),), np.int64)

    def view_of(self, observation: Observation) -> np.ndarray:
        view = self._normalise(np.asarray(observation.view, float))
        return pixel_levels(view.reshape(-1), live_pixels(observation).reshape(-1)).astype(np.int64)

    def relearn(self, pairs: np.ndarray) -> None:
        frame, match, reversed = pairs.T
        images, opposite = self._level.rows, self.layout.opposite
        # Matches that face the opposite way are compared as seen in that direction.
        matched = np.where(reversed[:, None] > 0, images[match][:, opposite], images[match])
        variation = estimate_variation(images[frame], matched)
        self._likeness = log_odds_table(estimate_background(images, self.layout.group), variation)

    def learned_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        (group, opposite), images = self.layout, self._level.rows
        frames = np.broadcast_to(frame, len(others))
        return summed_log_odds(self._likeness, group, images, opposite, frames, others, reversed)


@compiled
def _mean_differences(views: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] mean absolute differences of the views [N, D] numbered a [n] and b [n]."""
    found = np.empty(len(a))
    for k in range(len(a)):
        total = 0.0
        for d in range(views.shape[1]):
            total += abs(views[a[k], d] - views[b[k], d])
        found[k] = total / views.shape[1]
    return found


@compiled
def summed_log_odds(
    table: np.ndarray,
    group: np.ndarray,
    levels: np.ndarray,
    opposite: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    reversed: np.ndarray,
) -> np.ndarray:
    """[n] log-odds that the images numbered a [n] and b [n] are of one place.

    Args:
        table: [G, L, L] log-odds by group of pixels and the levels of both. group: [D] of each pixel.
        levels: [N, D] the images. opposite: [D] the pixel at the other side of the head.
        reversed: [n] bool, whether image b is seen in the opposite direction.
    """
    found = np.empty(len(a))
    for k in range(len(a)):
        total = 0.0
        for d in range(len(group)):
            other = opposite[d] if reversed[k] else d
            total += table[group[d], levels[a[k], d], levels[b[k], other]]
        found[k] = total
    return found


@compiled
def near_facing(poses: np.ndarray, frames: np.ndarray, guard: int, reach: float, facing: float) -> np.ndarray:
    """[F, N] int8: for each of the keyframes `frames` [F], which older ones are near it: 1 those that face
    alike, -1 those that face the opposite way, 0 all others.

    Args:
        poses: [N, 3]. guard: number of newest keyframes before each that do not count. reach: largest
            distance, m. facing: least cosine of the difference in heading, or in opposite headings.
    """
    ahead, aside = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    found = np.zeros((len(frames), len(poses)), np.int8)
    for row in range(len(frames)):
        k = frames[row]
        for other in range(k - guard):
            dx, dy = poses[other, 0] - poses[k, 0], poses[other, 1] - poses[k, 1]
            if dx * dx + dy * dy < reach * reach:
                cosine = ahead[other] * ahead[k] + aside[other] * aside[k]
                if abs(cosine) > facing:
                    found[row, other] = 1 if cosine > 0 else -1
    return found


SAME_ID_LOG_ODDS = 3.0
"""Log-odds of one place where the given ids are equal, and against it where they differ."""
LABEL_SPREAD = 0.5
"""Standard deviation of the gain of an id, some of which were seen at several keyframes, nat."""


class LabelAppearance(Appearance):
    """Ids given with the recording. They are seen from anywhere within reach of a place."""

    VIEWS = "_label"
    NEAR_SHARE = 1.0

    def __init__(self) -> None:
        self._label = GrowableArray((), np.int64)

    def metric(self) -> ViewMetric:
        return ViewMetric(0.0, 0.0, NO_LIKENESS)

    def view_of(self, observation: Observation) -> np.ndarray:
        return np.zeros(0)

    def append(self, observation: Observation, turn: float, length: float) -> None:
        self._label.append(int(observation.label))

    def gain_prior(self, usual: GainPrior) -> GainPrior:
        """An id is the same at a true pose, and another one at a false pose."""
        same, other = label_gains(len(np.unique(self._label.rows)))
        return (same, LABEL_SPREAD), (other, LABEL_SPREAD)

    def stored(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((len(frames), 0)), self._label.rows[frames]

    def misfits(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        return (self._label.rows[others] != self._label.rows[frame]).astype(float)

    def log_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        return SAME_ID_LOG_ODDS * (1 - 2 * self.misfits(frame, others, reversed))

    def least_misfit(self, frame: int, near: np.ndarray, reversed: np.ndarray) -> float:
        if not len(near):
            return NEUTRAL_MISFIT
        return float(self.misfits(frame, near, reversed).min())


APART = np.arange(1, 9) / 9
"""Shares of all keyframes by which the second image of a pair of different places is moved on in memory."""


class SignedAppearance(_LearnedAppearance):
    """Images of signed pixels compared by the two-covariance model (`ratslam.recall.signed_likelihood`).

    Args:
        size: number of pixels of an image, D.
    """

    VIEWS = "_image"

    def __init__(self, size: int) -> None:
        super().__init__(1.0, 0.0)
        self._image = GrowableArray((size,), np.float64)

    def view_of(self, observation: Observation) -> np.ndarray:
        view = np.asarray(observation.view, float).reshape(-1)
        return stored_image(view, live_pixels(observation).reshape(-1))

    def relearn(self, pairs: np.ndarray) -> None:
        images, count = self._image.rows, len(self._image.rows)
        row = np.arange(count)
        moved = (row + (count * APART[:, None]).astype(int)) % count
        apart = np.column_stack([np.tile(row, len(APART)), moved.ravel()])
        self._likeness = pack(learn(images, images[pairs[:, :2].T], apart))

    def learned_odds(self, frame: int | np.ndarray, others: np.ndarray, reversed: np.ndarray) -> np.ndarray:
        model, images = unpack(self._likeness), self._image.rows
        first = project(model, images[np.atleast_1d(frame)].T)
        return log_odds(model, first, project(model, images[others].T))
