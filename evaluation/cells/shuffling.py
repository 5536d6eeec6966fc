"""Shuffled controls: scores of cells whose activity is shifted in time against the path.

A shuffle shifts the activity of a cell circularly in time, by a random shift of at least 20 s either way, and
keeps the path (Langston et al. 2010, Science 328:1576; Wills et al. 2010, Science 328:1573). It keeps the
time course of the activity and the occupancy, and removes their relation. Each cell draws its own shifts:
with shifts common to all cells, the errors of cells that fire together would be one error.

The 95th percentile of S shuffles is their value at rank 0.95 (S + 1) (Hyndman and Fan 1996, type 6). A score
with the distribution of its shuffles exceeds it in 5 % of cells. The usual linear rule, rank
1 + 0.95 (S - 1), lies lower: with 100 shuffles, 5.9 % exceed it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.stats import binom

from evaluation.cells import rate_map
from evaluation.cells.recording import CellRecording
from tactile.base.compiled import compiled
from tactile.base.errors import InputError
from tactile.base.random_streams import stream

Score = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Scores [n] from the mean activity [n, *shape], NaN in bins without visits, and the seconds [*shape]; or
several at once, [k, n]."""

SHORTEST_SHIFT = 20.0
"""Shortest shift of a shuffle, s, either way round."""
PERCENTILE = 0.95
_FEWEST = 19
"""Fewest shuffles from which rank 0.95 (S + 1) exists."""
SPEED_BIN, SPEED_BINS = 0.02, 20
"""Width, m/s, and number of the bins of the running speed."""


class PathBins(NamedTuple):
    """The bin of each sample of a path: of place, of heading or of any other variable.

    Attributes:
        flat: [T] int flat index into bins of `shape`, -1 for a sample that does not count. shape: of the
            bins, (H, W) or (B,). seconds: [T] s that each sample stands for.
    """

    flat: np.ndarray
    shape: tuple[int, ...]
    seconds: np.ndarray


class ShuffledScores(NamedTuple):
    """Scores of cells and of their shuffles.

    Attributes:
        score: [C] of the cells as recorded. shuffled: [S, C] of their shuffles. NaN where there is no score.
            Of k scores at once [k, C] and [S, k, C].
    """

    score: np.ndarray
    shuffled: np.ndarray

    @property
    def percentile(self) -> np.ndarray:
        """95th percentile of the shuffles of each cell: [C], at rank 0.95 (S + 1).

        Shuffles without a score are left out; NaN for a cell with fewer than 19 others.
        """
        ordered = np.sort(self.shuffled, axis=0)
        count = np.isfinite(ordered).sum(axis=0)
        rank = PERCENTILE * (count + 1)
        low = np.clip(rank.astype(int), 1, np.maximum(count, 1))
        high = np.clip(low + 1, 1, np.maximum(count, 1))
        below, above = np.take_along_axis(ordered, np.stack([low, high]) - 1, axis=0)
        return np.where(count >= _FEWEST, below + (rank - low) * (above - below), np.nan)

    @property
    def low_percentile(self) -> np.ndarray:
        """5th percentile of the shuffles of each cell: [C], at rank 0.05 (S + 1); NaN as `percentile`."""
        return -ShuffledScores(-self.score, -self.shuffled).percentile

    @property
    def mean(self) -> np.ndarray:
        """Mean score of the shuffles of each cell: [C], over those that have one; NaN where none has."""
        known = np.isfinite(self.shuffled)
        count = np.where(known.any(axis=0), known.sum(axis=0), np.nan)
        return np.where(known, self.shuffled, 0.0).sum(axis=0) / count

    @property
    def corrected(self) -> np.ndarray:
        """[C] score minus the mean of its shuffles: of an information, without the bias of few spikes."""
        return self.score - self.mean

    @property
    def above(self) -> np.ndarray:
        """[C] bool: the score exceeds the percentile; a tie does not, nor does a cell without score."""
        return self.score > self.percentile


class Calibration(NamedTuple):
    """How often shuffled cells exceed the 95th percentile of their own shuffles.

    Attributes:
        cells: that have a score and a percentile. share: of them above the percentile. tied: share of them
            at it, as happens to a score of few values; it is missing in `share`.
        low, high: binomial 95 % band of the share round 5 %. shuffled_mean: mean score of all shuffles.
    """

    cells: int
    share: float
    tied: float
    low: float
    high: float
    shuffled_mean: float


def shuffled_scores(
    activity: np.ndarray, bins: PathBins, score: Score, shuffles: int = 100, seed: int = 0
) -> ShuffledScores:
    """Scores of cells and of their shuffles.

    Args:
        activity: [T, C] any unit. bins: of the same T samples. score: of mean activities per bin; smoothing
            belongs into it. shuffles: of each cell. seed: of the stream "cell shuffles".

    Raises:
        InputError: the path has another length, has NaN, is at most 40 s long, or spends no time in a bin.
    """
    _check_path(activity, bins)
    # Shifts in samples, at least 20 s either way round the session; gaps in the path count as no time.
    samples, seconds = len(bins.flat), float(np.sum(bins.seconds))
    shortest = int(np.ceil(SHORTEST_SHIFT * samples / seconds))
    if samples <= 2 * shortest:
        found, expected = f"a path of {seconds:g} s", f"more than {2 * SHORTEST_SHIFT:g} s"
        cure = f"record longer: a shuffle shifts by at least {SHORTEST_SHIFT:g} s either way"
        raise InputError("bins.seconds", found, expected, cure)
    shape = shuffles, activity.shape[1]
    shifts = stream(seed, "cell shuffles").integers(shortest, samples - shortest + 1, shape)
    return _score_shifts(activity, bins, score, shifts)


