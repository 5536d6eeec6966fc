"""Strain templates (Fox et al. 2012, II-G): training, file format and matching (eq. 5).

A template is the mean strain of all whiskers while the robot drives into a wall at one of fifteen angles. An
angle is the wall's *direction* in base_link, counter-clockwise from ahead, modulo half a turn: 90 degrees is
a wall straight across. (The paper uses normals, which are at right angles to it.)
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from tactile.base.errors import InputError
from tactile.base.npz import read_npz
from tactile.base.settings import Settings
from tactile.base.types import Report

FILE_VERSION = 1
"""Version of the file format."""
TEMPLATES = "templates"
"""Name of the templates in errors."""
TRAIN_HINT = "make one with `python -m ratslam reproduce templates`"
ANGLE_TOLERANCE = np.radians(0.5)
"""Largest difference between the angle of a drive and that of its template, rad."""
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


class TrainingDrive(NamedTuple):
    """One drive into a wall.

    Attributes:
        angle: the wall's direction in base_link, rad. repeat: number of the drive at this angle.
        strain: [T, W, 2] raw strain from first contact on. rate: samples per second.
    """

    angle: float
    repeat: int
    strain: np.ndarray
    rate: float


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


class TemplateMatch(NamedTuple):
    """Result of template matching.

    Attributes:
        error: [A] error of each template, eq. 5. winner: index of the best one. angle: its direction, rad.
        refined: direction at the minimum of the parabola through the errors of it and its neighbours, rad.
        relative: error of the best one over the mean square of the strain: near 0 for straight walls, near 1
            for other objects.
    """

    error: np.ndarray
    winner: int
    angle: float
    refined: float
    relative: float


def strain_sample_rate(report: Report) -> float:
    """Samples per second of a report's strain; 0 for fewer than two samples."""
    count = len(report.time)
    return float((count - 1) / (report.time[-1] - report.time[0])) if count > 1 else 0.0


def training_drive(angle: float, repeat: int, report: Report) -> TrainingDrive:
    """The training drive recorded in a report."""
    return TrainingDrive(angle, repeat, report.strain, strain_sample_rate(report))


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


def train_templates(
    drives: Iterable[TrainingDrive], training: TemplateTraining | None = None
) -> StrainTemplates:
    """Trains templates from drives into walls.

    Raises:
        InputError: too few drives at an angle, or a drive at another angle, of another sample rate or count
            of whiskers, too short, or with NaN samples.
    """
    training, drives = training or TemplateTraining(), list(drives)
    angles = training.angles
    _check(training, drives)
    given = np.array([drive.angle for drive in drives])
    near = np.abs(given[:, None] - angles) < ANGLE_TOLERANCE
    count = near.sum(axis=0)
    if (count < training.repeats).any():
        less = np.flatnonzero(count < training.repeats)
        few = ", ".join(f"{count[k]} at {np.degrees(angles[k]):.3g} degrees" for k in less)
        where = f"{training.repeats} at each angle"
        raise InputError(TEMPLATES, f"too few drives: {few}", where, "add drives")
    sets = []
    for at in near.T:
        chosen = [drives[k].strain[: training.samples] for k in np.flatnonzero(at)]
        sets.append(np.stack([filter_strain(training, strain) for strain in chosen]))
    mean = np.stack([one.mean(axis=0) for one in sets])
    # Most channels have no contact most of the time, so the median measures noise.
    square = np.concatenate(
        [((one - one.mean(axis=0)) ** 2).swapaxes(1, 2).reshape(-1, training.samples, 2) for one in sets]
    ) / (1 - 1 / count.min())
    return StrainTemplates(training, angles, mean, np.sqrt(np.median(square, axis=0) / SQUARE_MEDIAN))


def match_template(
    templates: StrainTemplates, strain: np.ndarray, alive: np.ndarray | None = None
) -> TemplateMatch:
    """Matches filtered strain since HIT1 [N, W, 2] with the templates (eq. 5) by whiskers `alive` [W]."""
    count = min(len(strain), templates.mean.shape[1])
    use = np.ones(strain.shape[1], bool) if alive is None else np.asarray(alive, bool)
    if not count or not use.any():
        raise ValueError("no samples or no whiskers to match")
    read = strain[:count, use]
    error = ((read - templates.mean[:, :count, use]) ** 2).sum(axis=(2, 3)).mean(axis=1)
    winner = int(error.argmin())
    refined = angle = float(templates.angle[winner])
    if 0 < winner < len(error) - 1:
        below, least, above = error[winner - 1 : winner + 2]
        bend = below - 2 * least + above
        step = templates.angle[winner + 1] - templates.angle[winner]
        refined += float(step * (below - above) / (2 * bend)) if bend > 0 else 0.0
    power = float((read**2).sum(axis=(1, 2)).mean())
    return TemplateMatch(error, winner, angle, refined, float(error[winner] / max(power, 1e-300)))


def write_templates(templates: StrainTemplates, path: Path | str) -> None:
    """Writes templates to an .npz file."""
    with open(path, "wb") as file:
        arrays = templates._asdict() | {"training": np.array(templates.training.model_dump_json())}
        np.savez_compressed(file, strain_templates=np.int64(FILE_VERSION), **arrays)


def read_templates(path: Path | str) -> StrainTemplates:
    """Reads a file of `write_templates`.

    Raises:
        InputError: the file is missing, cannot be read or holds something else.
    """

    def parse(version: np.ndarray, settings: np.ndarray, *arrays: np.ndarray) -> StrainTemplates:
        training, (angle, mean, spread) = TemplateTraining.model_validate_json(str(settings)), arrays
        whole = int(version) == FILE_VERSION and angle.shape == training.angles.shape
        whole &= mean.shape[:2] + mean.shape[3:] == (len(angle), training.samples, 2)
        if not whole or spread.shape != (training.samples, 2) or not np.isfinite(mean).all():
            raise ValueError("another version or incomplete")
        return StrainTemplates(training, angle, mean, spread)

    names = ("strain_templates", *StrainTemplates._fields)
    return read_npz(path, names, parse, f"strain templates of version {FILE_VERSION}", TRAIN_HINT)


def _check(training: TemplateTraining, drives: list[TrainingDrive]) -> None:
    if not drives:
        expected = f"{training.repeats} drives at each of {len(training.angles)} angles"
        raise InputError(TEMPLATES, "no drives", expected)
    whiskers = np.shape(drives[0].strain)[1:2]
    for drive in drives:
        where = f"{TEMPLATES}: drive {drive.repeat} at {np.degrees(drive.angle):.4g} degrees"
        strain = np.asarray(drive.strain)
        if strain.ndim != 3 or strain.shape[1:] != (*whiskers, 2):
            raise InputError(where, f"strain of shape {strain.shape}", f"[T, {whiskers[0]}, 2]")
        if abs(drive.rate - training.rate) > 1e-3 * training.rate:
            raise InputError(where, f"{drive.rate:.5g} samples per second", f"{training.rate:g}")
        if len(strain) < training.samples:
            found = f"{len(strain) / training.rate:.3g} s"
            raise InputError(where, found, f"{training.duration:g} s from first contact on")
        if not np.isfinite(strain).all():
            raise InputError(where, "NaN samples", "finite samples", "leave this drive out")
        if np.abs(drive.angle - training.angles).min() >= ANGLE_TOLERANCE:
            angles = ", ".join(f"{angle:.4g}" for angle in np.degrees(training.angles))
            raise InputError(where, "not one of the training angles", f"one of {angles} degrees")
