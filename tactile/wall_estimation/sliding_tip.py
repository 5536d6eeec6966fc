"""Model of a whisker whose tip slides along a straight wall, fitted to strain templates.

While the robot drives on, the distance d of a whisker's base from the wall falls steadily. The tip stays on
the wall, so the whisker turns by tau:

    L sin(beta - tau) = d - (speed x time) sin(phi)

phi is the wall's direction and beta the angle between whisker and wall on the nearer side. Horizontal strain
is gain x tau. Vertical strain is crosstalk x horizontal strain minus a share of its size, which depends on
the slant beta - tau (the angle between wall and the line from base to tip). Gain, crosstalk and shares are
fitted to the templates of all whiskers together. The model therefore also covers angles at which a whisker
was never the first to touch in training, and detects contacts with objects other than a straight wall.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.errors import InputError
from tactile.wall_estimation.strain_templates import TEMPLATES, StrainTemplates
from tactile.whiskers.planar_whiskers import PlanarWhiskers

SAMPLE_RATE = 50.0
"""Rate of the samples used, per second; the low-pass filter leaves no faster signal."""
WALL_DIRECTIONS = np.radians(np.arange(4.0, 176.5, 1.0))
"""Candidate wall directions, rad."""
SLANTS = np.radians(np.arange(0.0, 91.0, 7.5))
"""Slants at which the shares are given, rad."""
HORIZONTAL_MODEL_SD = 0.02
"""Standard deviation of the model error of horizontal strain, as a share of it."""
VERTICAL_MODEL_SD = 0.04
"""Standard deviation of the model error of vertical strain, as a share of horizontal strain."""
SURFACE_SD = 2e-4
"""Standard deviation of the wall's surface and of the tip's position on it, m."""
MAX_TURN = 0.35
"""Largest turn of a whisker at which only its tip touches, rad."""
MAX_FIRST_TURN = 0.2
"""Largest turn at HIT1, rad: the turn of a tip on a wall grows slowly, at a corner it jumps."""
MIN_SLANT = 0.1
"""Least angle between a whisker and a wall that its tip can touch, rad."""
RIGHT_ANGLE_MARGIN = np.radians(3.0)
"""A whisker within this angle of a right angle may turn to either side, rad."""
MIN_SIGNAL_SDS = 30.0
"""Signal that template samples need for the fit, in standard deviations of the noise."""
MIN_CONTACT_SAMPLES = 20
"""Least number of contact samples of a template for the fit."""
MAX_TEMPLATE_MISFIT = 3.0
"""Templates with a larger misfit were recorded with other whiskers."""
FRICTION_ANGLE = 0.2
"""Angle between the wall's force on a sliding tip and the wall's normal, rad."""
MAX_PUSH_ANGLE = 1.3
"""Upper limit of slant plus friction angle in `PUSH_RATIO`, rad."""
PUSH_RATIO = np.tan(np.minimum(SLANTS + FRICTION_ANGLE, MAX_PUSH_ANGLE))
"""Force along the shaft over force across it, at `SLANTS`."""
SHARE_SMOOTHING = 0.03
"""Weight of the prior that shares are proportional to `PUSH_RATIO`; it decides slants without data."""


class TipModel(NamedTuple):
    """The fitted model.

    Attributes:
        gain: strain per radian. crosstalk: horizontal strain in the vertical one. share: [K] at `SLANTS`.
        noise: [T, 2] standard deviations of the filtered channels at `time` [T] s. feelers: the whiskers.
        speed: of the robot, m/s. rate: samples per second of the compared strain.
    """

    gain: float
    crosstalk: float
    share: np.ndarray
    noise: np.ndarray
    time: np.ndarray
    feelers: PlanarWhiskers
    speed: float
    rate: float


class DirectionMisfit(NamedTuple):
    """Misfit of one whisker's strain for each of the K `WALL_DIRECTIONS`.

    Attributes:
        misfit: [K] mean squared normalised error, summed over both channels; at most about 2 for a wall,
            infinite for impossible directions.
        away: [K] distance of the whisker's base from the wall at the last sample, m. samples: number used.
    """

    misfit: np.ndarray
    away: np.ndarray
    samples: int


def fit_tip_model(templates: StrainTemplates, feelers: PlanarWhiskers) -> TipModel:
    """Fits the model to strain templates.

    Raises:
        InputError: the templates are from other whiskers or mounts, or have too few contact samples.
    """
    training = templates.training
    if templates.mean.shape[2] != len(feelers.length):
        found = f"templates of {templates.mean.shape[2]} whiskers"
        raise InputError(TEMPLATES, found, f"of {len(feelers.length)}")
    rows = _rows(len(templates.spread), training.rate)
    noise, time = templates.spread[rows], (rows + 1) / training.rate
    tip = TipModel(1.0, 0.0, np.zeros(len(SLANTS)), noise, time, feelers, training.speed, training.rate)
    series = _series(tip, templates, rows)
    if len(series) < 2:
        raise InputError(TEMPLATES, "hardly any contacts", "contacts with walls")
    strongest = max(float(np.abs(one.across).max()) for one in series)
    gain, misfit = _best_gain(tip, series, np.geomspace(strongest / 4, strongest / 0.1, 300))
    gain, misfit = _best_gain(tip, series, gain * np.linspace(0.985, 1.015, 61))
    if misfit > MAX_TEMPLATE_MISFIT:
        found = "the strain does not fit straight whiskers with these mounts"
        expected, cure = "the whiskers of the training", "check mounts and length, or train again"
        raise InputError(TEMPLATES, found, expected, cure)
    tip = tip._replace(gain=gain)
    crosstalk, share = _vertical(tip, series)
    return tip._replace(crosstalk=crosstalk, share=share)


def direction_misfit(tip: TipModel, whisker: int, strain: np.ndarray) -> DirectionMisfit:
    """Compares a whisker's filtered strain ([N, W, 2], from HIT1 on) with the model for all directions."""
    rows = _rows(len(strain), tip.rate)[: len(tip.time)]
    across, down = strain[rows, whisker].T
    side = np.sign(across.sum())
    nearer = _nearer(tip, whisker, WALL_DIRECTIONS, side)
    time, noise = tip.time[: len(rows)], tip.noise[: len(rows)]
    fit = _sliding(tip, whisker, nearer, np.sin(WALL_DIRECTIONS), across, np.ones(len(across), bool))
    expected = tip.crosstalk * across - np.abs(across) * (_between(fit.slant) @ tip.share)
    sd = np.hypot(noise[:, 1], VERTICAL_MODEL_SD * across)
    vertical = _mean(((down - expected) / sd) ** 2, fit.use)
    # The shaft of a whisker nearly parallel to the wall, not its tip, would touch it.
    grazing = np.where(fit.use, fit.slant, np.inf).min(axis=1, initial=np.inf) < MIN_SLANT
    possible = ~grazing & (nearer < np.pi / 2 + RIGHT_ANGLE_MARGIN) & (fit.use.sum() >= 2)
    possible &= bool(np.abs(across[:1]).max(initial=0.0) < MAX_FIRST_TURN * tip.gain)
    last = time[-1] if len(time) else 0.0
    away = fit.away - tip.speed * np.sin(WALL_DIRECTIONS) * last
    return DirectionMisfit(np.where(possible, fit.misfit + vertical, np.inf), away, int(fit.use.sum()))


