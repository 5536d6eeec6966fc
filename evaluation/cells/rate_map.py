"""Rate maps: mean activity in each bin of the box, from time series or from sums.

A rate map [cells, H, W] is the activity summed over time in each bin divided by the time there. Both are
smoothed first, by the same Gaussian, so a bin visited for a long time weighs more than a short visit beside
it (as in Skaggs et al. 1996). opexebo smooths the finished map instead: `smooth_plane` of the map with 0 for
bins without a rate. The map has the unit of the activity: multiply by spikes/s per unit of activity for Hz.
The coherence of a map is the correlation of the rate in a bin with that of its neighbours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from evaluation.cells.recording import BinnedSums, CellRecording
from tactile.base.errors import InputError

LEAST_SECONDS = 0.1
"""Time in a bin from which it has a rate, s."""


def rate_maps(sums: BinnedSums, smoothing: float = 1.5, least_seconds: float = LEAST_SECONDS) -> np.ndarray:
    """[cells, H, W] mean activity, NaN in bins visited for less than `least_seconds`.

    Args:
        smoothing: standard deviation of the Gaussian, bins; 0 for none.

    Raises:
        InputError: the sums do not fit each other, or no bin was visited long enough.
    """
    if sums.place.shape[1:] != sums.seconds.shape:
        expected = f"the bins of sums.seconds, {sums.seconds.shape}"
        raise InputError("sums.place", f"bins {sums.place.shape[1:]}", expected)
    visited = _visited(sums.seconds, least_seconds)
    rates = smooth_plane(sums.place, smoothing)
    rates *= np.where(visited, 1 / np.where(visited, smooth_plane(sums.seconds, smoothing), 1.0), np.nan)
    return rates


def tuning_curves(sums: BinnedSums) -> np.ndarray:
    """[cells, B] mean activity at each heading, NaN at headings held for less than `LEAST_SECONDS`.

    Raises:
        InputError: the sums do not fit each other, or no heading was held long enough.
    """
    if sums.heading.shape[1:] != sums.heading_seconds.shape:
        found, expected = f"{sums.heading.shape[1]} bins", f"{len(sums.heading_seconds)} of heading_seconds"
        raise InputError("sums.heading", found, expected)
    visited = _visited(sums.heading_seconds, LEAST_SECONDS)
    return sums.heading / np.where(visited, sums.heading_seconds, np.nan)


def smooth_rates(rates: np.ndarray, seconds: np.ndarray, sigma: float) -> np.ndarray:
    """[n, H, W] maps that were not smoothed, smoothed as `rate_maps` does; NaN stay NaN and do not spread.

    Weights are the times in the bins; with weights of 1 this is `opexebo.general.smooth(mask_fill=nan)`. A
    score of smoothed maps for `shuffling`: `lambda rates, seconds: score(smooth_rates(rates, seconds, 1.5),
    seconds)`.

    Args:
        rates: [n, H, W], NaN where unknown. seconds: [H, W] s. sigma: of the Gaussian, bins.
    """
    weight = np.isfinite(rates) & (seconds > 0)
    sums = smooth_plane(np.where(weight, rates, 0.0) * seconds, sigma)
    return sums / np.where(weight, smooth_plane(weight * seconds, sigma), np.nan)


def smooth_plane(values: np.ndarray, sigma: float, squared: bool = False) -> np.ndarray:
    """Values [..., H, W] smoothed by a Gaussian of `sigma` bins, cut off at 4 sigma, mirrored at the walls.

    With `squared` the weights are squared, which makes variances of them.

    The value beside a wall is repeated outside (d c b a | a b c d), so no activity leaves the box. NaN
    spread; smooth `numpy.nan_to_num(values)` and the mask of visited bins and divide to ignore them.
    """
    height, width = _kernel(values.shape[-2], sigma), _kernel(values.shape[-1], sigma)
    return _multiply(height**2, values, width**2) if squared else _multiply(height, values, width)


class BoxSamples(NamedTuple):
    """The M samples of a path whose pose is known and inside the box.

    Attributes:
        time, seconds: [M] s. position: [M, 2] m. place: [M] int bin in the flattened [H, W]. heading: [M] int
            bin. activity: [M, C].
    """

    time: np.ndarray
    seconds: np.ndarray
    position: np.ndarray
    place: np.ndarray
    heading: np.ndarray
    activity: np.ndarray


def bin_activity(
    time: np.ndarray,
    truth: np.ndarray,
    activity: np.ndarray,
    x_edges: np.ndarray,
    y_edges: np.ndarray,
    heading_bins: int = 36,
) -> BinnedSums:
    """Sums activity times time into bins of place and heading; arguments and errors are those of
    `box_samples`."""
    samples = box_samples(time, truth, activity, x_edges, y_edges, heading_bins)
    return sum_samples(samples, x_edges, y_edges, heading_bins)


def recorded_sums(recording: CellRecording) -> tuple[BinnedSums, np.ndarray]:
    """The sums of n recorded cells and their indices [n] in the network: of the chosen ones, in bins over the
    box that the path fills, or, if only sums were recorded, of all.

    Raises:
        InputError: no cells were recorded, lengths differ, no pose is known or the path has no area.
    """
    sums, cell = recording.sums, recording.cell
    if sums is not None and len(cell) == 0:
        return sums, np.arange(len(sums.place))
    if len(cell) == 0:
        raise InputError("recording", "no cells", "chosen cells or sums", "set cells.chosen or cells.sums")
    if recording.activity.shape[1:] != cell.shape:
        found = f"activity of {recording.activity.shape} for {len(cell)} cells"
        raise InputError("recording", found, "one column for each chosen cell")
    edges = arena_edges(recording.truth)
    return bin_activity(recording.time, recording.truth, recording.activity, *edges), np.asarray(cell)


def box_samples(
    time: np.ndarray,
    truth: np.ndarray,
    activity: np.ndarray,
    x_edges: np.ndarray,
    y_edges: np.ndarray,
    heading_bins: int = 36,
) -> BoxSamples:
    """The samples inside the box with their bins.

    A sample stands for the time since the sample before, the first for the median of these. Samples of
    unknown pose and outside the edges do not count; the last edges belong to the last bins.

    Args:
        time: [T] s. truth: [T, 3] m, m, rad, NaN where unknown. activity: [T, C].
        x_edges: [W + 1] m. y_edges: [H + 1] m.

    Raises:
        InputError: lengths differ, time runs backwards, no pose is known or no time is spent inside the
            edges.
    """
    check_lengths(time, truth, activity)
    seconds = sample_seconds(time)
    place, heading = place_index(truth, x_edges, y_edges), heading_index(truth, heading_bins)
    inside = np.flatnonzero((place >= 0) & (heading >= 0))
    if not seconds[inside].sum() > 0:
        raise InputError("truth", "no time is spent in any bin", "a path inside the edges", "check the edges")
    series = np.asarray(time), seconds, truth[:, :2], place, heading, activity
    return BoxSamples(*(each[inside] for each in series))


def sum_samples(
    samples: BoxSamples, x_edges: np.ndarray, y_edges: np.ndarray, heading_bins: int
) -> BinnedSums:
    """The sums over samples that `box_samples` placed in these bins."""
    shape = len(y_edges) - 1, len(x_edges) - 1
    seconds, place = sum_into(samples.place, samples.seconds, samples.activity, shape)
    heading_seconds, heading = sum_into(samples.heading, samples.seconds, samples.activity, (heading_bins,))
    return BinnedSums(np.asarray(x_edges), np.asarray(y_edges), seconds, place, heading_seconds, heading)


def sum_into(
    bins: np.ndarray, seconds: np.ndarray, activity: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Seconds [*shape] in each bin, and activity times seconds [C, *shape].

    Args:
        bins: [M] int flat index of the bin of each sample. seconds: [M] s. activity: [M, C].
    """
    count, samples = math.prod(shape), np.arange(len(bins))
    weights = csr_array((seconds, (bins, samples)), shape=(count, len(bins)))
    sums = (weights @ np.asarray(activity, np.float64)).T
    return np.bincount(bins, seconds, count).reshape(shape), np.ascontiguousarray(sums).reshape(-1, *shape)


