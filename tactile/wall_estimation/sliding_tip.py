"""The law of a whisker whose tip slides along a straight wall, learned from strain templates.

As the robot drives on, the distance d of a whisker's base from the wall falls steadily. Its tip stays on the
wall, so the whisker turns by tau until

    L sin(beta - tau) = d - (speed x time) sin(phi)

where phi is the wall's direction and beta that of the whisker to it, whichever side is nearer. Horizontal
strain is gain x tau; vertical strain is some of it for crosstalk, less a share of its size that depends on
the slant, beta - tau, of the line to the tip against the wall. Gain, crosstalk and shares are fitted to the
templates, all whiskers together. They so tell of angles at which a whisker was never first to touch a wall in
training, as happens at short walls; and what turns otherwise than along a straight wall is found out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.errors import InputError
from tactile.wall_estimation.strain_templates import TEMPLATES, StrainTemplates
from tactile.whiskers.planar_whiskers import PlanarWhiskers

SAMPLE_RATE = 50.0
"""Of the samples that are used, per second: what the low-pass leaves."""
WALL_DIRECTIONS = np.radians(np.arange(4.0, 176.5, 1.0))
"""Wall directions that are tried, rad."""
SLANTS = np.radians(np.arange(0.0, 91.0, 7.5))
"""Between whisker and wall, at which shares are known, rad."""
HORIZONTAL_MODEL_SD = 0.02
"""Standard deviation of what the law leaves out of the horizontal strain, as a share of it."""
VERTICAL_MODEL_SD = 0.04
"""Of the vertical strain, as a share of the horizontal one."""
SURFACE_SD = 2e-4
"""Of the wall, or of the tip's place along it, m."""
MAX_TURN = 0.35
"""Turn of a whisker up to which its tip alone touches, rad."""
MAX_FIRST_TURN = 0.2
"""Turn at HIT1 from which it was no tip that met a wall: it grows slowly, but springs up at a corner, rad."""
MIN_SLANT = 0.1
"""Between a whisker and a wall that its tip can meet, rad."""
RIGHT_ANGLE_MARGIN = np.radians(3.0)
"""About a right angle a whisker may turn to either side."""
MIN_SIGNAL_SDS = 30.0
"""Noise that templates must exceed to be learned from, in standard deviations."""
MIN_CONTACT_SAMPLES = 20
"""Samples of a template that it takes."""
MAX_TEMPLATE_MISFIT = 3.0
"""Misfit at which templates are not of such whiskers."""
FRICTION_ANGLE = 0.2
"""Lean of a wall's push on a tip that slides, rad."""
MAX_PUSH_ANGLE = 1.3
"""Slant and lean together up to which a push along the shaft bends it, rad."""
PUSH_RATIO = np.tan(np.minimum(SLANTS + FRICTION_ANGLE, MAX_PUSH_ANGLE))
"""Of a push, what goes along the shaft over what goes across it, at `SLANTS`."""
SHARE_SMOOTHING = 0.03
"""Weight of shares being in proportion to that, which tells them where nothing was felt."""


class TipModel(NamedTuple):
    """The law.

    Attributes:
        gain: strain a radian. crosstalk: of horizontal in vertical strain. share: [K] at `SLANTS`.
        noise: [T, 2] of the filtered channels at `time` [T] s. feelers: the whiskers. speed: m/s. rate:
            samples per second of what it is compared with.
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
    """How well one whisker's strain goes with each wall direction, [K] of `WALL_DIRECTIONS`.

    Attributes:
        misfit: mean square over the two channels' standard deviations, added up: about 2 at most for a wall;
            infinite where impossible. away: m from the whisker's base to the wall now. samples: used at most.
    """

    misfit: np.ndarray
    away: np.ndarray
    samples: int


def fit_tip_model(templates: StrainTemplates, feelers: PlanarWhiskers) -> TipModel:
    """The law that these whiskers follow in the templates.

    Raises:
        InputError: the templates are of other whiskers, or those lie elsewhere.
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
        raise InputError(TEMPLATES, "hardly any contact in them", "whiskers that touch walls")
    strongest = max(float(np.abs(one.across).max()) for one in series)
    gain, misfit = _scanned(tip, series, np.geomspace(strongest / 4, strongest / 0.1, 300))
    gain, misfit = _scanned(tip, series, gain * np.linspace(0.985, 1.015, 61))
    if misfit > MAX_TEMPLATE_MISFIT:
        raise InputError(
            TEMPLATES,
            "whiskers that do not turn in them as straight ones would that are mounted so",
            "the whiskers that they were trained with",
            "check mounts and length, or train again",
        )
    tip = tip._replace(gain=gain)
    crosstalk, share = _vertical(tip, series)
    return tip._replace(crosstalk=crosstalk, share=share)


