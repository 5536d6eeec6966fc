"""Strain templates of walls (Fox et al. 2012, II-G): training, file, matching (eq. 5); sliding-tip model.

A template is the mean strain of all whiskers while the robot drives into a wall at one of fifteen angles. An
angle is the wall's *direction* in base_link, counter-clockwise from ahead, modulo half a turn: 90 degrees is
a wall straight across. (The paper uses normals, which are at right angles to it.)

`TipModel`, fitted to the templates, is a whisker whose tip slides along a straight wall. It also covers
angles at which a whisker was never the first to touch in training, and detects contacts with other objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from tactile.base.bounded import read_npz
from tactile.base.errors import InputError
from tactile.base.settings import Settings
from tactile.base.types import Report
from tactile.whisker_geometry import PlanarWhiskers

FILE_VERSION = 1
"""Version of the file format."""
TEMPLATES = "templates"
"""Name of the templates in errors."""
TRAIN_HINT = "make one with `python -m ratslam reproduce templates`"
SQUARE_MEDIAN = 0.4549
"""Median of the square of a standard normal variable."""
WallAngle = Annotated[float, Field(gt=0, lt=180)]


class TemplateTraining(Settings):
    """Training of strain templates; defaults from the paper, which does not specify the low-pass filter."""

    first_deg: WallAngle = 20.0
    """Direction of the first wall."""
    last_deg: WallAngle = 160.0
    """Direction of the last wall."""
    step_deg: PositiveFloat = 10.0
    """Angle between successive walls."""
    repeats: Annotated[int, Field(ge=2)] = 4
    """Number of drives at each angle; a template is their mean."""
    rate: PositiveFloat = 2000.0
    """Samples per second."""
    duration: PositiveFloat = 2.0
    """Length of a template from first contact (HIT1) on, s."""
    speed: PositiveFloat = 0.02
    """Speed of the drive, m/s; that of FWD2."""
    cutoff: PositiveFloat = 17.0
    """Cutoff frequency of the low-pass filter, Hz."""
    order: PositiveInt = 2
    """Order of the low-pass filter (Butterworth)."""
    window: PositiveInt = 5
    """Length of the moving average, samples."""

    @model_validator(mode="after")
    def _sound(self) -> Self:
        if self.last_deg < self.first_deg:
            raise ValueError(f"last_deg: {self.last_deg:g} is less than first_deg, {self.first_deg:g}")
        if 2 * self.cutoff >= self.rate:
            found = f"cutoff: {self.cutoff:g} Hz"
            raise ValueError(f"{found} exceeds half the rate of {self.rate:g} samples per second")
        return self

    @property
    def angles(self) -> np.ndarray:
        """Wall directions [A], rad."""
        count = int((self.last_deg - self.first_deg) / self.step_deg + 1e-9) + 1
        return np.radians(self.first_deg + self.step_deg * np.arange(count))

    @property
    def samples(self) -> int:
        """Number of samples T of a template."""
        return round(self.duration * self.rate)


class StrainTemplates(NamedTuple):
    """Trained templates of A wall directions, T samples and W whiskers.

    Attributes:
        training: settings of the training. angle: [A] wall directions, rad. mean: [A, T, W, 2] templates.
        spread: [T, 2] standard deviation of the filtered channels of one drive without contacts.
    """

    training: TemplateTraining
    angle: np.ndarray
    mean: np.ndarray
    spread: np.ndarray

    def write(self, path: Path | str) -> None:
        """Writes the templates to an .npz file."""
        with open(path, "wb") as file:
            arrays = self._asdict() | {"training": np.array(self.training.model_dump_json())}
            np.savez_compressed(file, strain_templates=np.int64(FILE_VERSION), **arrays)

    @classmethod
    def read(cls, path: Path | str) -> StrainTemplates:
        """Reads a file of `write`.

        Raises:
            InputError: the file is missing, cannot be read or holds something else.
        """

        def parse(version: np.ndarray, settings: np.ndarray, *arrays: np.ndarray) -> StrainTemplates:
            training, (angle, mean, spread) = TemplateTraining.model_validate_json(str(settings)), arrays
            whole = int(version) == FILE_VERSION and angle.shape == training.angles.shape
            whole &= mean.shape[:2] + mean.shape[3:] == (len(angle), training.samples, 2)
            if not whole or spread.shape != (training.samples, 2) or not np.isfinite(mean).all():
                raise ValueError("another version or incomplete")
            return cls(training, angle, mean, spread)

        names = ("strain_templates", *cls._fields)
        return read_npz(path, names, parse, f"strain templates of version {FILE_VERSION}", TRAIN_HINT)


class TemplateMatch(NamedTuple):
    """Result of template matching.

    Attributes:
        error: [A] error of each template, eq. 5. angle: direction of the best one, rad.
        refined: direction at the minimum of the parabola through the errors of it and its neighbours, rad.
        relative: error of the best one over the mean square of the strain: near 0 for straight walls, near 1
            for other objects.
    """

    error: np.ndarray
    angle: float
    refined: float
    relative: float


def strain_sample_rate(report: Report) -> float:
    """Samples per second of a report's strain; 0 for fewer than two samples."""
    count = len(report.time)
    return float((count - 1) / (report.time[-1] - report.time[0])) if count > 1 else 0.0