class _Series(NamedTuple):
    """The samples of one whisker in one template."""

    whisker: int
    angle: float
    nearer: float
    across: np.ndarray
    down: np.ndarray
    touching: np.ndarray


class _Fit(NamedTuple):
    """Fit of K walls: misfit [K], distance of the base at HIT1 [K] m, slant [K, N] rad, samples used [N]."""

    misfit: np.ndarray
    away: np.ndarray
    slant: np.ndarray
    use: np.ndarray


def _rows(count: int, rate: float) -> np.ndarray:
    step = max(round(rate / SAMPLE_RATE), 1)
    return np.arange(step - 1, count, step)


def _nearer(tip: TipModel, whisker: int, angle: np.ndarray, side: float) -> np.ndarray:
    """Angle from whisker to wall on the side to which the whisker turns, rad."""
    x, y = tip.feelers.direction[whisker]
    beta = angle - np.arctan2(y, x)
    return beta if side > 0 else np.pi - beta


def _sliding(
    tip: TipModel, whisker: int, nearer: np.ndarray, slope: np.ndarray, across: np.ndarray, use: np.ndarray
) -> _Fit:
    """Fits the distance of the wall at HIT1 for K angles `nearer` and directions (`slope`: their sines)."""
    count, length, turn = len(across), float(tip.feelers.length[whisker]), np.abs(across) / tip.gain
    use = use & (turn < MAX_TURN)
    slant = nearer[:, None] - turn
    distance = length * np.sin(slant) + tip.speed * slope[:, None] * tip.time[:count]
    sd = length * np.cos(slant) * np.hypot(tip.noise[:count, 0] / tip.gain, HORIZONTAL_MODEL_SD * turn)
    weight = use / (sd**2 + SURFACE_SD**2)
    away = (weight * distance).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)
    return _Fit(_mean(weight * (distance - away[:, None]) ** 2, use), away, slant, use)


