"""Spatial autocorrelograms of rate maps: the Pearson correlation of a map with its shifted self.

    r(lag) = (n Σ f g - Σ f Σ g) / sqrt((n Σ f² - (Σ f)²) (n Σ g² - (Σ g)²)),   g(x) = f(x + lag)

over the n bins that both maps have at that lag (Sargolini et al. 2006, Science 312:758, supplement). Large
lags have few common bins and are noise; they are cut as in opexebo (`analysis.autocorrelation`).

The radius of the central field of autocorrelograms, by the adaptive threshold of opexebo.

opexebo (`analysis.place_field`, MIT) grows a field round the centre: the threshold falls from 0.95 to 0.2 of
the peak, and the growth ends where the connected region has a hole, jumps in area, shrinks three times or
keeps its area for ten steps. Here the same rule runs on a batch of maps: each map is reduced to its levels
between all thresholds in use, one flood from the centre gives every region, one flood from the border every
hole (grey-scale reconstruction, Vincent 1993, IEEE Trans. Image Processing 2:176).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import fft

from tactile.base.errors import InputError

_OVERLAP = 0.8
"""Kept lags reach this share of the side of the map, as in opexebo."""
_FLAT = 1e-12
"""A variance below this share of the variance of the map is rounding: the map is flat there."""
_BATCH = 64
"""Maps of one batch: its arrays fit the cache."""


def autocorrelogram(rates: np.ndarray) -> np.ndarray:
    """Spatial autocorrelograms of maps, by FFT.

    Args:
        rates: [n, H, W] any unit, NaN in bins without visits. These bins take no part; opexebo takes them as
            0 instead: `autocorrelogram(np.nan_to_num(rates))` equals it.

    Returns:
        [n, h, w] Pearson correlation at the lags -(h // 2) .. h // 2 and -(w // 2) .. w // 2 bins (35 x 35
        for 20 x 20 bins); the centre is lag 0. 0 where the common bins are flat in one of the two maps (as in
        opexebo), NaN where the common bins are fewer than a full map has at the largest kept lags, and NaN
        everywhere for a map that is flat or has no visits.

    Raises:
        InputError: the array is no batch of maps or has no bins.
    """
    rates = np.asarray(rates, float)
    if rates.ndim != 3 or 0 in rates.shape[1:]:
        raise InputError("rates", f"array of shape {list(rates.shape)}", "maps [n, H, W] with bins")
    reach = [_reach(side) for side in rates.shape[1:]]
    maps = np.empty((len(rates), 2 * reach[0] + 1, 2 * reach[1] + 1))
    for start in range(0, len(rates), _BATCH):
        batch = slice(start, start + _BATCH)
        visited = np.isfinite(rates[batch])
        values, flat = _standardise(rates[batch], visited)
        maps[batch] = _correlate(values, visited, reach)
        maps[batch][flat] = np.nan
    return maps


def _standardise(rates: np.ndarray, visited: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maps [n, H, W] of mean 0 and mean square 1, 0 without visits; which of them are flat [n]."""
    count = np.maximum(visited.sum(axis=(1, 2)), 1)[:, None, None]
    filled = np.where(visited, rates, 0.0)
    values = np.where(visited, filled - filled.sum(axis=(1, 2), keepdims=True) / count, 0.0)
    scale = np.sqrt((values**2).sum(axis=(1, 2), keepdims=True) / count)
    flat = scale <= _FLAT * np.abs(filled).max(axis=(1, 2), keepdims=True)
    return values / np.where(flat, 1.0, scale), flat[:, 0, 0]


def _reach(side: int) -> int:
    """Largest kept lag for a side of so many bins; there are at most 1.8 times as many kept lags as bins."""
    return (int(np.round(side + side * _OVERLAP)) - 1) // 2


