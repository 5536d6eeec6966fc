"""Baseline and noise of whiskers from a record in which they should touch nothing, and the whiskers that did.

A free record with a contact in it silences its whisker: the contact counts as noise, and nothing later stands
out of it. Such a whisker is named with a reason, and refused or repaired.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from pydantic import PositiveFloat

from tactile.base.errors import InputError
from tactile.base.samples import longest_run
from tactile.base.settings import Settings
from tactile.features.signal_noise import LAG, WINDOW, estimate_noise, quiet_windows, window_variances


class DirtyRecordConfig(Settings):
    """Whiskers that touched something during a record of free whiskers."""

    on_dirty: Literal["refuse", "repair"] = "refuse"
    """Whether such a whisker is an error, or is calibrated on the longest clean stretch of the record; an
    error if there is none."""
    max_ratio: PositiveFloat = 4.0
    """A whisker is dirty if its standard deviation over its noise, or its noise, exceeds that of the median
    whisker by this factor."""


class DirtyWhisker(NamedTuple):
    """A whisker that touched something during a free record.

    Attributes:
        whisker: its number. reason: what shows it, in words.
    """

    whisker: int
    reason: str


class FreeBaseline(NamedTuple):
    """Baseline of W whiskers with K channels.

    Attributes:
        mean, noise: [W, K] in the unit of the signal. dirty: whiskers that had to be repaired, and why.
    """

    mean: np.ndarray
    noise: np.ndarray
    dirty: tuple[DirtyWhisker, ...]


def find_dirty_whiskers(sd: np.ndarray, noise: np.ndarray, max_ratio: float) -> list[DirtyWhisker]:
    """Whiskers whose record holds more than noise, or more noise than the others'.

    Whisking itself deflects whiskers, so the ratio of standard deviation to noise is compared with that of
    the median whisker.

    Args:
        sd: [W, K] standard deviations of the whole record. noise: [W, K] of its quiet windows
            (`signal_noise`); whiskers without a signal have 0 and are left out.
    """
    live = (noise > 0).all(axis=1)
    if not live.any():
        return []
    ratio = np.divide(sd, noise, out=np.zeros_like(sd), where=noise > 0)
    above = ratio / np.median(ratio[live], axis=0), noise / np.median(noise[live], axis=0)
    found = []
    for whisker in np.flatnonzero(live):
        moves, noisy = (float(part[whisker].max()) for part in above)
        if moves > max_ratio:
            most = ratio[whisker].max()
            reason = f"its standard deviation is {most:.3g} times its noise, {moves:.2g} times the usual"
            found.append(DirtyWhisker(int(whisker), reason))
        elif noisy > max_ratio:
            found.append(DirtyWhisker(int(whisker), f"its noise is {noisy:.2g} times the median whisker's"))
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
    dirty = find_dirty_whiskers(record.std(axis=0), noise, config.max_ratio)
    if dirty and config.on_dirty == "refuse":
        raise dirty_error(where, dirty, "record again with nothing within reach, or set on_dirty: repair")
    usual = np.median(noise, axis=0)
    for whisker, reason in dirty:
        rows = clean_stretch(record[:, whisker], config.max_ratio * usual)
        if rows is None:
            hopeless = [DirtyWhisker(whisker, f"{reason}, and it has no clean stretch")]
            raise dirty_error(where, hopeless, "record again with nothing within reach")
        mean[whisker] = record[rows, whisker].mean(axis=0)
        noise[whisker] = estimate_noise(record[rows, whisker])
    return FreeBaseline(mean, noise, tuple(dirty))


def clean_stretch(record: np.ndarray, limit: np.ndarray) -> slice | None:
    """The longest stretch of one whisker's record in which all windows are quiet.

    A whisker that is pressed steadily looks free; where it is pressed for the longer part of the record, the
    stretch is of the press.

    Args:
        record: [T, K] samples. limit: [K] largest noise of a quiet window.

    Returns:
        The rows, or None if no window is quiet.
    """
    variances = window_variances(record)
    quiet = np.all(quiet_windows(variances) & (variances <= limit**2), axis=-1)
    if not quiet.any():
        return None
    run = longest_run(quiet)
    return slice(run.start * (WINDOW // 2), (run.stop - 1) * (WINDOW // 2) + WINDOW + LAG)


def dirty_error(where: str, dirty: list[DirtyWhisker], cure: str) -> InputError:
    """The error that names each dirty whisker with its reason."""
    found = "; ".join(f"contacts of whisker {whisker}: {reason}" for whisker, reason in dirty)
    return InputError(where, found, "free whiskers", cure)
