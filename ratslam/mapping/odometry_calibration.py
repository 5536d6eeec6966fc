"""The calibration of the odometry: heading bias and heading noise, learned from views and closures.

*Heading noise*, a factor on the variance of every turn: its evidence is the probability of odometry and
closures with the poses integrated out (Laplace; MacKay 1992). The factor has a log-normal prior and moves
by at most `LARGEST_STEP` at a time, because the map changes with it. It does not fall below `LEAST_FACTOR`:
closures are accepted for agreeing with odometry, so odometry that is believed too much refuses true ones
and looks good.

*Ordered sectors*: when the robot turns, the values of a laser or sonar view shift by the turn. So
consecutive views show whether sectors are ordered and how wide they are, and their shifts measure the turns
better than wheels do, which gives the heading bias: the odometry's heading error per metre.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.optimizer import CalibrationPrior, MapFit, MapProblem, System
from tactile.base.compiled import compiled

FIELDS_OF_VIEW = np.radians([sign * width for width in (60, 90, 120, 180, 240, 270, 360) for sign in (1, -1)])
"""Candidate fields of view, rad; negative: clockwise."""
MIN_SIGNIFICANCE = 3.0
"""Significance of the improvement by a shift, standard errors, from which sectors count as ordered."""
MIN_IMPROVEMENT = 0.1
"""Least share of the unshifted difference that the shift must explain, because a significant improvement
may still be small."""
MIN_COUNT = 20
"""Turns before the field of view is estimated, and pairs of views before the bias is."""
LAGS = (1, 2)
"""Keyframes between the views compared for the bias; two estimates, to show their error."""
SCAN = np.arange(-2, 2.01, 0.125)
"""Search range for the turn between two views, in sectors around the odometry's turn."""
BLOCKS = 12
"""Blocks of a recording for the jackknife estimate of the standard error."""


BiasEstimate = tuple[float, float]
"""Heading error per distance, rad/m, and its standard error."""
NO_ESTIMATE: BiasEstimate = (0.0, np.inf)


class SectorFan(Checkpointed):
    """Estimates sector angle and heading bias from the views of consecutive keyframes, one row for each.

    Args:
        size: number of values of a view. angle: of a sector, counter-clockwise positive, rad; 0: to be
            estimated.

    Attributes:
        angle: the same; 0 while sectors are not known to be ordered.
    """

    VALUES = ("angle", "_due")

    def __init__(self, size: int, angle: float) -> None:
        self.given = angle
        self._view = GrowableArray((size,), np.float64)
        self._step = GrowableArray((2,), np.float64)  # turn, length into the frame
        self._gain = GrowableArray((len(FIELDS_OF_VIEW),), np.float64)
        # Differences of unshifted views, where a fan would shift them.
        self._still = GrowableArray((len(FIELDS_OF_VIEW),), np.float64)
        self._pairs = _no_pairs()
        self.angle = angle
        self._due = 1

    def append(self, view: np.ndarray, turn: float, length: float) -> None:
        """Adds a keyframe: its view [size], turn (rad) and distance (m) since the one before."""
        self._view.append(view)
        self._step.append((turn, length))
        if len(self._view.rows) > 1:
            # For each field of view [F]: decrease of the difference of the newest two views if shifted.
            old, now = self._view.rows[-2:]
            gain, still = _field_gains(now, old, self._step.rows[-1, 0], FIELDS_OF_VIEW)
            self._gain.append(gain)
            self._still.append(still)

    def estimate(self) -> BiasEstimate:
        """The heading bias that the views show, to be added to the odometry's turn."""
        # The sector angle is set once shifts by the turn explain the views significantly better than no
        # shift; that is repeated whenever the number of views has doubled.
        gain = self._gain.rows
        if not self.given and len(gain) >= self._due:
            total, count = gain.sum(axis=0), (gain != 0).sum(axis=0)
            sure = total / np.sqrt(np.maximum((gain**2).sum(axis=0), 1e-300))
            best = int(np.argmax(np.where(count >= MIN_COUNT, total, -np.inf)))
            plain = total[best] > MIN_IMPROVEMENT * self._still.rows[:, best].sum()
            if count[best] >= MIN_COUNT and sure[best] > MIN_SIGNIFICANCE and plain:
                self.angle = float(FIELDS_OF_VIEW[best] / self._view.rows.shape[1])
                self._due = 2 * len(gain)
                self._pairs = _no_pairs()
        if not self.angle or len(self._view.rows) < 2 * MIN_COUNT:
            return NO_ESTIMATE
        for lag, pairs in self._pairs.items():  # of keyframes `lag` apart, those added since
            done, count = len(pairs.rows), len(self._view.rows) - lag
            if count > done:
                for row in self._measure_turns(np.arange(done, count) + lag, lag):
                    pairs.append(row)
        answers = [_fit_slope(self._pairs[lag].rows, abs(self.angle)) for lag in LAGS]
        values, errors = zip(*answers, strict=True)
        variance = np.mean([error**2 for error in errors]) + (values[0] - values[1]) ** 2
        return float(np.mean(values)), float(np.sqrt(variance))

    def _measure_turns(self, at: np.ndarray, lag: int) -> np.ndarray:
        """[n, 3] heading error (rad), its weight, and distance (m) of keyframes `at` [n] and those `lag`
        before."""
        angle, step = self.angle, np.cumsum(self._step.rows, axis=0)
        turn, length = (step[at] - step[at - lag]).T
        view, offset = self._view.rows, SCAN * abs(angle)
        shift = -(turn + offset[:, None]) / angle
        errors = _fractional_differences(view[at], view[at - lag], shift)
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

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._pairs = _no_pairs()