def direction_misfit(tip: TipModel, whisker: int, strain: np.ndarray) -> DirectionMisfit:
    """Of what that whisker read, filtered [N, 2], from HIT1 on."""
    rows = _rows(len(strain), tip.rate)[: len(tip.time)]
    across, down = strain[rows, whisker].T
    side = np.sign(across.sum())
    nearer = _nearer(tip, whisker, WALL_DIRECTIONS, side)
    time, noise = tip.time[: len(rows)], tip.noise[: len(rows)]
    fit = _sliding(tip, tip.gain, nearer, np.sin(WALL_DIRECTIONS), float(tip.feelers.length[whisker]), across)
    expected = tip.crosstalk * across - np.abs(across) * (_between(fit.slant) @ tip.share)
    sd = np.hypot(noise[:, 1], VERTICAL_MODEL_SD * across)
    vertical = _mean(((down - expected) / sd) ** 2, fit.use)
    # Along the wall a whisker would lie on it, not meet it with its tip.
    grazing = np.where(fit.use, fit.slant, np.inf).min(axis=1, initial=np.inf) < MIN_SLANT
    possible = ~grazing & (nearer < np.pi / 2 + RIGHT_ANGLE_MARGIN) & (fit.use.sum() >= 2)
    possible &= bool(np.abs(across[:1]).max(initial=0.0) < MAX_FIRST_TURN * tip.gain)
    last = time[-1] if len(time) else 0.0
    away = fit.away - tip.speed * np.sin(WALL_DIRECTIONS) * last
    return DirectionMisfit(np.where(possible, fit.misfit + vertical, np.inf), away, int(fit.use.sum()))


class _Series(NamedTuple):
    """One whisker of one template while it touches."""

    whisker: int
    angle: float
    nearer: float
    across: np.ndarray
    down: np.ndarray
    touching: np.ndarray


class _Fit(NamedTuple):
    """Of K walls: misfit [K], base's distance at HIT1 [K] m, slant [K, N] rad, samples used [N]."""

    misfit: np.ndarray
    away: np.ndarray
    slant: np.ndarray
    use: np.ndarray


def _rows(count: int, rate: float) -> np.ndarray:
    step = max(round(rate / SAMPLE_RATE), 1)
    return np.arange(step - 1, count, step)


def _nearer(tip: TipModel, whisker: int, angle: np.ndarray, side: float) -> np.ndarray:
    """From whisker to wall on the side to which it turns, rad."""
    x, y = tip.feelers.direction[whisker]
    beta = angle - np.arctan2(y, x)
    return beta if side > 0 else np.pi - beta


def _sliding(
    tip: TipModel,
    gain: float,
    nearer: np.ndarray,
    slope: np.ndarray,
    length: float,
    across: np.ndarray,
    touching: np.ndarray | None = None,
) -> _Fit:
    """How steadily the wall comes nearer [N] if it lies so [K]."""
    count = len(across)
    turn = np.abs(across) / gain
    use = turn < MAX_TURN if touching is None else touching & (turn < MAX_TURN)
    slant = nearer[:, None] - turn
    distance = length * np.sin(slant) + tip.speed * slope[:, None] * tip.time[:count]
    sd = length * np.cos(slant) * np.hypot(tip.noise[:count, 0] / gain, HORIZONTAL_MODEL_SD * turn)
    weight = use / (sd**2 + SURFACE_SD**2)
    away = (weight * distance).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)
    return _Fit(_mean(weight * (distance - away[:, None]) ** 2, use), away, slant, use)


def _mean(square: np.ndarray, use: np.ndarray) -> np.ndarray:
    return np.where(use, square, 0.0).sum(axis=-1) / np.maximum(use.sum(axis=-1), 1)


def _between(slant: np.ndarray) -> np.ndarray:
    """[..., K] weights of the two `SLANTS` that each is between."""
    place = np.clip(slant / SLANTS[1], 0.0, len(SLANTS) - 1.0)
    return np.maximum(1 - np.abs(place[..., None] - np.arange(len(SLANTS))), 0.0)


def _series(tip: TipModel, templates: StrainTemplates, rows: np.ndarray) -> list[_Series]:
    series = []
    threshold = MIN_SIGNAL_SDS * float(np.median(tip.noise[:, 0]))
    for angle, mean in zip(templates.angle, templates.mean[:, rows], strict=True):
        for whisker in range(mean.shape[1]):
            across, down = mean[:, whisker].T
            touching = np.abs(across) > threshold
            # The first samples after onset are still the filter's.
            touching &= np.cumsum(touching) > round(0.05 * SAMPLE_RATE)
            nearer = float(_nearer(tip, whisker, angle, np.sign(across[touching].sum())))
            # About a right angle drives of one average may have turned to different sides.
            if MIN_SLANT < nearer < np.pi / 2 - RIGHT_ANGLE_MARGIN and touching.sum() >= MIN_CONTACT_SAMPLES:
                series.append(_Series(whisker, float(angle), nearer, across, down, touching))
    return series


def _scanned(tip: TipModel, series: list[_Series], gains: np.ndarray) -> tuple[float, float]:
    """The gain with the least misfit, and that, a mean over series."""
    total = np.zeros(len(gains))
    for one in series:
        nearer, slope = np.array([one.nearer]), np.sin([one.angle])
        length = float(tip.feelers.length[one.whisker])
        for k, gain in enumerate(gains):
            fit = _sliding(tip, gain, nearer, slope, length, one.across, one.touching)
            # So many turned too far already: no gain to speak of.
            total[k] += min(fit.misfit[0], 10.0) if fit.use.sum() >= MIN_CONTACT_SAMPLES // 2 else 10.0
    best = int(total.argmin())
    return float(gains[best]), float(total[best] / len(series))


def _vertical(tip: TipModel, series: list[_Series]) -> tuple[float, np.ndarray]:
    """Crosstalk and shares by least squares, each series counting the same."""
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
