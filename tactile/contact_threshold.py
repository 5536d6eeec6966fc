"""Contact detection: from the raw samples of one whisk cycle to the contact features of each whisker.

A whisker is in contact when its mean deflection over a short window exceeds a threshold. The onset is where
the slope of the deflection over the same window exceeds another one (Salman & Pearson 2016, III-D, use the
first derivative; the derivative of single samples is mostly noise). Thresholds are angles and times, so they
do not depend on the sample rate.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, PositiveFloat

from tactile.base.errors import InputError
from tactile.base.settings import Settings
from tactile.base.types import Array, Cycle, Whisk
from tactile.calibration import Calibration, sample_rate


class ShaftConfig(Settings):
    """Stiffness of a whisker as a function of the point of contact."""

    taper: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Radius at the tip over radius at the base; the taper is linear (Fox et al. 2012: 0.3 mm / 1.45 mm)."""
    reference: Annotated[float, Field(gt=0, le=1)] = 0.75
    """Point of contact at which the deflection equals the angle of the push, as a share of the length; most
    contacts with walls are near it."""


class ContactConfig(Settings):
    """Contact detection; `_sds` thresholds are in standard deviations of the free-whisking record."""

    slope_window: PositiveFloat = 0.01
    """Window of slopes and means, s."""
    onset_sds: PositiveFloat = 20.0
    """Rise of the deflection within `rise_time` that marks the onset of a contact."""
    rise_time: PositiveFloat = 0.05
    """Time of that rise, s; the onset is searched for this long before the contact is detected."""
    contact_sds: PositiveFloat = 7.5
    """Contact threshold of the mean deflection."""
    shaft: ShaftConfig = ShaftConfig()
    """Stiffness of the whiskers, for the radial distance."""


def stiffness(config: ShaftConfig, reach: Array) -> np.ndarray:
    """Base moment per angle of push at a share `reach` of the length, relative to that at the reference.

    A cone of length L whose apex would lie at L / (1 - taper), pushed at a by a small angle, has the base
    moment 3 E I (1 / a - (1 - taper) / L) times it (beam theory, exact for small angles).
    """
    full = 1 - config.taper
    return (1 / np.asarray(reach, float) - full) / (1 / config.reference - full)


def radial_distance(config: ShaftConfig, ratio: Array) -> np.ndarray:
    """The point of contact for a relative stiffness, as a share of the length (1 at the tip); the inverse of
    `stiffness`."""
    full = 1 - config.taper
    nearness = np.asarray(ratio, float) * (1 / config.reference - full) + full
    return 1 / np.maximum(nearness, 1.0)


def detect_contacts(config: ContactConfig, calibration: Calibration, cycle: Cycle) -> Whisk:
    """The contact features of one whisk cycle.

    A whisker with a NaN sample counts as not alive for the cycle; in a cycle without samples (its stream was
    dropped) no whisker is alive.

    Raises:
        InputError: the stream has gaps, is cut off or is sampled too slowly for the slope window.
    """
    if not len(cycle.time):
        no, zero = np.zeros(len(calibration.alive), bool), np.zeros(len(calibration.alive))
        return Whisk(cycle.odometry, no, no, zero, no, zero, zero)
    rate = sample_rate(cycle.time, config.slope_window, "touch")
    window = round(config.slope_window * rate)
    if len(cycle.time) < 2 * window:
        found = f"a cycle of {len(cycle.time)} samples"
        raise InputError("touch", found, "a whole whisk", "the stream is cut off")
    alive = calibration.alive & np.isfinite(cycle.angle).all(axis=0)
    alive = alive & np.isfinite(cycle.deflection).all(axis=(0, 2))
    angle = np.where(alive, cycle.angle, 0.0)
    deflection = np.where(alive[:, None], cycle.deflection - calibration.mean, 0.0)
    sd = np.where(alive, np.hypot(*calibration.sd.T) / np.sqrt(2), np.inf)

    mean, slope = _line(deflection, window)
    level, slope = np.hypot(*np.moveaxis(mean, -1, 0)), np.hypot(*np.moveaxis(slope, -1, 0)) * rate
    smooth = _line(angle, window)[0]
    # All whiskers are driven together, so the protraction ends where the sum of their angles is largest. A
    # single whisker may go further later, when its wall moves away. Rows count from the first full window.
    last = int(np.argmax(smooth.sum(axis=1)))
    beyond = (level > config.contact_sds * sd) & (np.arange(len(level))[:, None] <= last)
    # At rest the deflection is within its noise, which is steep too.
    steep = (slope > config.onset_sds * sd / config.rise_time) & (level > sd)
    # A contact began at the first steep row at most `rise_time` before it is detected, or at the row of
    # detection if the deflection rises slowly.
    row, detected = np.arange(len(beyond))[:, None], np.argmax(beyond, axis=0)
    steep = steep & (row <= detected) & (row >= detected - config.rise_time * rate)
    contact, onset = beyond.any(axis=0), np.where(steep.any(axis=0), np.argmax(steep, axis=0), detected)
    held, column = contact & beyond[last], np.arange(len(alive))
    reach = _reach(config.shaft, angle[window - 1 :], deflection[window - 1 :, :, 1], level, onset, last)
    return Whisk(
        odometry=cycle.odometry,
        alive=alive,
        contact=contact,
        touched=np.where(contact, angle[window - 1 :][onset, column], 0.0),
        held=held,
        highest=np.where(alive, np.where(held, smooth[last], smooth.max(axis=0)), 0.0),
        reach=np.where(contact, reach, 0.0),
    )


def _line(value: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and least-squares slope per sample over each full window: [T - window + 1, ...] twice."""
    index = np.arange(len(value), dtype=float).reshape(-1, *(1,) * (value.ndim - 1))
    zero, parts = np.zeros((1, *value.shape[1:])), (value, index * value)
    sums = [np.concatenate([zero, np.cumsum(part, axis=0)]) for part in parts]
    total, moment = (sum_[window:] - sum_[:-window] for sum_ in sums)
    centre = index[: len(total)] + (window - 1) / 2
    return total / window, (moment - centre * total) / (window * (window**2 - 1) / 12)


def _reach(
    config: ShaftConfig, angle: np.ndarray, y: np.ndarray, level: np.ndarray, onset: np.ndarray, last: int
) -> np.ndarray:
    """[W] radial distance of the contacts, as a share of the length.

    It follows from the stiffness: the least-squares slope of moment over angle while the deflection grows.
    """
    row = np.arange(len(level))[:, None]
    pushing = (row >= onset) & (row <= last)
    peak = np.argmax(np.where(pushing, level, -1.0), axis=0)
    weight = (pushing & (row <= peak)).astype(float)
    count = np.maximum(weight.sum(axis=0), 1.0)
    da = (angle - (weight * angle).sum(axis=0) / count) * weight
    dy = (y - (weight * y).sum(axis=0) / count) * weight
    ratio = (da * dy).sum(axis=0) / np.maximum((da**2).sum(axis=0), 1e-12)
    # A whisker that bent too little for a slope counts as touched at its tip.
    return np.where(np.sqrt((da**2).sum(axis=0) / count) > MIN_SWEEP, radial_distance(config, ratio), 1.0)


MIN_SWEEP = 5e-3
"""Least standard deviation of the angle during the push for an estimate of the stiffness, rad."""