def filter_strain(training: TemplateTraining, strain: np.ndarray) -> np.ndarray:
    """Applies the low-pass filter and the moving average to strain [T, ...]; the same shape.

    Both are causal, since a match at HIT2 cannot use later samples and templates need the same filter. Both
    start in the steady state of the first sample, which avoids a transient.
    """
    from scipy.signal import butter, sosfilt, sosfilt_zi  # slow to import

    rows = np.asarray(strain, np.float64).reshape(len(strain), -1)
    if not rows.size:
        return rows.reshape(np.shape(strain))
    sections = butter(training.order, training.cutoff, fs=training.rate, output="sos")
    begun = sosfilt_zi(sections)[..., None] * rows[0]
    low, _ = sosfilt(sections, rows, axis=0, zi=begun)
    before = np.repeat(rows[:1], training.window - 1, axis=0)
    windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([before, low]), training.window, axis=0)
    return windows.mean(axis=-1).reshape(np.shape(strain))


def train_templates(training: TemplateTraining, drives: Sequence[np.ndarray]) -> StrainTemplates:
    """Trains templates from drives into walls.

    Args:
        drives: of each [T, W, 2] the raw strain from first contact on; `training.repeats` at the first of the
            training's angles, then at the next, ...

    Raises:
        InputError: a drive is too short, or has NaN samples.
    """
    for number, strain in enumerate(drives):
        at, repeat = divmod(number, training.repeats)
        where = f"{TEMPLATES}: drive {repeat} at {np.degrees(training.angles[at]):.4g} degrees"
        if len(strain) < training.samples:
            found = f"{len(strain) / training.rate:.3g} s"
            raise InputError(where, found, f"{training.duration:g} s from first contact on")
        if not np.isfinite(strain).all():
            raise InputError(where, "NaN samples", "finite samples", "train without this whisker")
    filtered = np.stack([filter_strain(training, strain[: training.samples]) for strain in drives])
    sets = filtered.reshape(-1, training.repeats, *filtered.shape[1:])
    mean = np.stack([one.mean(axis=0) for one in sets])
    # Most channels have no contact most of the time, so the median measures noise.
    parts = [((one - one.mean(axis=0)) ** 2).swapaxes(1, 2).reshape(-1, training.samples, 2) for one in sets]
    square = np.concatenate(parts) / (1 - 1 / training.repeats)
    spread = np.sqrt(np.median(square, axis=0) / SQUARE_MEDIAN)
    return StrainTemplates(training, training.angles, mean, spread)