def sample_seconds(time: np.ndarray) -> np.ndarray:
    """[T] s since the sample before; the first takes the median of the others.

    Raises:
        InputError: fewer than two samples, an unknown time or time that runs backwards.
    """
    steps = np.diff(np.asarray(time, np.float64))
    if len(steps) == 0 or not np.isfinite(time).all() or (steps < 0).any():
        raise InputError("time", f"{len(time)} samples, not all in order", "two or more rising times, s")
    return np.concatenate([[np.median(steps)], steps])


def arena_edges(truth: np.ndarray, bins: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """x_edges and y_edges, [bins + 1] m each, of equal bins over the box that the path [T, 3] fills.

    Raises:
        InputError: no pose is known, or the path has no width or no height.
    """
    place = truth[known_poses(truth), :2]
    low, high = place.min(axis=0), place.max(axis=0)
    if not (high > low).all():
        raise InputError("truth", "a path without width or height", "a path that fills a box")
    x, y = np.linspace(low, high, bins + 1).T
    return x, y


def known_poses(truth: np.ndarray) -> np.ndarray:
    """[T] bool, the pose [T, 3] is known.

    Raises:
        InputError: no pose is known.
    """
    known = np.isfinite(truth).all(axis=1)
    if not known.any():
        raise InputError("truth", "no known pose: the path is NaN throughout", "m, m, rad", "record a truth")
    return known


def check_lengths(time: np.ndarray, *series: np.ndarray) -> None:
    """Raises an InputError unless every series has a row for each time."""
    lengths = [len(each) for each in (time, *series)]
    if len(set(lengths)) > 1:
        raise InputError("recording", f"series of {' and '.join(map(str, lengths))} rows", "equal lengths")


def place_index(truth: np.ndarray, x_edges: np.ndarray, y_edges: np.ndarray) -> np.ndarray:
    """[T] int bin of each pose [T, 3] in the flattened [H, W], -1 outside and where the position is unknown.

    The last edges belong to the last bins.

    Raises:
        InputError: no pose is known.
    """
    known_poses(truth)
    row, column = _interval(truth[:, 1], y_edges), _interval(truth[:, 0], x_edges)
    return np.where((row >= 0) & (column >= 0), row * (len(x_edges) - 1) + column, -1)


def heading_index(truth: np.ndarray, bins: int) -> np.ndarray:
    """[T] int bin of the heading of each pose [T, 3], -1 where it is unknown; bin b is centred on 2 pi b /
    bins.

    Raises:
        InputError: no pose is known.
    """
    known_poses(truth)
    known = np.isfinite(truth[:, 2])
    return np.where(known, circle_bin(np.where(known, truth[:, 2], 0.0), bins), -1)


def running_speed(time: np.ndarray, truth: np.ndarray, window: float = 0.4) -> np.ndarray:
    """[T] m/s: the distance between the places half a window before and after, over the time between them.

    NaN where one is unknown. A tracker's jitter within the window is not motion.

    Args:
        time: [T] s. truth: [T, 3] m, m, rad. window: s.
    """
    first = np.searchsorted(time, time - window / 2 - 1e-9)
    last = np.searchsorted(time, time + window / 2 + 1e-9, side="right") - 1
    elapsed = time[last] - time[first]
    return np.hypot(*(truth[last, :2] - truth[first, :2]).T) / np.where(elapsed > 0, elapsed, np.nan)


def circle_bin(angle: np.ndarray, bins: int) -> np.ndarray:
    """[T] int bin of each angle, rad; bin b is centred on 2 pi b / bins."""
    return np.round(angle * bins / (2 * np.pi)).astype(int) % bins


def weigh_bins(rates: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rates [n, bins] with 0 for NaN, and the share of time [n, bins] among the bins that have a rate.

    Args:
        rates: [n, ...] over any bins, NaN where unknown. seconds: [...] time in each bin, s.

    Returns:
        the share is [1, bins] if all rates know the same bins.

    Raises:
        InputError: the bins differ, or no bin has both a rate and time.
    """
    if rates.shape[1:] != seconds.shape:
        raise InputError("seconds", f"bins {seconds.shape}", f"the bins of the rates, {rates.shape[1:]}")
    flat = rates.reshape(len(rates), -1)
    known = known_bins(flat)
    share = known * np.asarray(seconds, np.float64).reshape(-1)
    total = share.sum(axis=1, keepdims=True)
    if len(rates) and not total.any():
        raise InputError("seconds", "no time in any bin", "time in bins that have a rate", "check the edges")
    share /= np.where(total > 0, total, np.nan)
    return np.where(known, flat, 0.0), share


def known_bins(rates: np.ndarray) -> np.ndarray:
    """[n, ...] bool, the bins of rates [n, ...] that are known; [1, ...] if they are the same in all."""
    known = np.isfinite(rates)
    return known[:1] if (known == known[:1]).all() else known


def _interval(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """[T] int index of the interval of each value, -1 outside or unknown."""
    at = np.searchsorted(edges, values, side="right") - 1
    at = np.where(values == edges[-1], len(edges) - 2, at)
    return np.where(at < len(edges) - 1, at, -1)


def _visited(seconds: np.ndarray, least_seconds: float) -> np.ndarray:
    visited = seconds >= least_seconds
    if not visited.any():
        found, cure = f"no bin with {least_seconds} s of time", "check edges and least_seconds"
        raise InputError("sums", found, "a visited arena", cure)
    return visited


def _kernel(bins: int, sigma: float) -> np.ndarray:
    """[bins, bins] matrix that smooths a column of `bins` values."""
    eye = np.eye(bins)
    from scipy.ndimage import gaussian_filter1d  # slow to import

    return gaussian_filter1d(eye, sigma, axis=0, mode="reflect", truncate=4.0) if sigma > 0 else eye


def coherence(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] z-transformed correlation of the rate of a bin with the mean rate of its 8 neighbours.

    Muller & Kubie 1989. For maps that were not smoothed: smoothing makes neighbours alike. Bins without a
    rate do not count, and beside a wall the mean is over the neighbours inside. opexebo instead counts
    neighbours outside as 0 and gives the correlation itself: `correlate(rates, neighbour_means(padded)[:,
    1:-1, 1:-1])` with `padded` = rates within a frame of zeros. NaN for a flat map.

    Args:
        rates: [n, H, W], NaN where unknown. seconds: [H, W] s, not used: every bin counts alike.
    """
    correlation = correlate(rates, neighbour_means(rates))
    return np.arctanh(np.clip(correlation, -1 + 1e-15, 1 - 1e-15))


def neighbour_means(rates: np.ndarray) -> np.ndarray:
    """[n, H, W] mean rate of the up to 8 neighbours that have one, NaN without."""
    known = known_bins(rates)
    count = _sum_neighbours(known.astype(float))
    total = _sum_neighbours(np.where(known, rates, 0.0))
    return total / np.where(count > 0, count, np.nan)


def correlate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] Pearson correlation of maps a and b [n, ...] over the bins in which both are known, NaN if one is
    flat."""
    a, b = (values.reshape(len(values), -1) for values in (a, b))
    known = known_bins(a) & known_bins(b)
    count = np.maximum(known.sum(axis=1, keepdims=True), 1)
    a, b = (np.where(known, values, 0.0) for values in (a, b))
    a, b = (np.where(known, values - values.sum(axis=1, keepdims=True) / count, 0.0) for values in (a, b))
    power = np.vecdot(a, a) * np.vecdot(b, b)
    return np.vecdot(a, b) / np.sqrt(np.where(power > 0, power, np.nan))


def _sum_neighbours(values: np.ndarray) -> np.ndarray:
    """[n, H, W] sum over the 8 neighbours."""
    height, width = values.shape[-2:]
    return _multiply(_band(height), values, _band(width)) - values


def _multiply(height: np.ndarray, values: np.ndarray, width: np.ndarray) -> np.ndarray:
    """height [H, H] @ values [..., H, W] @ width.T [W, W]; the second product is one for all values."""
    rows = values.reshape(-1, len(width)) @ width.T
    return height @ rows.reshape(values.shape)


def _band(bins: int) -> np.ndarray:
    """[bins, bins] 1 for bins at most one apart."""
    return np.eye(bins) + np.eye(bins, k=1) + np.eye(bins, k=-1)
