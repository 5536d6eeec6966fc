"""Views that are fans of ordered sectors: whether they are, how wide a sector is, what they tell of drift.

A robot that turns sees a laser or sonar fan move sideways by its turn; a view without such order does not.
So consecutive views tell whether sectors are ordered and how wide they are, and then, better than wheels do,
how far the robot really turned: the part of the odometry's heading error that grows with the way, the bias.
No truth is used. The estimators are ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.core.growable_array import GrowableArray

FIELDS_OF_VIEW = np.radians([sign * width for width in (60, 90, 120, 180, 240, 270, 360) for sign in (1, -1)])
"""Widths of fans that sensors have and that views can tell apart, rad; negative: clockwise."""
SURE = 3.0
"""Standard errors by which shifted views must agree better than unshifted ones."""
PLAIN = 0.1
"""Share of the unshifted difference that shifting must explain: chance may be sure of a trifle."""
FEWEST = 20
"""Turns to see before views are called a fan, and pairs before they tell a bias."""
LAGS = (1, 2)
"""Frames between the views compared for the bias: two answers whose difference shows their error."""
SCAN = np.arange(-2, 2.01, 0.125)
"""Sectors around the odometry's turn in which the views' own turn is looked for."""
BLOCKS = 12
"""Parts of a recording that are left out in turn to tell the standard error (jackknife)."""


class BiasEstimate(NamedTuple):
    """Heading error by way, rad/m, and its standard error."""

    value: float
    error: float


NO_ESTIMATE = BiasEstimate(0.0, np.inf)


class SectorFan:
    """What the views of consecutive frames tell; one row for each frame.

    Args:
        size: values of a view. angle: of a sector, counter-clockwise positive, rad; 0: to be found out.
    """

    def __init__(self, size: int, angle: float) -> None:
        self.given = angle
        self._view = GrowableArray((size,), np.float64)
        self._step = GrowableArray((2,), np.float64)  # turn, length into the frame
        self._gain = GrowableArray((len(FIELDS_OF_VIEW),), np.float64)
        self._still = GrowableArray(
            (len(FIELDS_OF_VIEW),), np.float64
        )  # the unshifted difference, where a fan would shift
        self._pairs = _no_pairs()
        self._angle = angle
        self._due = 1

    @property
    def angle(self) -> float:
        """Of a sector, rad; 0 while nothing says that sectors are ordered."""
        return self._angle

    def append(self, view: np.ndarray, turn: float, length: float) -> None:
        """One more frame: its view [size], turn (rad) and way (m) since the one before."""
        self._view.append(view)
        self._step.append((turn, length))
        if len(self._view.rows) > 1:
            gain, still = self._gains()
            self._gain.append(gain)
            self._still.append(still)

    def estimate(self) -> BiasEstimate:
        """The heading bias that the views show: what has to be added to the odometry's turn."""
        self._find()
        if not self._angle or len(self._view.rows) < 2 * FEWEST:
            return NO_ESTIMATE
        answers = [_slope(self._measured(lag), abs(self._angle)) for lag in LAGS]
        value = float(np.mean([answer.value for answer in answers]))
        error = np.mean([answer.error**2 for answer in answers]) + (answers[0].value - answers[1].value) ** 2
        return BiasEstimate(value, float(np.sqrt(error)))

    def _find(self) -> None:
        """Calls the views a fan once shifting by the turn explains them far better than leaving them; looks
        again whenever it has twice as many to go by."""
        gain = self._gain.rows
        if self.given or len(gain) < self._due:
            return
        total, count = gain.sum(axis=0), (gain != 0).sum(axis=0)
        sure = total / np.sqrt(np.maximum((gain**2).sum(axis=0), 1e-300))
        best = int(np.argmax(np.where(count >= FEWEST, total, -np.inf)))
        plain = total[best] > PLAIN * self._still.rows[:, best].sum()
        if count[best] >= FEWEST and sure[best] > SURE and plain:
            self._angle = float(FIELDS_OF_VIEW[best] / self._view.rows.shape[1])
            self._due = 2 * len(gain)
            self._pairs = _no_pairs()

    def _gains(self) -> tuple[np.ndarray, np.ndarray]:
        """[F] by how much the newest two views agree better when shifted as each fan demands, and how much
        they differ unshifted; 0 where a fan demands no shift."""
        old, now = self._view.rows[-2], self._view.rows[-1]
        size = len(now)
        shift = np.round(-self._step.rows[-1, 0] / (FIELDS_OF_VIEW / size)).astype(int)
        still = np.abs(now - old).mean()
        moves = (shift != 0) & (np.abs(shift) <= size // 2)
        gain = [still - _apart(now, old, k) if moved else 0.0 for k, moved in zip(shift, moves, strict=True)]
        return np.array(gain), still * moves

    def _measured(self, lag: int) -> np.ndarray:
        """[P, 3] for each pair of frames `lag` apart: heading error, trust in it, way between them."""
        pairs = self._pairs[lag]
        done, count = len(pairs.rows), len(self._view.rows) - lag
        if count > done:
            for row in self._turned(np.arange(done, count) + lag, lag):
                pairs.append(row)
        return pairs.rows

    def _turned(self, at: np.ndarray, lag: int) -> np.ndarray:
        angle, step = self._angle, np.cumsum(self._step.rows, axis=0)
        turn, length = (step[at] - step[at - lag]).T
        view, offset = self._view.rows, SCAN * abs(angle)
        errors = np.array([_between(view[at], view[at - lag], -(turn + x) / angle) for x in offset])
        blind = np.isnan(errors).any(axis=0)
        errors = np.where(blind, 1.0, errors)
        best, row = errors.argmin(axis=0), np.arange(len(at))
        inner = (best > 0) & (best < len(SCAN) - 1) & ~blind
        k = np.clip(best, 1, len(SCAN) - 2)
        before, least, after = errors[k - 1, row], errors[k, row], errors[k + 1, row]
        bend = before - 2 * least + after
        fine = np.where(bend > 0, (before - after) / np.where(bend > 0, 2 * bend, 1.0), 0.0)
        depth = np.median(errors, axis=0) / (errors.min(axis=0) + 1e-300) - 1
        trust = np.where(inner & (length > 0), np.clip(depth, 0, 3), 0.0)
        return np.stack([offset[k] + fine * (offset[1] - offset[0]), trust, length], axis=1)

    def arrays(self) -> dict[str, np.ndarray]:
        """Its whole state."""
        return {
            "view": self._view.rows.copy(),
            "step": self._step.rows.copy(),
            "gain": self._gain.rows.copy(),
            "still": self._still.rows.copy(),
            "found": np.array([self._angle, self._due]),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """The inverse of `arrays`."""
        self._view.replace(arrays["view"])
        self._step.replace(arrays["step"])
        self._gain.replace(arrays["gain"])
        self._still.replace(arrays["still"])
        angle, due = np.asarray(arrays["found"])
        self._angle, self._due = float(angle), int(due)
        self._pairs = _no_pairs()


def _no_pairs() -> dict[int, GrowableArray]:
    return {lag: GrowableArray((3,), np.float64) for lag in LAGS}


def _apart(now: np.ndarray, old: np.ndarray, shift: int) -> np.ndarray:
    """[...] mean absolute difference where now[shift:] meets old[..., :-shift] (or the other way round)."""
    size = len(now) - abs(shift)
    return np.abs(now[max(shift, 0) :][:size] - old[..., max(-shift, 0) :][..., :size]).mean(axis=-1)


def _between(now: np.ndarray, old: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """[P] the same for shifts between sectors, old views interpolated; NaN with less than half overlap."""
    size = now.shape[1]
    at = np.arange(size)[None] - shift[:, None]
    low = np.floor(at).astype(int)
    share, inside = at - low, (low >= 0) & (low + 1 < size)
    first = np.take_along_axis(old, np.clip(low, 0, size - 1), axis=1)
    second = np.take_along_axis(old, np.clip(low + 1, 0, size - 1), axis=1)
    apart = np.where(inside, np.abs(now - first * (1 - share) - second * share), 0.0)
    count = inside.sum(axis=1)
    return np.where(count >= size // 2, apart.sum(axis=1) / np.maximum(count, 1), np.nan)


def _slope(pairs: np.ndarray, angle: float) -> BiasEstimate:
    """Robust line through the origin (Huber, a quarter sector) and its jackknife error over blocks."""
    turned, trust, length = pairs.T
    if np.count_nonzero(trust) < FEWEST:
        return NO_ESTIMATE
    value = 0.0
    for _ in range(12):
        weight = trust / np.maximum(np.abs(turned - value * length), angle / 4)
        value = float((weight * turned * length).sum() / (weight * length**2).sum())
    top, bottom = weight * turned * length, weight * length**2
    parts = np.array_split(np.arange(len(pairs)), BLOCKS)
    rest = np.array([bottom.sum() - bottom[part].sum() for part in parts])
    if rest.min() <= 1e-9 * bottom.sum():
        return NO_ESTIMATE  # all of it was seen in one stretch: nothing to compare it with
    without = np.array([top.sum() - top[part].sum() for part in parts]) / rest
    return BiasEstimate(value, float(np.sqrt((1 - 1 / BLOCKS) * ((without - without.mean()) ** 2).sum())))
