"""Calibration of a whisker head from a record of free whisking (whiskers touch nothing).

The record gives mean and standard deviation of each deflection; the contact threshold is a multiple of the
standard deviation (20 in Salman & Pearson 2016, III-E).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat

from tactile.base.errors import InputError
from tactile.base.samples import robust_sd
from tactile.base.types import Cycle
from tactile.features.free_record import DirtyRecordConfig, DirtyWhisker, dirty_error, find_dirty_whiskers
from tactile.features.signal_noise import estimate_noise

MIN_WINDOW_SAMPLES = 8
"""Least number of samples in a slope window; the slope of fewer is mostly noise."""


class CalibrationConfig(DirtyRecordConfig):
    """Contact threshold of a calibration, and checks of its free-whisking record."""

    threshold_sds: PositiveFloat = 20.0
    """Contact threshold, in standard deviations of the free deflection."""
    min_duration: PositiveFloat = 4.0
    """Shortest record, s."""
    full_scale: PositiveFloat = 1.5
    """Deflection at which the sensors saturate, rad."""
    outlier_sds: PositiveFloat = 6.0
    """A sample further from the median than this many robust standard deviations is an outlier."""
    max_outlier_share: Annotated[float, Field(gt=0, lt=1)] = 5e-4
    """A whisker with a larger share of outliers had contacts."""
    max_sd_ratio: PositiveFloat = 6.0
    """A whisker whose standard deviation exceeds the median whisker's by this factor had contacts."""


class Calibration(NamedTuple):
    """Free-whisking statistics of W whiskers.

    Attributes:
        mean, sd: [W, 2] mean and standard deviation of the deflections, rad.
        threshold: [W, 2] distance from the mean that counts as contact, rad; infinite where not alive.
        free: [W] largest protraction in free air, rad. alive: [W] bool. rate: samples per second.
    """

    mean: np.ndarray
    sd: np.ndarray
    threshold: np.ndarray
    free: np.ndarray
    alive: np.ndarray
    rate: float


def calibrate(
    config: CalibrationConfig, record: Sequence[Cycle], slope_window: float = 0.01, where: str = "calibration"
) -> Calibration:
    """Calibrates a head from a free-whisking record.

    A whisker is dead if neither its angle nor its deflection changes, or if its deflection is exactly zero
    throughout.

    Args:
        slope_window: window of the contact detection, s. where: name of the record in errors.

    Raises:
        InputError: the record is too short, is sampled too slowly, or has channels with NaN or at their
            limits; a whisker has contacts that are to be refused, or in half of the cycles; or no whisker is
            alive.
    """
    rate = _rate(config, record, slope_window, where)
    angle = np.concatenate([cycle.angle for cycle in record])
    deflection = np.concatenate([cycle.deflection for cycle in record])
    missing = ~(np.isfinite(angle).all(axis=0) & np.isfinite(deflection).all(axis=(0, 2)))
    if missing.any():
        found, cure = f"{_list_whiskers(missing)}: NaN samples", "check the wiring of these channels"
        raise InputError(where, found, "finite samples", cure)
    stuck = np.ptp(deflection, axis=0) == 0
    alive = ~(stuck.all(axis=1) & ((np.ptp(angle, axis=0) == 0) | (deflection == 0).all(axis=(0, 2))))
    if not alive.any():
        cure = "whisk while recording; a simulated head needs sensor noise above 0 (`mechanics.noise`)"
        raise InputError(where, "no whisker has a signal", "at least one live whisker", cure)
    if (bad := _is_saturated(config, deflection) & alive).any():
        found = f"deflections of {_list_whiskers(bad)} are constant or at their limits"
        raise InputError(where, found, "unclipped samples", "check the sensors or list the whiskers as dead")

    mean, sd = deflection.mean(axis=0), deflection.std(axis=0)
    dirty = _find_touched(config, deflection, alive)
    if dirty and config.on_dirty == "refuse":
        cure = "record again with nothing within reach, or set on_dirty: repair"
        raise dirty_error(where, dirty, cure)
    for whisker, reason in dirty:
        mean[whisker], sd[whisker] = _repair(config, record, whisker, reason, where)
    return Calibration(
        mean=np.where(alive[:, None], mean, 0.0),
        sd=np.where(alive[:, None], sd, 0.0),
        threshold=np.where(alive[:, None], config.threshold_sds * sd, np.inf),
        free=np.where(alive, np.mean([cycle.angle.max(axis=0) for cycle in record], axis=0), 0.0),
        alive=alive,
        rate=rate,
    )


def _find_touched(config: CalibrationConfig, deflection: np.ndarray, alive: np.ndarray) -> list[DirtyWhisker]:
    """Whiskers with contacts in deflections [T, W, 2]: outliers, more than noise, or more than the others."""
    outside = _outliers(config, deflection, deflection).mean(axis=0).max(axis=1)
    sd, noise = deflection.std(axis=0), np.where(alive[:, None], estimate_noise(deflection), 0.0)
    louder = (sd / np.maximum(np.median(sd[alive], axis=0), 1e-300)).max(axis=1)
    found = {whisker: reason for whisker, reason in find_dirty_whiskers(sd, noise, config.max_ratio)}
    for whisker in np.flatnonzero(alive & (louder > config.max_sd_ratio)).tolist():
        found[whisker] = f"its standard deviation is {louder[whisker]:.2g} times the median whisker's"
    for whisker in np.flatnonzero(alive & (outside > config.max_outlier_share)).tolist():
        beyond = f"{config.outlier_sds:g} robust standard deviations"
        found[whisker] = f"{outside[whisker]:.2%} of its samples are further than {beyond} from the median"
    return [DirtyWhisker(whisker, found[whisker]) for whisker in sorted(found)]


