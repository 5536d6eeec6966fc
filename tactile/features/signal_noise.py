"""Noise and drift of sensor channels, from a record that may hold contacts.

Two figures of a record mislead. The standard deviation of the whole record counts a contact and a drift as
noise. The standard deviation of neighbouring samples' differences counts only a part of coloured noise: of
first-order autoregressive noise with coefficient c it gives sqrt(1 - c) of the standard deviation (0.74 at
c = 0.45, as measured on magnetic whiskers). Here the differences are between samples far enough apart to be
independent, and they are taken in short windows, of which only the quiet ones count.
"""

from __future__ import annotations

import numpy as np

from tactile.base.errors import InputError

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


def window_variances(record: np.ndarray, lag: int = LAG, window: int = WINDOW) -> np.ndarray:
    """The noise variance of each short window of a record, from differences between samples `lag` apart.

    Windows overlap by half; window j is of the `window + lag` samples from sample j * (window // 2) on.

    Args:
        record: [T, ...] samples. lag: samples between the two of a difference. window: differences in a
            window.

    Returns:
        [J, ...] half the mean square of the differences of each window.

    Raises:
        InputError: the record is shorter than one window, or has NaN or infinite samples.
    """
    record = np.asarray(record, float)
    if len(record) < lag + window:
        found = f"a record of {len(record)} samples"
        raise InputError("noise", found, f"at least {lag + window} samples", "record for longer")
    if not np.isfinite(record).all():
        raise InputError("noise", "NaN or infinite samples", "finite samples", "leave these channels out")
    square = (record[lag:] - record[:-lag]) ** 2
    windows = np.lib.stride_tricks.sliding_window_view(square, window, axis=0)[:: max(window // 2, 1)]
    return windows.mean(axis=-1) / 2


def quiet_windows(variances: np.ndarray) -> np.ndarray:
    """[J, ...] bool, the windows whose variance is that of noise, by channel.

    Args:
        variances: [J, ...] from `window_variances`.
    """
    return variances <= QUIET_RATIO * np.quantile(variances, QUIET, axis=0)


def estimate_noise(record: np.ndarray, lag: int = LAG, window: int = WINDOW) -> np.ndarray:
    """The standard deviation of the noise of each channel.

    The mean variance of the quiet windows. Coloured noise counts in full if its correlation is gone after
    `lag` samples. A contact disturbs the windows that it changes in; contacts that change in less than three
    quarters of the windows, however strong, leave the estimate between 0.7 and 1.5 times the free one (a
    short record has few windows). A slow drift adds what it changes within `lag` samples.

    Args:
        record: [T, ...] samples, in any unit. lag: samples after which the noise is uncorrelated.
            window: differences in a window; a few times `lag`.

    Returns:
        [...] standard deviations, in the record's unit; 0 for a constant channel.

    Raises:
        InputError: the record is shorter than one window, or has NaN or infinite samples.
    """
    variances = window_variances(record, lag, window)
    quiet = quiet_windows(variances)
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
    record = np.asarray(record, float)
    count = len(record) // block
    if count < 8:
        found = f"a record of {len(record)} samples"
        raise InputError("drift", found, f"at least {8 * block} samples", "record for longer")
    if not np.isfinite(record).all():
        raise InputError("drift", "NaN or infinite samples", "finite samples", "leave these channels out")
    means = record[: count * block].reshape(count, block, *record.shape[1:]).mean(axis=1)
    one, two = (np.median((means[gap:] - means[:-gap]) ** 2, axis=0) for gap in (1, 2))
    return np.sqrt(np.maximum(two - one, 0.0) / _NORMAL_MEDIAN_SQUARE / block)