def path_bins(recording: CellRecording, kind: str) -> PathBins:
    """The bin of each step by a kind: `place`, 20 x 20 over the box that the path fills; `heading`, 36;
    `joint`, 8 x 10 x 10 of both; `speed`, 20 of 2 cm/s.

    Raises:
        InputError: lengths differ, no pose is known or the path has no area.
    """
    turns, across = (8, 10) if kind == "joint" else (36, 20)
    seconds = rate_map.sample_seconds(recording.time)
    place = rate_map.place_index(recording.truth, *rate_map.arena_edges(recording.truth, across))
    heading = rate_map.heading_index(recording.truth, turns)
    if kind == "place":
        return PathBins(np.where(heading < 0, -1, place), (across, across), seconds)
    if kind == "heading":
        return PathBins(np.where(place < 0, -1, heading), (turns,), seconds)
    if kind == "speed":
        speed = rate_map.running_speed(recording.time, recording.truth)
        known = (heading >= 0) & (place >= 0) & (speed < SPEED_BIN * SPEED_BINS)
        return PathBins(np.where(known, speed // SPEED_BIN, -1).astype(int), (SPEED_BINS,), seconds)
    both = np.where((place < 0) | (heading < 0), -1, heading * across**2 + place)
    return PathBins(both, (turns, across, across), seconds)


def calibrate(
    activity: np.ndarray, bins: PathBins, score: Score, shuffles: int = 100, seed: int = 0
) -> Calibration:
    """Checks the shuffles of a score on cells that are themselves shuffled.

    Each cell is first shifted by any shift of the session, drawn from the stream "calibration", and then
    treated as recorded. Its score and its shuffled scores then have one distribution, and the share above the
    percentile should lie in the binomial 95 % band round 5 %. The one difference: no shuffle lies within 20 s
    of its cell. A score that varies more slowly with the shift than that exceeds the percentile more often.

    Args:
        activity, bins, score, shuffles, seed: as in `shuffled_scores`.

    Raises:
        InputError: as in `shuffled_scores`.
    """
    _check_path(activity, bins)
    own = stream(seed, "calibration").integers(0, len(activity), (activity.shape[1],))
    moved = np.stack([np.roll(cell, shift) for cell, shift in zip(activity.T, own, strict=True)], axis=1)
    result = shuffled_scores(moved, bins, score, shuffles, seed)
    valid = np.isfinite(result.score) & np.isfinite(result.percentile)
    cells = int(valid.sum())
    low, high = binom.interval(0.95, cells, 1 - PERCENTILE) if cells else (np.nan, np.nan)
    known = result.shuffled[np.isfinite(result.shuffled)]
    return Calibration(
        cells=cells,
        share=float(result.above[valid].mean()) if cells else np.nan,
        tied=float((result.score == result.percentile)[valid].mean()) if cells else np.nan,
        low=float(low) / max(cells, 1),
        high=float(high) / max(cells, 1),
        shuffled_mean=float(known.mean()) if known.size else np.nan,
    )


def _score_shifts(activity: np.ndarray, bins: PathBins, score: Score, shifts: np.ndarray) -> ShuffledScores:
    """Scores of the cells, and at the shifts [S, C]."""
    size = math.prod(bins.shape)
    flat = np.where(bins.flat < 0, size, bins.flat).astype(int)
    seconds = np.bincount(flat, bins.seconds, size + 1)[:size]
    sample, cell = np.nonzero(activity)
    active = activity[sample, cell].astype(float)

    def score_at(shift: np.ndarray) -> np.ndarray:
        sums = np.zeros((len(shift), size + 1))
        _add_shifted(sums, cell, sample, active, shift, flat, bins.seconds)
        rates = sums[:, :size] / np.where(seconds > 0, seconds, np.nan)
        return score(rates.reshape(-1, *bins.shape), seconds.reshape(bins.shape))

    recorded = score_at(np.zeros(activity.shape[1], int))
    return ShuffledScores(recorded, np.array([score_at(shift) for shift in shifts]))


@compiled
def _add_shifted(
    sums: np.ndarray, cell: np.ndarray, sample: np.ndarray, active: np.ndarray, shift: np.ndarray,
    flat: np.ndarray, seconds: np.ndarray,
) -> None:  # fmt: skip
    """Adds the activity [M] of cells in samples, moved by the shifts [C] of the cells, to sums [C, B] over
    the bins [T] of the samples there, times their seconds [T]."""
    for each in range(len(active)):
        at = (sample[each] + shift[cell[each]]) % len(flat)
        sums[cell[each], flat[at]] += active[each] * seconds[at]


def _check_path(activity: np.ndarray, bins: PathBins) -> None:
    lengths = {len(activity), len(bins.flat), len(bins.seconds)}
    if activity.ndim != 2 or len(lengths) > 1:
        found = f"{len(activity)} samples of activity, {len(bins.flat)} bins, {len(bins.seconds)} seconds"
        raise InputError("activity", found, "[T, C] activity and [T] samples of the path")
    size = math.prod(bins.shape)
    unknown = ~((bins.flat >= -1) & (bins.flat < size) & np.isfinite(bins.seconds))
    if unknown.any():
        samples = f"in {unknown.sum()} samples of the path, first in sample {unknown.argmax()}"
        cure = "leave out samples of unknown pose, or give them bin -1"
        raise InputError("bins", f"NaN or no such bin {samples}", f"-1 .. {size - 1}", cure)
    if not bins.seconds[bins.flat >= 0].sum() > 0:
        raise InputError("bins", "no time in any bin", "a path in the arena", "check the edges")
