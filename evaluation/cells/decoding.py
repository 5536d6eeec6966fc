"""Position decoded from the activity of recorded cells (Zhang et al. 1998), with its error; and the drift of
the activity packet, its decoded pose minus the true pose over time (Burak & Fiete 2009)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
    """

    time: np.ndarray
    truth: np.ndarray
    decoded: np.ndarray
    error: np.ndarray
    median: float
    control: np.ndarray


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
    cells, flat prior), cross-validated: odd blocks of time with the maps of the even ones and the other way
    round.

    With a flat prior the most probable place does not depend on the spikes/s per unit of activity, so no
    rate is needed; activity is decoded without the noise of spikes. Control: the decoded positions, shifted
    round the session by at least a tenth of it against the true ones.

    Args:
        window: time over which activity is averaged, s. block: time of the blocks that by turns make the maps
            and test them, s; a place visited too shortly in the one half is never decoded in the other.
            bins: along each side of the box. smoothing: of the maps, bins. shifts: of the control.

    Raises:
        InputError: lengths differ, no pose is known, the path has no area or is shorter than four blocks.
    """
    edges = rate_map.arena_edges(recording.truth, bins)
    samples = rate_map.box_samples(recording.time, recording.truth, recording.activity, *edges, 1)
    number = ((samples.time - samples.time[0]) // block).astype(int)
    if number[-1] < 3:
        length = samples.time[-1] - samples.time[0]
        raise InputError("recording", f"{length:.1f} s", f"four blocks of {block} s")
    halves = [_decode_half(samples, number % 2 == half, edges, window, smoothing) for half in (0, 1)]
    time, truth, decoded = (np.concatenate(parts) for parts in zip(*halves, strict=True))
    order = np.argsort(time, kind="stable")
    time, truth, decoded = time[order], truth[order], decoded[order]
    error = np.linalg.norm(decoded - truth, axis=1)
    least = max(len(truth) // 10, 1)
    by = stream(seed, "decoding control").integers(least, len(truth) - least + 1, shifts)
    control = np.array([np.median(np.linalg.norm(np.roll(decoded, k, axis=0) - truth, axis=1)) for k in by])
    return Decoding(time, truth, decoded, error, float(np.median(error)), control)


def log_posterior(
    counts: np.ndarray, seconds: np.ndarray, rates: np.ndarray, log_prior: np.ndarray
) -> np.ndarray:
    """[M, H, W] logarithm of the posterior of each place, up to a constant of the window (Zhang et al. 1998,
    eq. 36).

    sum_i n_i log f_i(x) - t sum_i f_i(x) + log prior(x); -inf at places without a rate. A rate below a
    thousandth of the cell's mean over places counts as that, so that one spike excludes no place.

    Args:
        counts: [M, n] spikes. seconds: [M] length of each window, s. rates: [n, H, W] spikes/s, NaN where
            unknown.
        log_prior: [H, W], zeros for a flat one.
    """
    places = rates.shape[1:]
    flat = rates.reshape(len(rates), -1)
    known = np.isfinite(flat).all(axis=0)
    level = flat[:, known]
    floor = np.maximum(1e-3 * level.mean(axis=1, keepdims=True), np.finfo(float).tiny)
    level = np.maximum(level, floor)
    posterior = np.full((len(counts), flat.shape[1]), -np.inf)
    posterior[:, known] = counts @ np.log(level) - np.multiply.outer(seconds, level.sum(axis=0))
    return posterior.reshape(-1, *places) + log_prior


def _decode_half(
    samples: rate_map.BoxSamples, train: np.ndarray, edges: _Edges, seconds: float, sigma: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [M] s, true and decoded places [M, 2] m of the windows of `seconds` outside `train` [samples]
    bool."""
    maps = rate_map.sum_samples(rate_map.BoxSamples(*(each[train] for each in samples)), *edges, 1)
    rates = rate_map.rate_maps(maps, sigma)
    test = rate_map.BoxSamples(*(each[~train] for each in samples))
    _, window = np.unique((test.time - samples.time[0]) // seconds, return_inverse=True)
    spent = np.bincount(window, test.seconds)
    counts = _sum_windows(window, test.activity * test.seconds[:, None])
    size = np.bincount(window)[:, None]
    time, truth = (_sum_windows(window, each) / size for each in (test.time[:, None], test.position))
    posterior = log_posterior(counts, spent, rates, np.zeros(rates.shape[1:]))
    row, column = np.divmod(posterior.reshape(len(counts), -1).argmax(axis=1), rates.shape[2])
    x, y = ((each[1:] + each[:-1]) / 2 for each in edges)
    return time[:, 0], truth, np.stack([x[column], y[row]], axis=1)


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
