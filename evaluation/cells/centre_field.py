"""The radius of the central field of autocorrelograms, by the adaptive threshold of opexebo.

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
