"""Calibration of whiskers: noise and drift of their channels, contact thresholds, baselines that drift.

From a record of free whisking (whiskers touch nothing) follow mean and standard deviation of each deflection;
the contact threshold is a multiple of the standard deviation (20 in Salman & Pearson 2016, III-E). A whisker
that touched something in it would be silenced, because its contact counts as noise; it is named with its
reason, and refused or repaired.

Two figures of a record mislead. Its standard deviation counts a contact and a drift as noise. That of the
differences of neighbouring samples counts only sqrt(1 - c) of first-order autoregressive noise with
coefficient c (0.74 at c = 0.45, as measured on magnetic whiskers). So noise is taken from differences between
samples that are far enough apart to be independent, in short windows of which only the quiet ones count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from tactile.base.errors import InputError
from tactile.base.samples import robust_sd, true_runs
from tactile.base.settings import Settings
from tactile.base.types import Cycle

LAG = 10
"""Samples between the two of a difference. Autoregressive noise of coefficient 0.7 keeps 0.03 of its
correlation over it, which lowers the estimated standard deviation by 1.5 %."""
WINDOW = 30
"""Differences in a window."""
QUIET = 0.25
"""Share of the windows that is taken as free of contacts whatever they hold."""
QUIET_RATIO = 3.0
"""A window counts if its variance is below this multiple of the `QUIET` quantile over windows. Of normally
distributed white noise, one window in some 500 is above it."""
_NORMAL_MEDIAN_SQUARE = 0.45493642311957283
"""Median of the square of a standard normal variable."""


def _noise_windows(record: np.ndarray, lag: int = LAG) -> tuple[np.ndarray, np.ndarray]:
    """The noise variance of each short window of a record [T, ...], from differences between samples `lag`
    apart: [J, ...] half their mean square; and [J, ...] bool, whether it is that of noise.

    Windows overlap by half; window j is of the `WINDOW + lag` samples from sample j * (WINDOW // 2) on.

    Raises:
        InputError: the record is shorter than one window, or has NaN or infinite samples.
    """
    record = _finite("noise", record, lag + WINDOW)
    square = (record[lag:] - record[:-lag]) ** 2
    windows = np.lib.stride_tricks.sliding_window_view(square, WINDOW, axis=0)[:: WINDOW // 2]
    variances = windows.mean(axis=-1) / 2
    return variances, variances <= QUIET_RATIO * np.quantile(variances, QUIET, axis=0)


def _finite(where: str, record: np.ndarray, least: int) -> np.ndarray:
    """A record as floats; an `InputError` of fewer than `least` samples, or of NaN or infinite ones."""
    record = np.asarray(record, float)
    if len(record) < least:
        found = f"a record of {len(record)} samples"
        raise InputError(where, found, f"at least {least} samples", "record for longer")
    if not np.isfinite(record).all():
        raise InputError(where, "NaN or infinite samples", "finite samples", "leave these channels out")
    return record


def estimate_noise(record: np.ndarray, lag: int = LAG) -> np.ndarray:
    """The standard deviation of the noise of each channel.

    The mean variance of the quiet windows. Coloured noise counts in full if its correlation is gone after
    `lag` samples. A contact disturbs the windows that it changes in; contacts that change in less than three
    quarters of the windows, however strong, leave the estimate between 0.7 and 1.5 times the free one (a
    short record has few windows). A slow drift adds what it changes within `lag` samples.

    Args:
        record: [T, ...] samples, in any unit. lag: samples after which the noise is uncorrelated.

    Returns:
        [...] standard deviations, in the record's unit; 0 for a constant channel.

    Raises:
        InputError: the record is shorter than one window, or has NaN or infinite samples.
    """
    variances, quiet = _noise_windows(record, lag)
    return np.sqrt((variances * quiet).sum(axis=0) / quiet.sum(axis=0))


def estimate_drift(record: np.ndarray, block: int = 100) -> np.ndarray:
    """The drift of each channel, as the growth of a random walk: its standard deviation after one sample.

    After n samples the walk has the standard deviation `drift * sqrt(n)`. Of the means of blocks of L
    samples, differences over two blocks have a variance larger by drift^2 L than those over one; the noise
    cancels.
    The variances are medians of squares, so contacts in fewer than half of the differences do not raise them
    much. A steady slope counts as a walk.

    Args:
        record: [T, ...] samples, in any unit. block: samples in a block.

    Returns:
        [...] unit of the record per square root of a sample; 0 where no drift exceeds the noise.

    Raises:
        InputError: the record is shorter than eight blocks, or has NaN or infinite samples.
    """
    record = _finite("drift", record, 8 * block)
    count = len(record) // block
    means = record[: count * block].reshape(count, block, *record.shape[1:]).mean(axis=1)
    one, two = (np.median((means[gap:] - means[:-gap]) ** 2, axis=0) for gap in (1, 2))
    return np.sqrt(np.maximum(two - one, 0.0) / _NORMAL_MEDIAN_SQUARE / block)


class DirtyRecordConfig(Settings):
    """Whiskers that touched something during a record of free whiskers."""

    on_dirty: Literal["refuse", "repair"] = "refuse"
    """Whether such a whisker is an error, or is calibrated on the longest clean stretch of the record; an
    error if there is none."""
    max_ratio: PositiveFloat = 4.0
    """A whisker is dirty if its standard deviation over its noise, or its noise, exceeds that of the median
    whisker by this factor."""


class FreeBaseline(NamedTuple):
    """Baseline of W whiskers with K channels.

    Attributes:
        mean, noise: [W, K] in the unit of the signal. dirty: whiskers that had to be repaired,
            and what shows that they touched something, in words.
    """

    mean: np.ndarray
    noise: np.ndarray
    dirty: Mapping[int, str]


def _find_dirty_whiskers(sd: np.ndarray, noise: np.ndarray, max_ratio: float) -> dict[int, str]:
    """Whiskers, each with a reason, whose record holds more than noise, or more noise than the others'.

    Whisking itself deflects whiskers, so the ratio of standard deviation to noise is compared with that of
    the median whisker.

    Args:
        sd: [W, K] standard deviations of the whole record. noise: [W, K] of its quiet windows
            (`estimate_noise`); whiskers without a signal have 0 and are left out.
    """
    live = (noise > 0).all(axis=1)
    if not live.any():
        return {}
    ratio = np.divide(sd, noise, out=np.zeros_like(sd), where=noise > 0)
    above = ratio / np.median(ratio[live], axis=0), noise / np.median(noise[live], axis=0)
    found = {}
    for whisker in np.flatnonzero(live).tolist():
        moves, noisy = (float(part[whisker].max()) for part in above)
        if moves > max_ratio:
            most = ratio[whisker].max()
            reason = f"its standard deviation is {most:.3g} times its noise, {moves:.2g} times the usual"
            found[whisker] = reason
        elif noisy > max_ratio:
            found[whisker] = f"its noise is {noisy:.2g} times the median whisker's"
    return found


def calibrate_free(config: DirtyRecordConfig, record: np.ndarray, where: str = "free record") -> FreeBaseline:
    """Baseline and noise of whiskers from a record in which they should touch nothing.

    Args:
        record: [T, W, K] samples. where: name of the record in errors.

    Raises:
        InputError: the record is too short or has NaN; a whisker touched something, and is to be refused or
            has no clean stretch.
    """
    noise, mean = estimate_noise(record), record.mean(axis=0)
    dirty = _find_dirty_whiskers(record.std(axis=0), noise, config.max_ratio)
    if dirty and config.on_dirty == "refuse":
        raise _dirty_error(where, dirty, "record again with nothing within reach, or set on_dirty: repair")
    usual = np.median(noise, axis=0)
    for whisker, reason in dirty.items():
        rows = _clean_stretch(record[:, whisker], config.max_ratio * usual)
        if rows is None:
            hopeless = {whisker: f"{reason}, and it has no clean stretch"}
            raise _dirty_error(where, hopeless, "record again with nothing within reach")
        mean[whisker] = record[rows, whisker].mean(axis=0)
        noise[whisker] = estimate_noise(record[rows, whisker])
    return FreeBaseline(mean, noise, dirty)


def _clean_stretch(record: np.ndarray, limit: np.ndarray) -> slice | None:
    """The longest stretch of one whisker's record [T, K] in which all windows are quiet, with a noise of at
    most `limit` [K]; None if no window is.

    A whisker that is pressed steadily looks free; where it is pressed for the longer part of the record, the
    stretch is of the press.
    """
    variances, quiet = _noise_windows(record)
    quiet = np.all(quiet & (variances <= limit**2), axis=-1)
    if not quiet.any():
        return None
    runs = true_runs(quiet)
    first, end = runs[np.argmax(runs[:, 1] - runs[:, 0])].tolist()  # the first of the longest ones
    return slice(first * (WINDOW // 2), (end - 1) * (WINDOW // 2) + WINDOW + LAG)


def _dirty_error(where: str, dirty: Mapping[int, str], cure: str) -> InputError:
    """The error that names each dirty whisker with its reason."""
    found = "; ".join(f"contacts of whisker {whisker}: {reason}" for whisker, reason in dirty.items())
    return InputError(where, found, "free whiskers", cure)


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

    def to_json(self) -> dict[str, Any]:
        """The calibration as a JSON object; infinite values are strings."""
        return {name: _plain(np.asarray(value).tolist()) for name, value in self._asdict().items()}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Calibration:
        """The inverse of `to_json`.

        Raises:
            InputError: a field is missing or has the wrong shape.
        """
        if lacking := [name for name in cls._fields if name not in stored]:
            raise InputError("calibration", f"{', '.join(lacking)} missing", "all fields of a calibration")
        kinds = {name: bool if name == "alive" else float for name in cls._fields}
        values: dict[str, Any] = {name: np.asarray(stored[name], kind) for name, kind in kinds.items()}
        whiskers = values["alive"].size
        for name, value in values.items():
            by_axis = name in ("mean", "sd", "threshold")
            shape = () if name == "rate" else (whiskers, 2) if by_axis else (whiskers,)
            if value.shape != shape:
                raise InputError(f"calibration.{name}", f"shape {value.shape}", str(shape))
        return cls(**values | {"rate": float(values["rate"])})


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
    if not record:
        raise InputError(where, "an empty record", f"at least {config.min_duration:g} s of free whisking")
    rates = [sample_rate(cycle.time, slope_window, where) for cycle in record]
    duration = sum(len(cycle.time) / rate for cycle, rate in zip(record, rates, strict=True))
    if duration < config.min_duration - 1e-6:
        raise InputError(where, f"{duration:.2g} s", f"at least {config.min_duration:g} s of free whisking")
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
    # A clipped channel is often at one of its extremes.
    high, low = (deflection == end for end in (deflection.max(axis=0), deflection.min(axis=0)))
    at_end = np.maximum(high.mean(axis=0), low.mean(axis=0))
    clipped = (at_end > 0.05) | (np.abs(deflection) >= config.full_scale).any(axis=0)
    if (bad := clipped.any(axis=1) & alive).any():
        found = f"deflections of {_list_whiskers(bad)} are constant or at their limits"
        raise InputError(where, found, "unclipped samples", "check the sensors or list the whiskers as dead")

    mean, sd = deflection.mean(axis=0), deflection.std(axis=0)
    dirty = _find_touched(config, deflection, alive)
    if dirty and config.on_dirty == "refuse":
        cure = "record again with nothing within reach, or set on_dirty: repair"
        raise _dirty_error(where, dirty, cure)
    for whisker, reason in dirty.items():
        mean[whisker], sd[whisker] = _repair(config, record, whisker, reason, where)
    return Calibration(
        mean=np.where(alive[:, None], mean, 0.0),
        sd=np.where(alive[:, None], sd, 0.0),
        threshold=np.where(alive[:, None], config.threshold_sds * sd, np.inf),
        free=np.where(alive, np.mean([cycle.angle.max(axis=0) for cycle in record], axis=0), 0.0),
        alive=alive,
        rate=float(np.median(rates)),
    )


def _find_touched(config: CalibrationConfig, deflection: np.ndarray, alive: np.ndarray) -> dict[int, str]:
    """Whiskers with contacts in deflections [T, W, 2]: outliers, more than noise, or more than the others."""
    outside = _outliers(config, deflection, deflection).mean(axis=0).max(axis=1)
    sd, noise = deflection.std(axis=0), np.where(alive[:, None], estimate_noise(deflection), 0.0)
    louder = (sd / np.maximum(np.median(sd[alive], axis=0), 1e-300)).max(axis=1)
    found = _find_dirty_whiskers(sd, noise, config.max_ratio)
    for whisker in np.flatnonzero(alive & (louder > config.max_sd_ratio)).tolist():
        found[whisker] = f"its standard deviation is {louder[whisker]:.2g} times the median whisker's"
    for whisker in np.flatnonzero(alive & (outside > config.max_outlier_share)).tolist():
        beyond = f"{config.outlier_sds:g} robust standard deviations"
        found[whisker] = f"{outside[whisker]:.2%} of its samples are further than {beyond} from the median"
    return dict(sorted(found.items()))


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
        found = {whisker: f"{reason}, and most of its cycles are alike"}
        raise _dirty_error(where, found, "record again with nothing within reach")
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


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value if isinstance(value, bool) or np.isfinite(value) else str(value)


def _list_whiskers(which: np.ndarray) -> str:
    numbers = np.flatnonzero(which).tolist()
    return f"whisker{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"


class RestBaselineConfig(Settings):
    """Tracking of the baseline between whisk cycles."""

    rest_time: PositiveFloat = 0.02
    """Time from the beginning of a cycle in which a whisker is at rest, s."""
    gain: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the way to its level at rest that the baseline goes in a cycle. Below 1 the noise of the rest
    is averaged over cycles, but the baseline lags behind a drift."""
    free_sds: PositiveFloat = 6.0
    """A whisker further than this from its baseline at rest touches something, or is bent, and its baseline
    stands still; in standard deviations of the free deflection. The distance grows with the root of the
    cycles since the whisker was last free, as a random walk does."""
    bent_cycles: PositiveInt = 40
    """A whisker that is away from its baseline at rest for this many cycles on end counts as bent: it has no
    signal until it returns, and the distance grows no more."""


class RestBaseline(NamedTuple):
    """Baselines of W whiskers.

    Attributes:
        offset: [W, 2] drift since the calibration, rad. away: [W] cycles on end away from the baseline; a
            whisker that stays away for `bent_cycles` is bent.
    """

    offset: np.ndarray
    away: np.ndarray


def follow_baseline(
    config: RestBaselineConfig, calibration: Calibration, baseline: RestBaseline, cycle: Cycle
) -> RestBaseline:
    """The baselines after the rest at the beginning of a cycle; whiskers with NaN samples keep theirs.

    At the beginning of a cycle a whisker is at rest, before its protraction touches anything, so these
    samples show how far the baseline has drifted. A cycle without samples changes nothing. What moves most
    whiskers at once is no contact but their surroundings, as the Earth's field does when the head turns: the
    distance at which a whisker is away is then three times the median of all.
    """
    count = round(config.rest_time * calibration.rate)
    if not len(cycle.time) or not count:
        return baseline
    rest = cycle.deflection[:count].mean(axis=0) - calibration.mean - baseline.offset
    known = calibration.alive & np.isfinite(rest).all(axis=-1)
    wandering = np.sqrt(1.0 + np.minimum(baseline.away, config.bent_cycles))
    away = np.abs(rest) / np.maximum(calibration.sd, np.finfo(float).tiny)
    common = max(1.0, float(np.median(away[known])) / 2) if known.any() else 1.0
    free = known & (away <= config.free_sds * wandering[:, None] * common).all(axis=-1)
    return RestBaseline(
        offset=baseline.offset + np.where(free[:, None], config.gain * rest, 0.0),
        away=np.where(known, np.where(free, 0, baseline.away + 1), baseline.away),
    )
