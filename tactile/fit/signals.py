"""Noise, drift, baseline and faults of each channel of each whisker, from a record with free whiskers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.features.free_record import DirtyRecordConfig, DirtyWhisker, calibrate_free
from tactile.features.signal_noise import estimate_drift, estimate_noise

REPAIR = DirtyRecordConfig(on_dirty="repair")
MOST_CONTACT = 0.1
"""Share of a record in contact from which the drift of a whisker is unknown: its contacts change it more."""


class SignalRecord(NamedTuple):
    """Signals of W whiskers with K channels.

    Attributes:
        free: [F, W, K] samples in which the whiskers should touch nothing. drifting: [T, W, K] samples from
            which drift is estimated. block, block_time: samples of it in a block, and time between the
            beginnings of two blocks, s. contact: [W] share of `drifting` in contact. names: of the whiskers.
            unit: of the signals.
    """

    free: np.ndarray
    drifting: np.ndarray
    block: int
    block_time: float
    contact: np.ndarray
    names: tuple[str, ...]
    unit: str


class SignalFit(NamedTuple):
    """Properties of W whiskers with K channels; 0 for dead whiskers.

    Attributes:
        baseline, noise, white: [W, K] mean, standard deviation, and that of white noise with the same
            differences of neighbouring samples. correlation: [W, K] of neighbouring samples. drift: [W, K]
            random walk after one second, NaN where unknown. dead: [W] bool, without a signal. dirty:
            whiskers that touched something in the free record, and why; the rest is of their clean part.
    """

    baseline: np.ndarray
    noise: np.ndarray
    white: np.ndarray
    correlation: np.ndarray
    drift: np.ndarray
    dead: np.ndarray
    dirty: tuple[DirtyWhisker, ...]


def fit_signals(record: SignalRecord) -> SignalFit:
    """The properties of all whiskers.

    Raises:
        InputError: no whisker has a signal, a record is too short, or a whisker is never free.
    """
    dead = (np.ptp(record.free, axis=0) == 0).all(axis=-1)
    live = ~dead
    shape = record.free.shape[1:]
    baseline, noise, white, drift = (np.zeros(shape) for _ in range(4))
    dirty: tuple[DirtyWhisker, ...] = ()
    if live.any():
        free = calibrate_free(REPAIR, record.free[:, live])
        baseline[live], noise[live] = free.mean, free.noise
        white[live] = np.minimum(estimate_noise(record.free[:, live], lag=1), free.noise)
        # Per root of a sample of `drifting`; a block of these stands for `block_time`.
        walk = estimate_drift(record.drifting[:, live], record.block) * np.sqrt(
            record.block / record.block_time
        )
        drift[live] = np.where(record.contact[live, None] > MOST_CONTACT, np.nan, walk)
        numbers = np.flatnonzero(live)
        dirty = tuple(one._replace(whisker=int(numbers[one.whisker])) for one in free.dirty)
    correlation = 1 - np.divide(white, noise, out=np.ones(shape), where=noise > 0) ** 2
    return SignalFit(baseline, noise, white, correlation, drift, dead, dirty)
