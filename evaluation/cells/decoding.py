"""Position decoded from the activity of recorded cells (Zhang et al. 1998), with its error; and the drift of
the activity packet, its decoded pose minus the true pose over time (Burak & Fiete 2009)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from evaluation.cells import rate_map
from evaluation.cells.recording import CellRecording
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between, compose

_Edges = tuple[np.ndarray, np.ndarray]


class Decoding(NamedTuple):
    """Decoded positions in M windows.

    Attributes:
        time: [M] s, middle of the window. truth, decoded: [M, 2] m. error: [M] distance between them, m.
        median: of the error, m. control: [shifts] median errors of circularly shifted activity, m.
        level: [M] the truth is in the most probable region that holds a share q of the posterior if its level
            is below q, so that levels of an exact posterior are even over 0 to 1. Only of spikes: the
            posterior of an activity depends on its unit.
    """

    time: np.ndarray
    truth: np.ndarray
    decoded: np.ndarray
    error: np.ndarray
    median: float
    control: np.ndarray
    level: np.ndarray


def decode_positions(
    recording: CellRecording,
    *,
    window: float = 0.5,
    block: float = 20.0,
    bins: int = 20,
    smoothing: float = 1.5,
    shifts: int = 100,
    seed: int = 0,
) -> Decoding:
    """Decodes the position of the rat from the chosen cells (Zhang et al. 1998: Bayes, independent Poisson
    cells, flat prior), cross-validated: every tenth block of time with the maps of the others.

    With a flat prior the most probable place does not depend on the spikes/s per unit of activity, so no
    rate is needed; activity is decoded without the noise of spikes. Control: the decoded positions, shifted
    round the session by at least a tenth of it against the true ones.

    Args:
        window: time over which activity is averaged, s. block: time of the blocks that by turns are decoded
            with maps of the others, s. bins: along each side of the box. smoothing: of the maps, bins; a
            place far from all that was visited is never decoded. shifts: of the control.

    Raises:
        InputError: lengths differ, no pose is known, the path has no area or is shorter than four blocks.
    """
    edges = rate_map.arena_edges(recording.truth, bins)
    samples = rate_map.box_samples(recording.time, recording.truth, recording.activity, *edges, 1)
    number = ((samples.time - samples.time[0]) // block).astype(int)
    if number[-1] < 3:
        length = samples.time[-1] - samples.time[0]
        raise InputError("recording", f"{length:.1f} s", f"four blocks of {block} s")
    random = stream(seed, "credible levels")
    folds = [number % FOLDS == fold for fold in range(min(FOLDS, number[-1] + 1))]
    decodings = [
        _decode_rest(samples, ~fold, edges, window, smoothing, random) for fold in folds if fold.any()
    ]
    time, truth, decoded, level = (np.concatenate(parts) for parts in zip(*decodings, strict=True))
    order = np.argsort(time, kind="stable")
    time, truth, decoded, level = time[order], truth[order], decoded[order], level[order]
    error = np.linalg.norm(decoded - truth, axis=1)
    least = max(len(truth) // 10, 1)
    by = stream(seed, "decoding control").integers(least, len(truth) - least + 1, shifts)
    control = np.array([np.median(np.linalg.norm(np.roll(decoded, k, axis=0) - truth, axis=1)) for k in by])
    return Decoding(time, truth, decoded, error, float(np.median(error)), control, level)


FOLDS, LEAST_SHARE = 10, 0.01
"""Parts of a session that are decoded by turns; share of the mean time of a place, smoothed, from which it
has a rate."""
PRIOR = 0.5
"""Spikes that a rate is given before any was seen, at the mean rate of the cell (Jeffreys' 1/2)."""


def log_posterior(
    counts: np.ndarray,
    seconds: np.ndarray,
    rates: np.ndarray,
    log_prior: np.ndarray,
    exposure: np.ndarray | None = None,
) -> np.ndarray:
    """[M, H, W] logarithm of the posterior of each place, up to a constant of the window (Zhang et al. 1998,
    eq. 36).

    sum_i n_i log f_i(x) - t sum_i f_i(x) + log prior(x); -inf at places without a rate. A rate below a
    thousandth of the cell's mean over places counts as that, so that one spike excludes no place.

    With the times from which the rates were estimated, the spikes of a window have the negative binomial
    distribution that is left when the rate is drawn from its gamma posterior. Maps of a short session are
    uncertain, and a posterior that takes them as true is too sure.

    Args:
        counts: [M, n] spikes. seconds: [M] length of each window, s. rates: [n, H, W] spikes/s, NaN where
            unknown.
        log_prior: [H, W], zeros for a flat one. exposure: [H, W] s, the time without smoothing that makes the
            rates as certain as they are; counts are then whole numbers. None: the rates are known.
    """
    places = rates.shape[1:]
    flat = rates.reshape(len(rates), -1)
    known = np.isfinite(flat).all(axis=0)
    level = flat[:, known]
    posterior = np.full((len(counts), flat.shape[1]), -np.inf)
    if exposure is not None:
        shape = level * exposure.reshape(-1)[known] + PRIOR
        spent = exposure.reshape(-1)[known] + PRIOR / np.maximum(level.mean(axis=1, keepdims=True), 1e-9)
        found = np.zeros((len(counts), known.sum()))
        for window in np.unique(seconds):
            rows = seconds == window
            again = np.log(window / (spent + window))
            for number in np.unique(counts[rows]):
                term = gammaln(number + shape) - gammaln(shape) + shape * np.log1p(-window / (spent + window))
                found[rows] += (counts[rows] == number) @ (term + number * again)
        posterior[:, known] = found
        return posterior.reshape(-1, *places) + log_prior
    floor = np.maximum(1e-3 * level.mean(axis=1, keepdims=True), np.finfo(float).tiny)
    level = np.maximum(level, floor)
    posterior[:, known] = counts @ np.log(level) - np.multiply.outer(seconds, level.sum(axis=0))
    return posterior.reshape(-1, *places) + log_prior


def _decode_rest(
    samples: rate_map.BoxSamples,
    train: np.ndarray,
    edges: _Edges,
    seconds: float,
    sigma: float,
    random: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times [M] s, true and decoded places [M, 2] m and levels [M] of the windows of `seconds` outside
    `train` [samples] bool."""
    maps = rate_map.sum_samples(rate_map.BoxSamples(*(each[train] for each in samples)), *edges, 1)
    smooth = rate_map.smooth_plane(maps.seconds, sigma)
    near = smooth > LEAST_SHARE * smooth.mean()
    rates = rate_map.smooth_plane(maps.place, sigma) / np.where(near, smooth, np.nan)
    test = rate_map.BoxSamples(*(each[~train] for each in samples))
    _, window = np.unique((test.time - samples.time[0]) // seconds, return_inverse=True)
    spent = np.bincount(window, test.seconds).round(9)
    counts = _sum_windows(window, test.activity * test.seconds[:, None])
    size = np.bincount(window)[:, None]
    time, truth = (_sum_windows(window, each) / size for each in (test.time[:, None], test.position))
    whole, exposure = np.rint(counts), None
    if np.allclose(counts, whole, rtol=0, atol=1e-6):  # spikes
        counts, exposure = whole, smooth**2 / rate_map.smooth_plane(maps.seconds, sigma, squared=True)
    posterior = log_posterior(counts, spent, rates, np.zeros(rates.shape[1:]), exposure)
    flat = posterior.reshape(len(counts), -1)
    row, column = np.divmod(flat.argmax(axis=1), rates.shape[2])
    x, y = ((each[1:] + each[:-1]) / 2 for each in edges)
    share = np.exp(flat - flat.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    place = rate_map.place_index(np.column_stack([truth, np.zeros(len(truth))]), *edges)
    own = share[np.arange(len(share)), place][:, None]
    # A bin is entered in part: the truth lies anywhere in it.
    level = np.where(share > own, share, 0.0).sum(axis=1) + random.random(len(share)) * own[:, 0]
    return time[:, 0], truth, np.stack([x[column], y[row]], axis=1), level


def _sum_windows(window: np.ndarray, values: np.ndarray) -> np.ndarray:
    """[M, k] sums of values [T, k], whose windows [T] come in order."""
    return np.add.reduceat(values, np.flatnonzero(np.diff(window, prepend=-1)), axis=0)


def packet_drift(recording: CellRecording) -> np.ndarray:
    """[T, 3] decoded minus true pose along the x and y of the sheet and in heading, m, m, rad: 0 at the first
    known pose, NaN where the true pose is unknown (drift of path integration as in Burak & Fiete 2009).

    The sheet has its own origin and axes, so the true path is moved such that its first known pose is the
    packet's. The torus tells a pose only up to its sides; the error is unwrapped over time: between
    successive known poses it takes the shortest way. An injection that moves the packet by more than half a
    side is thus counted to the nearest copy of its target.

    Raises:
        InputError: lengths differ or no pose is known.
    """
    moved = truth_in_sheet(recording)
    known = np.flatnonzero(rate_map.known_poses(moved))
    wrapped = recording.packet_pose - moved
    error = np.full(wrapped.shape, np.nan)
    sides = enumerate(recording.torus_sides)
    error[known] = np.stack([np.unwrap(wrapped[known, i], period=side) for i, side in sides], axis=1)
    error[known] -= error[known[0]]
    return error


def truth_in_sheet(recording: CellRecording) -> np.ndarray:
    """[T, 3] true poses in the frame of the sheet, m, m, rad, not folded; the first known one is the
    packet's.

    Raises:
        InputError: lengths differ or no pose is known.
    """
    rate_map.check_lengths(recording.time, recording.truth, recording.packet)
    first = np.flatnonzero(rate_map.known_poses(recording.truth))[0]
    truth = np.asarray(recording.truth, np.float64)
    return compose(recording.packet_pose[first], between(truth[first], truth))
