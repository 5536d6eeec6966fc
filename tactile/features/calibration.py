"""What whiskers report when they touch nothing: the record that every threshold is made from.

A head whisks in free air; mean and standard deviation of each deflection follow, and a contact threshold of
so many standard deviations (Salman & Pearson 2016, III-E: twenty).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat

from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.types import Cycle

MIN_WINDOW_SAMPLES = 8
"""Samples that a slope window has to hold: a line through fewer is mostly noise."""


class CalibrationConfig(Settings):
    """What a free-whisking record has to be."""

    sds: PositiveFloat = 20.0
    """Contact threshold, in standard deviations of the free deflection."""
    shortest: PositiveFloat = 4.0
    """Duration that is enough, s."""
    full_scale: PositiveFloat = 1.5
    """Deflection at which the sensors saturate, rad."""
    tail_sds: PositiveFloat = 6.0
    """Robust standard deviations beyond which a sample is no noise."""
    tail: Annotated[float, Field(gt=0, lt=1)] = 5e-4
    """Share of such samples that betrays contacts."""
    louder: PositiveFloat = 6.0
    """A whisker whose deflection varies so many times more than the middle one's is not free."""


class Calibration(NamedTuple):
    """Attributes:
    mean, sd: [W, 2] of the free deflections, rad. threshold: [W, 2] rad from
    the mean that is contact, infinite for whiskers that are not alive.
    free: [W] largest protraction in free air, rad. alive: [W] bool. rate: samples per second.
    """

    mean: np.ndarray
    sd: np.ndarray
    threshold: np.ndarray
    free: np.ndarray
    alive: np.ndarray
    rate: float


def calibrate(
    config: CalibrationConfig,
    record: Sequence[Cycle],
    slope_window: float = 0.01,
    where: str = "calibration",
) -> Calibration:
    """The calibration that a free-whisking record gives.

    A whisker is dead if its angle stands still and its deflection too, or if its deflection is exactly zero
    throughout.

    Args:
        slope_window: s, of the contact detection that it is for. where: what errors call the record.

    Raises:
        InputError: it is too short or too coarse in time, has channels without values or at their limits, no
            whisker that lives, no noise at all, or contacts.
    """
    rate = _rate(config, record, slope_window, where)
    angle = np.concatenate([cycle.angle for cycle in record])
    deflection = np.concatenate([cycle.deflection for cycle in record])
    missing = ~(np.isfinite(angle).all(axis=0) & np.isfinite(deflection).all(axis=(0, 2)))
    if missing.any():
        raise InputError(
            where, f"values missing (NaN) of {_named(missing)}", "", "check these channels' wires"
        )
    stuck = np.ptp(deflection, axis=0) == 0
    alive = ~(stuck.all(axis=1) & ((np.ptp(angle, axis=0) == 0) | (deflection == 0).all(axis=(0, 2))))
    if not alive.any():
        cure = "whisk while recording; a simulated head needs sensor noise above 0 (`mechanics.noise`)"
        raise InputError(where, "no whisker reports any signal", "", cure)
    _refuse_saturated(config, deflection, alive, where)

    middle = np.median(deflection, axis=0)
    robust = 1.4826 * np.median(np.abs(deflection - middle), axis=0)
    outside = np.abs(deflection - middle) > config.tail_sds * robust
    touched = (outside.mean(axis=0) > config.tail).any(axis=1)
    sd = deflection.std(axis=0)
    touched |= (sd > config.louder * np.median(sd[alive], axis=0)).any(axis=1)
    if (touched & alive).any():
        cure = "record it again with nothing within reach"
        raise InputError(where, f"contacts of {_named(touched & alive)}", "a record of free whisking", cure)
    return Calibration(
        mean=np.where(alive[:, None], deflection.mean(axis=0), 0.0),
        sd=np.where(alive[:, None], sd, 0.0),
        threshold=np.where(alive[:, None], config.sds * sd, np.inf),
        free=np.where(alive, np.mean([cycle.angle.max(axis=0) for cycle in record], axis=0), 0.0),
        alive=alive,
        rate=rate,
    )