def _correlate(values: np.ndarray, visited: np.ndarray, reach: list[int]) -> np.ndarray:
    """Correlations [n, h, w] at the kept lags."""
    height, width = values.shape[1:]
    size = (fft.next_fast_len(height + reach[0], real=True), fft.next_fast_len(width + reach[1], real=True))

    def correlate(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        lags = fft.irfft2(np.conj(left) * right, size)
        lags = np.concatenate([lags[:, size[0] - reach[0] :], lags[:, : reach[0] + 1]], axis=1)
        return np.concatenate([lags[:, :, size[1] - reach[1] :], lags[:, :, : reach[1] + 1]], axis=2)

    mask = (visited[:1] if (visited == visited[:1]).all() else visited).astype(float)
    of_mask, of_values, of_squares = (fft.rfft2(part, size) for part in (mask, values, values**2))
    common = np.round(correlate(of_mask, of_mask))
    total = correlate(of_mask, of_values)
    variance = common * correlate(of_mask, of_squares) - total**2
    product = common * correlate(of_values, of_values) - total * total[:, ::-1, ::-1]
    flat = variance <= _FLAT * common * height * width
    deviation = np.sqrt(np.where(flat, np.inf, variance))
    enough = common >= (height - reach[0]) * (width - reach[1])
    return np.where(enough, product / deviation / deviation[:, ::-1, ::-1], np.nan)


_SMALLEST = 5
"""Bins of the smallest field."""
_TOP = np.uint8(255)


class _Schedule(NamedTuple):
    """Thresholds of one growth, shares of the peak.

    Attributes:
        growth: two thresholds; the ratio of their areas is the ordinary growth. steps: falling thresholds.
    """

    growth: tuple[float, float]
    steps: np.ndarray


def centre_radii(autocorrelograms: np.ndarray) -> np.ndarray:
    """Radii of the central fields: [n] bins, whole numbers.

    The radius is that of a disc of the area of the field, rounded down; 0 where no field of at least 5 bins
    is found or the centre is no peak.

    Args:
        autocorrelograms: [h, w, n] finite, odd sides; maps last, so that the floods run over contiguous maps.
    """
    opened = _open(autocorrelograms)
    height, width, _ = opened.shape
    peak = opened[height // 2, width // 2]
    thresholds, schedules = _schedules()
    share = opened / np.where(peak > 0, peak, np.inf)
    levels = np.searchsorted(thresholds, share, side="right").astype(np.uint8)
    areas = _areas(_flood_from_centre(levels), len(thresholds))
    size = np.zeros(levels.shape[2])
    waiting = np.ones(levels.shape[2], bool)
    for schedule in schedules:
        start = np.isfinite(areas[np.searchsorted(thresholds, schedule.growth)]).all(axis=0) & waiting
        if start.any():
            size[start] = _grow(areas[:, start], thresholds, schedule)
        waiting &= ~start
    return np.where(size >= _SMALLEST, np.floor(np.sqrt(size / np.pi)), 0.0).astype(int)


@lru_cache(maxsize=1)
def _schedules() -> tuple[np.ndarray, list[_Schedule]]:
    """All thresholds in use, rising, and the schedules in the order in which they are tried."""
    growths = [(0.95, 0.95 - 0.02)] + [(high, high - 0.01) for high in np.linspace(0.96, 1.0, 4)]
    schedules = []
    for high, low in growths:
        first = high if high == 0.95 else low
        steps = np.round(np.linspace(first, 0.2, int((first - 0.2) / 0.02) + 1), 2)
        schedules.append(_Schedule((high, low), steps))
    return np.unique(np.concatenate([np.r_[plan.growth, plan.steps] for plan in schedules])), schedules


def _grow(areas: np.ndarray, thresholds: np.ndarray, schedule: _Schedule) -> np.ndarray:
    """Bins [n] of the fields that grow from areas [K, n] along a schedule; 0 where the first step fails."""
    high, low = areas[np.searchsorted(thresholds, schedule.growth)]
    last, field = low.copy(), np.zeros_like(low)
    shrunk, same = np.zeros_like(low), np.zeros_like(low)
    grows = np.ones(len(low), bool)
    for area in areas[np.searchsorted(thresholds, schedule.steps)]:
        change = area / last
        shrunk = np.where(change < 1, shrunk + 1, 0)
        same = np.where(change == 1, same + 1, 0)
        grows &= (np.floor(change / (low / high)) <= 2) & (shrunk < 3) & (same < 10)
        last, field = np.where(grows, area, last), np.where(grows, area, field)
    return field


def _areas(regions: np.ndarray, count: int) -> np.ndarray:
    """Bins of the central region at each of `count` thresholds: [count, n]; NaN if empty or with a hole."""
    maps = regions.shape[2]
    slots = regions + (count + 1) * np.arange(maps)
    bins = np.bincount(slots.ravel(), minlength=maps * (count + 1)).reshape(maps, count + 1).T
    areas = bins[::-1].cumsum(axis=0)[-2::-1].astype(float)
    # The lowest wall [h, w, n] on the way by sides from each bin to the border; above its level in holes.
    depth = _TOP - regions
    seed = depth.copy()
    seed[1:-1, 1:-1] = 0
    walls = _TOP - _flood(seed, depth, _sweep_four)
    row, column, index = np.nonzero(walls > regions)
    change = np.zeros((count + 1, maps), int)
    np.add.at(change, (regions[row, column, index], index), 1)
    np.add.at(change, (walls[row, column, index], index), -1)
    areas[(change.cumsum(axis=0)[:count] > 0) | (areas == 0)] = np.nan
    return areas


def _open(maps: np.ndarray) -> np.ndarray:
    """Maps [h, w, n] without peaks narrower than a cross of 5 bins: opening by reconstruction."""
    eroded = maps.copy()
    for thin, full in ((eroded, maps), (eroded.swapaxes(0, 1), maps.swapaxes(0, 1))):
        np.minimum(thin[1:], full[:-1], out=thin[1:])
        np.minimum(thin[:-1], full[1:], out=thin[:-1])
    return _flood(eroded, maps, _sweep_eight)


def _flood_from_centre(levels: np.ndarray) -> np.ndarray:
    """The highest level [h, w, n] at which each bin is connected by sides to the centre."""
    seed = np.zeros_like(levels)
    centre = levels.shape[0] // 2, levels.shape[1] // 2
    seed[centre] = levels[centre]
    return _flood(seed, levels, _sweep_four)


def _flood(
    levels: np.ndarray, ceiling: np.ndarray, sweep: Callable[[np.ndarray, np.ndarray], None]
) -> np.ndarray:
    """Raises levels [h, w, n] to those of neighbours, at most to the ceiling, until nothing changes."""
    done = np.empty_like(levels)
    active = np.arange(levels.shape[2])
    while len(active):
        before = levels.copy()
        for across, top in ((levels, ceiling), (levels.swapaxes(0, 1), ceiling.swapaxes(0, 1))):
            sweep(across, top)
            sweep(across[::-1], top[::-1])
        changed = (levels != before).any(axis=(0, 1))
        done[..., active[~changed]] = levels[..., ~changed]
        active, levels, ceiling = active[changed], levels[..., changed], ceiling[..., changed]
    return done


def _sweep_four(levels: np.ndarray, ceiling: np.ndarray) -> None:
    """Raises each row to the row before it, in place."""
    for before, row, top in zip(levels, levels[1:], ceiling[1:], strict=False):
        np.maximum(row, before, out=row)
        np.minimum(row, top, out=row)


def _sweep_eight(levels: np.ndarray, ceiling: np.ndarray) -> None:
    """Raises each row to the row before it and to its diagonal neighbours there, in place."""
    for before, row, top in zip(levels, levels[1:], ceiling[1:], strict=False):
        np.maximum(row, before, out=row)
        np.maximum(row[1:], before[:-1], out=row[1:])
        np.maximum(row[:-1], before[1:], out=row[:-1])
        np.minimum(row, top, out=row)