def match_template(templates: StrainTemplates, strain: np.ndarray, alive: np.ndarray) -> TemplateMatch:
    """Matches filtered strain since HIT1 [N, W, 2] with the templates (eq. 5) by whiskers `alive` [W], of
    both at least one."""
    count = min(len(strain), templates.mean.shape[1])
    read = strain[:count, alive]
    error = ((read - templates.mean[:, :count, alive]) ** 2).sum(axis=(2, 3)).mean(axis=1)
    winner = int(error.argmin())
    refined = angle = float(templates.angle[winner])
    if 0 < winner < len(error) - 1:
        below, least, above = error[winner - 1 : winner + 2]
        bend = below - 2 * least + above
        step = templates.angle[winner + 1] - templates.angle[winner]
        refined += float(step * (below - above) / (2 * bend)) if bend > 0 else 0.0
    power = float((read**2).sum(axis=(1, 2)).mean())
    return TemplateMatch(error, angle, refined, float(error[winner] / max(power, 1e-300)))


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
    """A whisker whose tip slides along a straight wall, fitted to strain templates.

    While the robot drives on, the distance d of a whisker's base from the wall falls steadily. The tip stays
    on the wall, so the whisker turns by tau:

        L sin(beta - tau) = d - (speed x time) sin(phi)

    phi is the wall's direction and beta the angle between whisker and wall on the nearer side. Horizontal
    strain is gain x tau. Vertical strain is crosstalk x horizontal strain minus a share of its size, which
    depends on the slant beta - tau (the angle between wall and the line from base to tip).

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


def direction_misfit(tip: TipModel, whisker: int, strain: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Compares a whisker's filtered strain ([N, W, 2], from HIT1 on) with the model for all directions.

    Returns:
        Of each of the K `WALL_DIRECTIONS` the mean squared normalised error [K], summed over both channels
        (at most about 2 for a wall, infinite for impossible directions), and the distance [K] of the
        whisker's base from the wall at the last sample, m; the number of samples used.
    """
    rows = _rows(len(strain), tip.rate)[: len(tip.time)]
    across, down = strain[rows, whisker].T
    side = np.sign(across.sum())
    nearer = _nearer(tip, whisker, WALL_DIRECTIONS, side)
    time, noise = tip.time[: len(rows)], tip.noise[: len(rows)]
    slope, every = np.sin(WALL_DIRECTIONS), np.ones(len(across), bool)
    misfit, distance, slant, use = _sliding(tip, whisker, nearer, slope, across, every)
    expected = tip.crosstalk * across - np.abs(across) * (_between(slant) @ tip.share)
    sd = np.hypot(noise[:, 1], VERTICAL_MODEL_SD * across)
    vertical = _mean(((down - expected) / sd) ** 2, use)
    # The shaft of a whisker nearly parallel to the wall, not its tip, would touch it.
    grazing = np.where(use, slant, np.inf).min(axis=1, initial=np.inf) < MIN_SLANT
    possible = ~grazing & (nearer < np.pi / 2 + RIGHT_ANGLE_MARGIN) & (use.sum() >= 2)
    possible &= bool(np.abs(across[:1]).max(initial=0.0) < MAX_FIRST_TURN * tip.gain)
    last = time[-1] if len(time) else 0.0
    away = distance - tip.speed * slope * last
    return np.where(possible, misfit + vertical, np.inf), away, int(use.sum())


class _Series(NamedTuple):
    """The samples of one whisker in one template."""

    whisker: int
    angle: float
    nearer: float
    across: np.ndarray
    down: np.ndarray
    touching: np.ndarray


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
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fits the distance of the wall at HIT1 for K angles `nearer` and directions (`slope`: their sines):
    misfit [K], distance of the base at HIT1 [K] m, slant [K, N] rad, samples used [N]."""
    count, length, turn = len(across), float(tip.feelers.length[whisker]), np.abs(across) / tip.gain
    use = use & (turn < MAX_TURN)
    slant = nearer[:, None] - turn
    distance = length * np.sin(slant) + tip.speed * slope[:, None] * tip.time[:count]
    sd = length * np.cos(slant) * np.hypot(tip.noise[:count, 0] / tip.gain, HORIZONTAL_MODEL_SD * turn)
    weight = use / (sd**2 + SURFACE_SD**2)
    away = (weight * distance).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)
    return _mean(weight * (distance - away[:, None]) ** 2, use), away, slant, use


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
            misfit, _, _, use = _sliding(model, one.whisker, nearer, slope, one.across, one.touching)
            # With this gain, too many samples would be turned further than `MAX_TURN`.
            total[k] += min(misfit[0], 10.0) if use.sum() >= MIN_CONTACT_SAMPLES // 2 else 10.0
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
