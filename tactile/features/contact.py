"""From a whisk's raw stream to what each whisker felt.

Contact is decided by the size of the deflection, averaged over a short window; where it began is told by its
slope over the same window (Salman & Pearson 2016, III-D: when the first derivative crossed a threshold; of
raw samples it is all noise). All thresholds are angles and times, so they mean the same at any sample rate.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, PositiveFloat

from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.types import Array, Cycle, Whisk
from tactile.features.calibration import Calibration, sample_rate


class ShaftConfig(Settings):
    """How a whisker's stiffness depends on where along it one pushes."""

    taper: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Radius at the tip over radius at the base; the taper is linear (Fox et al. 2012: 0.3 mm / 1.45 mm)."""
    reference: Annotated[float, Field(gt=0, le=1)] = 0.75
    """Where the deflection reads the angle of the push, as a share of the length; walls mostly meet it
    there."""


class ContactConfig(Settings):
    """When a deflection is a contact. In standard deviations of the free-whisking record."""

    slope_window: PositiveFloat = 0.01
    """Time over which slopes and means are taken, s."""
    steep: PositiveFloat = 20.0
    """Rise of the deflection within `rise` that tells when contact began."""
    rise: PositiveFloat = 0.05
    """s"""
    least: PositiveFloat = 7.5
    """Mean deflection that is contact."""
    shaft: ShaftConfig = ShaftConfig()
    """Of the whiskers, for the radial distance."""


def stiffness(config: ShaftConfig, reach: Array) -> np.ndarray:
    """Moment at the base for an angle of push, over that at the reference, when pushed at a share `reach`.

    A cone of length L whose apex would lie at L / (1 - taper), pushed at a by a small angle, has the base
    moment 3 E I (1 / a - (1 - taper) / L) times it (beam theory, exact for small angles).
    """
    full = 1 - config.taper
    return (1 / np.asarray(reach, float) - full) / (1 / config.reference - full)


def radial_distance(config: ShaftConfig, ratio: Array) -> np.ndarray:
    """Where along it a whisker with that stiffness is pushed, as a share of its length: 1 at the tip."""
    full = 1 - config.taper
    nearness = np.asarray(ratio, float) * (1 / config.reference - full) + full
    return 1 / np.maximum(nearness, 1.0)


def detect_contacts(
    config: ContactConfig, calibration: Calibration, cycle: Cycle, where: str = "touch"
) -> Whisk:
    """What each whisker felt in one cycle.

    A whisker with a value missing anywhere in the cycle is not alive in it; in a cycle without samples, whose
    stream was dropped, none is.

    Args:
        where: what errors call the stream.

    Raises:
        InputError: the stream is broken, cut off or too coarse for the slope window.
    """
    if not len(cycle.time):
        return _nothing(cycle, len(calibration.alive))
    rate = sample_rate(cycle.time, config.slope_window, where)
    window = round(config.slope_window * rate)
    if len(cycle.time) < 2 * window:
        raise InputError(
            where, f"a cycle of {len(cycle.time)} samples", "a whole whisk", "the stream is cut off"
        )
    alive = calibration.alive & np.isfinite(cycle.angle).all(axis=0)
    alive = alive & np.isfinite(cycle.deflection).all(axis=(0, 2))
    angle = np.where(alive, cycle.angle, 0.0)
    deflection = np.where(alive[:, None], cycle.deflection - calibration.mean, 0.0)
    sd = np.where(alive, np.hypot(*calibration.sd.T) / np.sqrt(2), np.inf)

    mean, slope = _line(deflection, window)
    level, slope = np.hypot(*np.moveaxis(mean, -1, 0)), np.hypot(*np.moveaxis(slope, -1, 0)) * rate
    smooth = _line(angle, window)[0]
    # All whiskers are driven together: the protraction ends when the array as a whole is furthest. A whisker
    # alone may come further later, when its wall moves away. Rows count from the first full window.
    last = int(np.argmax(smooth.sum(axis=1)))
    row = np.arange(len(level))[:, None]
    beyond = (level > config.least * sd) & (row <= last)
    contact = beyond.any(axis=0)
    shown = np.argmax(beyond, axis=0)
    # It began where it first got steep, not long before it showed and already away from rest (noise gets
    # steep too). A slow touch is never steep: then it began where it showed.
    near = (row <= shown) & (row >= shown - config.rise * rate)
    steep = near & (slope > config.steep * sd / config.rise) & (level > sd)
    began = np.where(steep.any(axis=0), np.argmax(steep, axis=0), shown)

    column = np.arange(len(alive))
    held = contact & beyond[last]
    reach = _reach(config.shaft, angle[window - 1 :], deflection[window - 1 :, :, 1], level, began, last)
    return Whisk(
        odometry=cycle.odometry,
        alive=alive,
        contact=contact,
        touched=np.where(contact, angle[window - 1 :][began, column], 0.0),
        held=held,
        highest=np.where(alive, np.where(held, smooth[last], smooth.max(axis=0)), 0.0),
        reach=np.where(contact, reach, 0.0),
    )


def _nothing(cycle: Cycle, whiskers: int) -> Whisk:
    no, zero = np.zeros(whiskers, bool), np.zeros(whiskers)
    return Whisk(cycle.odometry, no, no, zero, no, zero, zero)


def _line(value: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and least-squares slope per sample over each full window: [T - window + 1, ...] twice."""
    index = np.arange(len(value), dtype=float).reshape(-1, *(1,) * (value.ndim - 1))
    sums = [
        np.concatenate([np.zeros((1, *value.shape[1:])), np.cumsum(part, axis=0)])
        for part in (value, index * value)
    ]
    total, moment = (sum_[window:] - sum_[:-window] for sum_ in sums)
    centre = index[: len(total)] + (window - 1) / 2
    return total / window, (moment - centre * total) / (window * (window**2 - 1) / 12)


def _reach(
    config: ShaftConfig, angle: np.ndarray, y: np.ndarray, level: np.ndarray, began: np.ndarray, last: int
) -> np.ndarray:
    """[W] From the slope of moment over angle while the deflection grew, by least squares."""
    row = np.arange(len(level))[:, None]
    pushing = (row >= began) & (row <= last)
    peak = np.argmax(np.where(pushing, level, -1.0), axis=0)
    weight = (pushing & (row <= peak)).astype(float)
    count = np.maximum(weight.sum(axis=0), 1.0)
    da = (angle - (weight * angle).sum(axis=0) / count) * weight
    dy = (y - (weight * y).sum(axis=0) / count) * weight
    ratio = (da * dy).sum(axis=0) / np.maximum((da**2).sum(axis=0), 1e-12)
    # Too little was bent to tell: the tip, as if it were a point contact there.
    return np.where(np.sqrt((da**2).sum(axis=0) / count) > MIN_SWEEP, radial_distance(config, ratio), 1.0)


MIN_SWEEP = 5e-3
"""Standard deviation of the angle while pushing that tells the stiffness, rad."""