def _outliers(config: CalibrationConfig, part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Bool of the shape of `part`, whether its samples are outliers of the record `whole` [T, ...]."""
    middle = np.median(whole, axis=0)
    return np.abs(part - middle) > config.outlier_sds * robust_sd(whole - middle)


def _repair(
    config: CalibrationConfig, record: Sequence[Cycle], whisker: int, reason: str, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation [2] of a whisker over the cycles in which it touched nothing."""
    parts = [cycle.deflection[:, whisker] for cycle in record]
    quiet = np.quantile([part.std(axis=0) for part in parts], 0.25, axis=0)
    whole = np.concatenate(parts)
    clean = [
        part
        for part in parts
        if (part.std(axis=0) <= 2 * quiet).all()
        and (_outliers(config, part, whole).mean(axis=0) <= config.max_outlier_share).all()
    ]
    if 2 * len(clean) <= len(parts):
        found = [DirtyWhisker(whisker, f"{reason}, and most of its cycles are alike")]
        raise dirty_error(where, found, "record again with nothing within reach")
    return np.concatenate(clean).mean(axis=0), np.concatenate(clean).std(axis=0)


def sample_rate(time: np.ndarray, slope_window: float, where: str) -> float:
    """Sample rate of a stream with times [T], per second.

    Raises:
        InputError: times are NaN, not increasing or have gaps, or the slope window holds too few samples.
    """
    step = np.diff(time)
    if len(step) == 0 or not np.isfinite(time).all() or (step <= 0).any():
        raise InputError(where, "times are NaN or not increasing", "increasing times, s")
    usual = float(np.median(step))
    if step.max() > 5 * usual:
        gap = f"a gap of {step.max() / usual:.0f} sample intervals"
        raise InputError(where, gap, "a stream without gaps", "leave this cycle out")
    if slope_window / usual < MIN_WINDOW_SAMPLES - 1e-6:
        least = f"at least {MIN_WINDOW_SAMPLES / slope_window:.0f} for a slope window of {slope_window:g} s"
        cure = "sample faster, or widen `contact.slope_window`"
        raise InputError(where, f"{1 / usual:.0f} samples per second", least, cure)
    return 1 / usual


def calibration_arrays(calibration: Calibration) -> dict[str, np.ndarray]:
    """The fields as arrays by name, for storage with a session; `calibration_from_arrays` reads them."""
    return {name: np.asarray(value) for name, value in calibration._asdict().items()}


def calibration_json(calibration: Calibration) -> dict[str, Any]:
    """The calibration as a JSON object; infinite values are strings."""
    return {name: _plain(array.tolist()) for name, array in calibration_arrays(calibration).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value if isinstance(value, bool) or np.isfinite(value) else str(value)


def calibration_from_arrays(stored: Mapping[str, np.ndarray], where: str = "calibration") -> Calibration:
    """The inverse of `calibration_arrays`.

    Raises:
        InputError: an array is missing or has the wrong shape.
    """
    lacking = [name for name in Calibration._fields if name not in stored]
    if lacking:
        raise InputError(where, f"{', '.join(lacking)} missing", "all arrays of a calibration")
    whiskers = len(np.atleast_1d(stored["alive"]))
    shapes: dict[str, tuple[int, ...]] = {name: (whiskers, 2) for name in ("mean", "sd", "threshold")}
    shapes |= {"free": (whiskers,), "alive": (whiskers,), "rate": ()}
    for name, shape in shapes.items():
        if np.shape(stored[name]) != shape:
            raise InputError(f"{where}.{name}", f"shape {np.shape(stored[name])}", str(shape))
    values = {name: np.asarray(stored[name], float) for name in Calibration._fields[:4]}
    return Calibration(**values, alive=np.asarray(stored["alive"], bool), rate=float(stored["rate"]))


def _rate(config: CalibrationConfig, record: Sequence[Cycle], slope_window: float, where: str) -> float:
    if not record:
        raise InputError(where, "an empty record", f"at least {config.min_duration:g} s of free whisking")
    rates = [sample_rate(cycle.time, slope_window, where) for cycle in record]
    duration = sum(len(cycle.time) / rate for cycle, rate in zip(record, rates, strict=True))
    if duration < config.min_duration - 1e-6:
        raise InputError(where, f"{duration:.2g} s", f"at least {config.min_duration:g} s of free whisking")
    return float(np.median(rates))


def _is_saturated(config: CalibrationConfig, deflection: np.ndarray) -> np.ndarray:
    """[W] bool, whether a whisker has a clipped channel, which is often at one of its extremes."""
    high, low = (deflection == end for end in (deflection.max(axis=0), deflection.min(axis=0)))
    at_end = np.maximum(high.mean(axis=0), low.mean(axis=0))
    return ((at_end > 0.05) | (np.abs(deflection) >= config.full_scale).any(axis=0)).any(axis=1)


def _list_whiskers(which: np.ndarray) -> str:
    numbers = np.flatnonzero(which).tolist()
    return f"whisker{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"