def _mean(square: np.ndarray, use: np.ndarray) -> np.ndarray:
    return np.where(use, square, 0.0).sum(axis=-1) / np.maximum(use.sum(axis=-1), 1)


def _between(slant: np.ndarray) -> np.ndarray:
    """Linear interpolation weights [..., K] of each slant between two of `SLANTS`."""
    place = np.clip(slant / SLANTS[1], 0.0, len(SLANTS) - 1.0)
    return np.maximum(1 - np.abs(place[..., None] - np.arange(len(SLANTS))), 0.0)


def _series(tip: TipModel, templates: StrainTemplates, rows: np.ndarray) -> list[_Series]:
    series = []
    threshold = MIN_SIGNAL_SDS * float(np.median(tip.noise[:, 0]))
    for angle, mean in zip(templates.angle, templates.mean[:, rows], strict=True):
        for whisker in range(mean.shape[1]):
            across, down = mean[:, whisker].T
            touching = np.abs(across) > threshold
            # The first samples after onset are dominated by the filter.
            touching &= np.cumsum(touching) > round(0.05 * SAMPLE_RATE)
            nearer = float(_nearer(tip, whisker, angle, np.sign(across[touching].sum())))
            # Near a right angle the averaged drives may have turned to different sides.
            if MIN_SLANT < nearer < np.pi / 2 - RIGHT_ANGLE_MARGIN and touching.sum() >= MIN_CONTACT_SAMPLES:
                series.append(_Series(whisker, float(angle), nearer, across, down, touching))
    return series


def _best_gain(tip: TipModel, series: list[_Series], gains: np.ndarray) -> tuple[float, float]:
    """The gain with the least mean misfit over all series, and that misfit."""
    total = np.zeros(len(gains))
    for one in series:
        nearer, slope = np.array([one.nearer]), np.sin([one.angle])
        for k, gain in enumerate(gains):
            model = tip._replace(gain=gain)
            fit = _sliding(model, one.whisker, nearer, slope, one.across, one.touching)
            # With this gain, too many samples would be turned further than `MAX_TURN`.
            total[k] += min(fit.misfit[0], 10.0) if fit.use.sum() >= MIN_CONTACT_SAMPLES // 2 else 10.0
    best = int(total.argmin())
    return float(gains[best]), float(total[best] / len(series))


def _vertical(tip: TipModel, series: list[_Series]) -> tuple[float, np.ndarray]:
    """Crosstalk and shares by least squares with equal weights of all series."""
    rows, values = [], []
    for one in series:
        use = one.touching & (np.abs(one.across) < MAX_TURN * tip.gain)
        across, down = one.across[use], one.down[use]
        size = np.abs(across).max() * np.sqrt(len(across))
        slant = one.nearer - np.abs(across) / tip.gain
        rows.append(np.column_stack([across, -np.abs(across)[:, None] * _between(slant) * PUSH_RATIO]) / size)
        values.append(down / size)
    change = SHARE_SMOOTHING * np.diff(np.eye(len(SLANTS)), axis=0)
    rows.append(np.column_stack([np.zeros(len(change)), change]))
    values.append(np.zeros(len(change)))
    found = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0]
    return float(found[0]), found[1:] * PUSH_RATIO