def sample_rate(time: np.ndarray, slope_window: float, where: str) -> float:
    """Samples per second of a stream.

    Raises:
        InputError: times missing, not in order or uneven, or too few samples for the slope window.
    """
    step = np.diff(time)
    if len(step) == 0 or not np.isfinite(time).all() or (step <= 0).any():
        raise InputError(where, "times are missing or out of order", "increasing times, s")
    usual = float(np.median(step))
    if step.max() > 5 * usual:
        lost = f"{step.max() / usual:.0f} sample intervals without a sample"
        raise InputError(where, lost, "an unbroken stream", "leave this cycle out")
    if slope_window / usual < MIN_WINDOW_SAMPLES - 1e-6:
        raise InputError(
            where,
            f"{1 / usual:.0f} samples per second",
            f"at least {MIN_WINDOW_SAMPLES / slope_window:.0f} for a slope window of {slope_window:g} s",
            "sample faster, or widen `contact.slope_window`",
        )
    return 1 / usual


def calibration_arrays(calibration: Calibration) -> dict[str, np.ndarray]:
    """As plain arrays by name, to be kept with a session."""
    return {name: np.asarray(value) for name, value in calibration._asdict().items()}


def calibration_json(calibration: Calibration) -> dict[str, Any]:
    """The calibration as a JSON document; infinite values are written as text."""
    return {name: _plain(array.tolist()) for name, array in calibration_arrays(calibration).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value if isinstance(value, bool) or np.isfinite(value) else str(value)


def calibration_from_arrays(kept: Mapping[str, np.ndarray], where: str = "calibration") -> Calibration:
    """The calibration that `calibration_arrays` made these of.

    Raises:
        InputError: one is missing, or their shapes do not fit.
    """
    lacking = [name for name in Calibration._fields if name not in kept]
    if lacking:
        raise InputError(where, f"no {', '.join(lacking)}", "a calibration as kept with a session")
    whiskers = len(np.atleast_1d(kept["alive"]))
    shapes: dict[str, tuple[int, ...]] = {name: (whiskers, 2) for name in ("mean", "sd", "threshold")}
    shapes |= {"free": (whiskers,), "alive": (whiskers,), "rate": ()}
    for name, shape in shapes.items():
        if np.shape(kept[name]) != shape:
            raise InputError(f"{where}.{name}", f"shape {np.shape(kept[name])}", str(shape))
    values = {name: np.asarray(kept[name], float) for name in Calibration._fields[:4]}
    return Calibration(**values, alive=np.asarray(kept["alive"], bool), rate=float(kept["rate"]))


def _rate(config: CalibrationConfig, record: Sequence[Cycle], slope_window: float, where: str) -> float:
    if not record:
        raise InputError(where, "an empty record", f"at least {config.shortest:g} s of free whisking")
    rates = [sample_rate(cycle.time, slope_window, where) for cycle in record]
    duration = sum(len(cycle.time) / rate for cycle, rate in zip(record, rates, strict=True))
    if duration < config.shortest - 1e-6:
        raise InputError(where, f"{duration:.2g} s", f"at least {config.shortest:g} s of free whisking")
    return float(np.median(rates))


def _refuse_saturated(
    config: CalibrationConfig, deflection: np.ndarray, alive: np.ndarray, where: str
) -> None:
    # A clipped channel spends its time at one of its own extremes.
    at_end = np.maximum(
        (deflection == deflection.max(axis=0)).mean(axis=0),
        (deflection == deflection.min(axis=0)).mean(axis=0),
    )
    bad = ((at_end > 0.05) | (np.abs(deflection) >= config.full_scale).any(axis=0)).any(axis=1) & alive
    if bad.any():
        found = f"deflections of {_named(bad)} stand still or at their limits"
        raise InputError(where, found, "", "check the sensors, or declare the whiskers dead")


def _named(which: np.ndarray) -> str:
    numbers = np.flatnonzero(which).tolist()
    return f"whisker{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"