def _no_pairs() -> dict[int, GrowableArray]:
    return {lag: GrowableArray((3,), np.float64) for lag in LAGS}


@compiled
def _field_gains(
    now: np.ndarray, old: np.ndarray, turn: float, fields: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """[F] decrease of the mean absolute difference of two views when they are shifted by a turn, rad, for
    each field of view [F], rad, and [F] their unshifted difference; 0 without a shift."""
    gain, still, size = np.zeros(len(fields)), np.zeros(len(fields)), len(now)
    unshifted = np.abs(now - old).mean()
    for f in range(len(fields)):
        shift = int(np.rint(-turn / (fields[f] / size)))
        if shift == 0 or abs(shift) > size // 2:
            continue
        first, second, total = max(shift, 0), max(-shift, 0), 0.0
        for at in range(size - abs(shift)):
            total += abs(now[first + at] - old[second + at])
        gain[f], still[f] = unshifted - total / (size - abs(shift)), unshifted
    return gain, still


@compiled
def _fractional_differences(now: np.ndarray, old: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """[F, P] mean absolute differences of P pairs of views [P, size] for fractional shifts [F, P], by
    interpolation; NaN with less than half overlap."""
    pairs, size = now.shape
    found = np.empty(shifts.shape)
    for f in range(len(shifts)):
        for p in range(pairs):
            total, count = 0.0, 0
            for k in range(size):
                at = k - shifts[f, p]
                low = int(np.floor(at))
                if low < 0 or low + 1 >= size:
                    continue
                share = at - low
                total += abs(now[p, k] - old[p, low] * (1 - share) - old[p, low + 1] * share)
                count += 1
            found[f, p] = total / count if count >= max(size // 2, 1) else np.nan
    return found


def _fit_slope(pairs: np.ndarray, angle: float) -> BiasEstimate:
    """Robust line through the origin (Huber, a quarter sector) and its jackknife error over blocks."""
    turned, trust, length = pairs.T
    if np.count_nonzero(trust) < MIN_COUNT:
        return NO_ESTIMATE
    value = 0.0
    for _ in range(12):
        weight = trust / np.maximum(np.abs(turned - value * length), angle / 4)
        value = float((weight * turned * length).sum() / (weight * length**2).sum())
    top, bottom = weight * turned * length, weight * length**2
    parts = np.array_split(np.arange(len(pairs)), BLOCKS)
    rest = np.array([bottom.sum() - bottom[part].sum() for part in parts])
    if rest.min() <= 1e-9 * bottom.sum():
        return NO_ESTIMATE  # one block holds all the weight
    without = np.array([top.sum() - top[part].sum() for part in parts]) / rest
    return value, float(np.sqrt((1 - 1 / BLOCKS) * ((without - without.mean()) ** 2).sum()))


TEXT = """\
# Calibration of the odometry after this session. The next session of the same robot starts from it if its
# configuration holds these settings.
keyframes:
  calibration:
    heading_bias: {prior.bias:.6g}        # rad/m
    heading_bias_sd: {prior.bias_sd:.3g}
"""
TURNS = """\
    turn_error: {prior.turn_error:.6g}        # rad/rad
    turn_error_sd: {prior.turn_error_sd:.3g}
"""
NOISE = """\
    # factor on the variances of heading; its log is {noise.log_factor:.2f} +- {noise.sd:.2f}
    heading_noise: {noise.factor:.4g}
"""


def starting_calibration(config: KeyframeMapConfig, cell: float) -> CalibrationPrior:
    """The prior before any view and closure, for pose cells of `cell` m."""
    start, turn_sd = config.calibration, config.turn_error_sd
    if start.turn_error_sd is not None and turn_sd > 0:
        turn_sd = start.turn_error_sd
    turn = start.turn_error if turn_sd > 0 else 0.0
    return CalibrationPrior(start.heading_bias, start.heading_bias_sd or config.bias_sd / cell, turn, turn_sd)


def calibration_from_views(
    config: KeyframeMapConfig, cell: float, start: CalibrationPrior, shown: BiasEstimate
) -> CalibrationPrior:
    """The prior with the heading bias that the views show, shrunk towards that of the start where the views
    are not certain of it."""
    value, error = shown
    off = value - start.bias
    shrunk = start.bias + (off * max(0.0, 1 - (config.shrink * error / off) ** 2) if off else 0.0)
    sd = min(np.hypot(error, value - shrunk), 2 * start.bias_sd)
    sd = max(sd, min(config.bias_least / cell, start.bias_sd))
    return start._replace(bias=shrunk, bias_sd=float(sd))


def write_calibration(path: Path, calibration: CalibrationPrior, noise: HeadingNoise | None) -> None:
    """Writes means and standard deviations as settings of a configuration.

    Args:
        noise: None where it is not learned.
    """
    text = TEXT + TURNS * (calibration.turn_error_sd > 0) + NOISE * (noise is not None)
    path.write_text(text.format(prior=calibration, noise=noise), encoding="utf-8")


SPREAD = 1.0
"""Standard deviation of the log of the factor before any closure."""
LARGEST_STEP = float(np.log(2.0))
"""Largest change of the log of the factor; also the distance between the factors compared."""
LEAST_FACTOR = 0.5
"""Least factor, of the noise that the map starts from."""
STEPS = 2
"""Solver iterations at each factor compared."""


class HeadingNoise(NamedTuple):
    """Log of the factor on the variance of the odometry's turns, and its standard deviation."""

    log_factor: float = 0.0
    sd: float = SPREAD

    @classmethod
    def of_start(cls, config: KeyframeMapConfig) -> HeadingNoise:
        """The noise before any closure."""
        return cls(float(np.log(config.calibration.heading_noise)))

    @property
    def factor(self) -> float:
        """On the variance."""
        return float(np.exp(self.log_factor))

    @property
    def further_factor(self) -> float:
        """On the variance of a further session or piece, beside `factor`. A map learns the noise of its own
        session, and little of it from few loop closures: that of others is not taken to be less than the
        settings say."""
        return 1 / min(self.factor, 1.0)


def learn_heading_noise(
    noise: HeadingNoise, start: HeadingNoise, fit: MapFit, problem: MapProblem
) -> HeadingNoise:
    """The noise after one more map.

    Args:
        noise: with which `problem` was made. start: that of the first map. fit: that solves the problem.
    """
    least = start.log_factor + float(np.log(LEAST_FACTOR))
    steps = np.array([-LARGEST_STEP, 0.0, LARGEST_STEP])
    off = noise.log_factor - start.log_factor
    system = System(problem)
    changed = [system.with_problem(problem.with_heading_noise(float(np.exp(step)))) for step in steps]
    pairs = zip(steps, changed, strict=True)
    logs = np.array([log_posterior(off + step, at.solve(fit, STEPS), at) for step, at in pairs])
    if not np.isfinite(logs).all():
        return noise
    slope = (logs[2] - logs[0]) / (2 * LARGEST_STEP)
    bend = (logs[0] - 2 * logs[1] + logs[2]) / LARGEST_STEP**2
    curved = bend < 0  # else there is no maximum near by
    step = -slope / bend if curved else np.sign(slope) * LARGEST_STEP
    moved = noise.log_factor + float(np.clip(step, -LARGEST_STEP, LARGEST_STEP))
    return HeadingNoise(max(moved, least), float(1 / np.sqrt(-bend)) if curved else SPREAD)


def log_posterior(off: float, fit: MapFit, system: System) -> float:
    """Log probability of the noise of `system`, and of odometry and closures with it, up to a constant.

    Args:
        off: log of the noise less that of the first map. fit: that solves the system.
    """
    return -0.5 * (off / SPREAD) ** 2 + system.log_evidence(fit)
