"""Grid scores of rate maps: autocorrelogram, radius of its central field, score and shape of a lattice.

An annulus of the autocorrelogram is correlated with itself after a rotation. The score is the lowest
correlation at the angles that map the lattice onto itself, less the highest at the angles between (Sargolini
et al. 2006, Science 312:758). The annulus starts outside the central field and its outer radius grows; the
score is the best mean over three successive radii (Langston et al. 2010, Science 328:1576; Stensola et al.
2012, Nature 492:72). It is the definition of opexebo (`analysis.grid_score`, MIT), here for batches of maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import fft, sparse
from scipy.ndimage import maximum_filter

from tactile.base.errors import InputError

_OVERLAP = 0.8
"""Kept lags reach this share of the side of the map, as in opexebo."""
_MAPS_AT_ONCE = 64
"""Maps of one batch: its arrays fit the cache."""


def autocorrelogram(rates: np.ndarray) -> np.ndarray:
    """Spatial autocorrelograms of maps, by FFT: the Pearson correlation of a map with its shifted self.

        r(lag) = (n Σ f g - Σ f Σ g) / sqrt((n Σ f² - (Σ f)²) (n Σ g² - (Σ g)²)),   g(x) = f(x + lag)

    over the n bins that both maps have at that lag (Sargolini et al. 2006, supplement). Large lags have few
    common bins and are noise; they are cut as in opexebo (`analysis.autocorrelation`).

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
    # The largest kept lags.
    reach = [(int(np.round(side + side * _OVERLAP)) - 1) // 2 for side in rates.shape[1:]]
    maps = np.empty((len(rates), 2 * reach[0] + 1, 2 * reach[1] + 1))
    for start in range(0, len(rates), _MAPS_AT_ONCE):
        batch = slice(start, start + _MAPS_AT_ONCE)
        visited = np.isfinite(rates[batch])
        # Maps of mean 0 and mean square 1, 0 without visits.
        count = np.maximum(visited.sum(axis=(1, 2)), 1)[:, None, None]
        filled = np.where(visited, rates[batch], 0.0)
        values = np.where(visited, filled - filled.sum(axis=(1, 2), keepdims=True) / count, 0.0)
        scale = np.sqrt((values**2).sum(axis=(1, 2), keepdims=True) / count)
        flat = scale <= _FLAT * np.abs(filled).max(axis=(1, 2), keepdims=True)
        maps[batch] = _correlate(values / np.where(flat, 1.0, scale), visited, reach)
        maps[batch][flat[:, 0, 0]] = np.nan
    return maps


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


def centre_radii(autocorrelograms: np.ndarray) -> np.ndarray:
    """Radii of the central fields: [n] bins, whole numbers.

    The radius is that of a disc of the area of the field, rounded down; 0 where no field of at least 5 bins
    is found or the centre is no peak. The field is that of opexebo (`analysis.place_field`), which grows it
    round the centre: the threshold falls from 0.95 to 0.2 of the peak, and the growth ends where the
    connected region has a hole, jumps in area, shrinks three times or keeps its area for ten steps. Here each
    map is reduced to its levels between all thresholds in use; one flood from the centre gives every region,
    one flood from the border every hole (grey-scale reconstruction, Vincent 1993, IEEE Trans. Image
    Processing 2:176).

    Args:
        autocorrelograms: [h, w, n] finite, odd sides; maps last, so that the floods run over contiguous maps.
    """
    # Without peaks narrower than a cross of 5 bins: opening by reconstruction.
    eroded = autocorrelograms.copy()
    for thin, full in ((eroded, autocorrelograms), (eroded.swapaxes(0, 1), autocorrelograms.swapaxes(0, 1))):
        np.minimum(thin[1:], full[:-1], out=thin[1:])
        np.minimum(thin[:-1], full[1:], out=thin[:-1])
    opened = _flood(eroded, autocorrelograms, diagonal=True)
    height, width, _ = opened.shape
    peak = opened[height // 2, width // 2]
    thresholds, schedules = _schedules()
    share = opened / np.where(peak > 0, peak, np.inf)
    levels = np.searchsorted(thresholds, share, side="right").astype(np.uint8)
    # The highest level at which each bin is connected by sides to the centre.
    seed = np.zeros_like(levels)
    seed[height // 2, width // 2] = levels[height // 2, width // 2]
    areas = _areas(_flood(seed, levels), len(thresholds))
    size = np.zeros(levels.shape[2])
    waiting = np.ones(levels.shape[2], bool)
    for growth, steps in schedules:
        first, falling = (np.searchsorted(thresholds, each) for each in (growth, steps))
        start = np.isfinite(areas[first]).all(axis=0) & waiting
        if start.any():
            size[start] = _grow(areas[:, start], first, falling)
        waiting &= ~start
    return np.where(size >= _SMALLEST, np.floor(np.sqrt(size / np.pi)), 0.0).astype(int)


@lru_cache(maxsize=1)
def _schedules() -> tuple[np.ndarray, list[tuple[tuple[float, float], np.ndarray]]]:
    """All thresholds in use, rising, as shares of the peak, and the schedules in the order in which they are
    tried: two thresholds, of whose areas the ratio is the ordinary growth, and the falling thresholds."""
    growths = [(0.95, 0.95 - 0.02)] + [(high, high - 0.01) for high in np.linspace(0.96, 1.0, 4)]
    schedules = []
    for high, low in growths:
        first = high if high == 0.95 else low
        steps = np.round(np.linspace(first, 0.2, int((first - 0.2) / 0.02) + 1), 2)
        schedules.append(((high, low), steps))
    return np.unique(np.concatenate([np.r_[growth, steps] for growth, steps in schedules])), schedules


def _grow(areas: np.ndarray, growth: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Bins [n] of the fields that grow from areas [K, n] along the rows of a schedule; 0 where the first step
    fails."""
    high, low = areas[growth]
    last, field = low.copy(), np.zeros_like(low)
    shrunk, same = np.zeros_like(low), np.zeros_like(low)
    grows = np.ones(len(low), bool)
    for area in areas[steps]:
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
    walls = _TOP - _flood(seed, depth)
    row, column, index = np.nonzero(walls > regions)
    change = np.zeros((count + 1, maps), int)
    np.add.at(change, (regions[row, column, index], index), 1)
    np.add.at(change, (walls[row, column, index], index), -1)
    areas[(change.cumsum(axis=0)[:count] > 0) | (areas == 0)] = np.nan
    return areas


def _flood(levels: np.ndarray, ceiling: np.ndarray, diagonal: bool = False) -> np.ndarray:
    """Raises levels [h, w, n] to those of neighbours by sides, or `diagonal` ones as well, at most to the
    ceiling, until nothing changes."""
    done = np.empty_like(levels)
    active = np.arange(levels.shape[2])
    while len(active):
        before = levels.copy()
        for across, top in ((levels, ceiling), (levels.swapaxes(0, 1), ceiling.swapaxes(0, 1))):
            _sweep(across, top, diagonal)
            _sweep(across[::-1], top[::-1], diagonal)
        changed = (levels != before).any(axis=(0, 1))
        done[..., active[~changed]] = levels[..., ~changed]
        active, levels, ceiling = active[changed], levels[..., changed], ceiling[..., changed]
    return done


def _sweep(levels: np.ndarray, ceiling: np.ndarray, diagonal: bool) -> None:
    """Raises each row to the row before it, in place."""
    for before, row, top in zip(levels, levels[1:], ceiling[1:], strict=False):
        np.maximum(row, before, out=row)
        if diagonal:
            np.maximum(row[1:], before[:-1], out=row[1:])
            np.maximum(row[:-1], before[1:], out=row[:-1])
        np.minimum(row, top, out=row)


_SCORED_AT_ONCE = 128
"""Maps of one batch: its arrays fit the cache."""
_FLAT = 1e-12
"""A variance below this share of the mean square is rounding: the annulus is flat."""


class Lattice(NamedTuple):
    """The symmetry of a lattice.

    Attributes:
        onto: angles that map it onto itself, degrees. between: angles that move its points farthest, degrees.
    """

    onto: tuple[float, ...]
    between: tuple[float, ...]


HEXAGONAL = Lattice((60.0, 120.0), (30.0, 90.0, 150.0))
SQUARE = Lattice((90.0,), (45.0, 135.0))


class _Annuli(NamedTuple):
    """Bins of half an autocorrelogram in the order of their radius; it is symmetric, so half suffices.

    Attributes:
        half: [P] flat indices. rotation: [A * P, h * w] bilinear rotation by each angle.
        starts: [S] where the distinct sums start. below, within: [R + 1] how many of these sums have a radius
            < r, <= r, for r = 0 .. R bins. bins: [S + 1] in the first sums.
    """

    half: np.ndarray
    rotation: sparse.csr_array
    starts: np.ndarray
    below: np.ndarray
    within: np.ndarray
    bins: np.ndarray


def lattice_scores(autocorrelograms: np.ndarray, lattice: Lattice = HEXAGONAL) -> np.ndarray:
    """Lattice scores of autocorrelograms: [n], between -2 and 2; see `score_lattices`."""
    return score_lattices(autocorrelograms, (lattice,))[0]


def score_lattices(autocorrelograms: np.ndarray, lattices: Sequence[Lattice]) -> np.ndarray:
    """Scores of autocorrelograms for each of k symmetries: [k, n], between -2 and 2.

    The score is NaN where a map is flat, has no central field of at least 5 bins, or has no annulus between
    this field and the edge. Lags that are NaN inside the annuli count as 0, no correlation.

    Args:
        autocorrelograms: [n, h, w] as from `autocorrelogram`, odd sides. lattices: the symmetries.

    Raises:
        InputError: the array is no batch of maps with odd sides.
    """
    maps = np.asarray(autocorrelograms, float)
    if maps.ndim != 3 or any(side % 2 == 0 for side in maps.shape[1:]):
        found = f"array of shape {list(maps.shape)}"
        raise InputError("autocorrelograms", found, "maps [n, h, w] with odd sides")
    batches = [maps[i : i + _SCORED_AT_ONCE] for i in range(0, len(maps), _SCORED_AT_ONCE)]
    scored = [_score_batch(batch, lattices) for batch in batches]
    return np.concatenate(scored or [np.empty((len(lattices), 0))], axis=1)


def _score_batch(maps: np.ndarray, lattices: Sequence[Lattice]) -> np.ndarray:
    """Scores [k, n] of a batch [n, h, w] that fits the cache."""
    scores = np.full((len(lattices), len(maps)), np.nan)
    height, width = maps.shape[1:]
    (valid,) = np.nonzero(maps[:, height // 2, width // 2] > 0)
    stacked = np.ascontiguousarray(np.nan_to_num(maps[valid]).transpose(1, 2, 0))
    stacked /= stacked.max(axis=(0, 1)) if valid.size else 1.0
    inner = centre_radii(stacked)
    outer = min(height, width) // 2
    found = (inner > 0) & (inner < outer)
    if not found.any():
        return scores
    flat = stacked[..., found].reshape(height * width, -1)
    for k, lattice in enumerate(lattices):
        scores[k, valid[found]] = _best(_curves(flat, inner[found], lattice, height, width), inner[found])
    return scores


def _curves(maps: np.ndarray, inner: np.ndarray, lattice: Lattice, height: int, width: int) -> np.ndarray:
    """Scores [R + 1, n] of the annuli from `inner` [n] to each outer radius 0 .. R, bins; maps [h * w, n].

    All rotated maps are one product with a sparse matrix, and sums over annuli are differences of cumulative
    sums over bins in the order of their radius.
    """
    annuli = _annuli(lattice, height, width)
    base = maps[annuli.half]
    turned = (annuli.rotation @ maps).reshape(-1, *base.shape)

    def add(values: np.ndarray) -> np.ndarray:
        sums = np.add.reduceat(values, annuli.starts, axis=-2).cumsum(axis=-2)
        sums = np.concatenate([np.zeros_like(sums[..., :1, :]), sums], axis=-2)
        index = annuli.within[inner].reshape((1,) * (sums.ndim - 1) + (-1,))
        return sums[..., annuli.below, :] - np.take_along_axis(sums, index, axis=-2)

    count = annuli.bins[annuli.below][:, None] - annuli.bins[annuli.within[inner]]
    count = np.maximum(count, 1)
    mean, turned_mean = add(base) / count, add(turned) / count
    square, turned_square = add(base * base) / count, add(turned * turned) / count
    covariance = add(turned * base) / count - mean * turned_mean
    variance, turned_variance = square - mean**2, turned_square - turned_mean**2
    flat = (variance <= _FLAT * square) | (turned_variance <= _FLAT * turned_square)
    product = np.where(flat, np.nan, variance * turned_variance)
    correlation = np.clip(covariance / np.sqrt(product), -1.0, 1.0)
    onto = len(lattice.onto)
    return correlation[:onto].min(axis=0) - correlation[onto:].max(axis=0)


def _best(curves: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """The best mean score [n] over three successive outer radii, of curves [R + 1, n].

    As in opexebo: the last window of three is left out, flat annuli are left out of a window, and the
    mean over all radii is taken where they are four or fewer.
    """
    scores = np.full(len(inner), np.nan)
    outer = len(curves) - 1
    for radius in np.unique(inner):
        of_radius = inner == radius
        radii = np.linspace(max(3, radius + 1), outer, outer - radius).astype(int)
        curve = curves[radii][:, of_radius]
        if len(radii) <= 4:
            scores[of_radius] = curve.mean(axis=0)
            continue
        windows = np.lib.stride_tricks.sliding_window_view(curve, 3, axis=0)[:-1]
        known = np.isfinite(windows).sum(axis=2)
        mean = np.nansum(windows, axis=2) / np.where(known > 0, known, np.nan)
        scores[of_radius] = mean.max(axis=0)
    return scores


@lru_cache(maxsize=16)
def _annuli(lattice: Lattice, height: int, width: int) -> _Annuli:
    """The annuli and rotations of autocorrelograms of odd height and width."""
    outer = min(height, width) // 2
    y, x = np.mgrid[:height, :width]
    y, x = (y - height // 2).ravel(), (x - width // 2).ravel()
    radius = np.hypot(y, x)
    (half,) = np.nonzero(((y > 0) | ((y == 0) & (x > 0))) & (radius < outer))
    half = half[np.argsort(radius[half], kind="stable")]
    whole = np.arange(outer + 1)
    below = np.searchsorted(radius[half], whole, side="left")
    within = np.searchsorted(radius[half], whole, side="right")
    count = np.unique(np.concatenate([below, within, [0]]))
    angles = np.deg2rad(lattice.onto + lattice.between)
    rotation = sparse.vstack([_rotation(angle, y[half], x[half], height, width) for angle in angles])
    below, within = np.searchsorted(count, below), np.searchsorted(count, within)
    return _Annuli(half, sparse.csr_array(rotation), count[:-1], below, within, count)


def _rotation(angle: float, y: np.ndarray, x: np.ndarray, height: int, width: int) -> sparse.csr_array:
    """Bilinear rotation about the centre by an angle, rad: [P, h * w] for the bins at offsets y, x [P].

    The sense of rotation is that of `skimage.transform.rotate`.
    """
    column = np.cos(angle) * x - np.sin(angle) * y + width // 2
    row = np.sin(angle) * x + np.cos(angle) * y + height // 2
    low_row = np.clip(np.floor(row).astype(int), 0, height - 2)
    low_column = np.clip(np.floor(column).astype(int), 0, width - 2)
    part_row, part_column = row - low_row, column - low_column
    rows, columns, weights = [], [], []
    for up in (0, 1):
        for right in (0, 1):
            rows.append(np.arange(len(x)))
            columns.append((low_row + up) * width + low_column + right)
            weights.append(abs(1 - up - part_row) * abs(1 - right - part_column))
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array(entries, shape=(len(x), height * width))


_CLOSE = np.deg2rad(15.0)
"""Peaks whose directions differ by less belong to one row; the nearest counts, as in opexebo."""


def measure_lattice(
    autocorrelograms: np.ndarray, bin_size: float, lattice: Lattice = HEXAGONAL
) -> tuple[np.ndarray, np.ndarray]:
    """Spacing and orientation of lattices (Hafting et al. 2005, Nature 436:801; Sargolini et al. 2006).

    The peaks nearest to the centre, three for a hexagonal and two for a square lattice in each half, give the
    spacing (their mean distance) and the orientation (their mean direction, folded by the symmetry). Peaks
    are the bins outside the central field that exceed 0 and their eight neighbours; a parabola through the
    neighbours places them between bins.

    Args:
        autocorrelograms: [n, h, w] as from `autocorrelogram`; rows rise with y, columns with x.
        bin_size: side of a bin, m. lattice: its symmetry.

    Returns:
        spacing: [n] m. orientation: [n] rad from the x axis to the next row of peaks anticlockwise, in
            0 .. pi / 3 for a hexagonal and 0 .. pi / 2 for a square lattice. NaN where there are too few
            peaks.

    Raises:
        InputError: the size of a bin is not positive.
    """
    if not bin_size > 0:
        raise InputError("bin_size", f"{bin_size}", "a length above 0 m")
    maps = np.nan_to_num(np.asarray(autocorrelograms, float))
    period = np.deg2rad(lattice.onto[0])
    inner = centre_radii(np.ascontiguousarray(maps.transpose(1, 2, 0)))
    count = round(np.pi / period)
    vectors = [_nearest_peaks(image, radius, count) for image, radius in zip(maps, inner, strict=True)]
    spacing = [bin_size * np.abs(peaks).mean() for peaks in vectors]
    angles = [np.angle(peaks) * 2 * np.pi / period for peaks in vectors]
    turns = [float(np.arctan2(np.sin(each).mean(), np.cos(each).mean())) for each in angles]
    return np.array(spacing), np.array(turns) / (2 * np.pi) * period % period


def _nearest_peaks(image: np.ndarray, inner: int, count: int) -> np.ndarray:
    """The nearest `count` peaks of half an autocorrelogram in different directions: complex offsets, bins."""
    centre = image.shape[0] // 2, image.shape[1] // 2
    highest = (image == maximum_filter(image, size=3, mode="nearest")) & (image > 0)
    row, column = np.nonzero(highest[1:-1, 1:-1])
    y, x = row + 1 - centre[0], column + 1 - centre[1]
    chosen = ((y > 0) | ((y == 0) & (x > 0))) & (np.hypot(y, x) > inner) & (inner > 0)
    middle = complex(*centre[::-1])
    rows, columns = row[chosen] + 1, column[chosen] + 1
    peaks = [_place_peak(image, i, j) - middle for i, j in zip(rows, columns, strict=True)]
    nearest: list[complex] = []
    for peak in sorted(peaks, key=abs):
        if all(abs(np.angle((peak / other) ** 2)) >= 2 * _CLOSE for other in nearest):
            nearest.append(peak)
    return np.array(nearest[:count]) if len(nearest) >= count else np.full(count, np.nan + 0j)


def _place_peak(image: np.ndarray, row: int, column: int) -> complex:
    """Column + i row of a peak, bins, by parabolas through its neighbours in the row and in the column."""

    def shift(before: float, peak: float, after: float) -> float:
        curvature = before - 2 * peak + after
        return 0.5 * (before - after) / curvature if curvature < 0 else 0.0

    across, up = shift(*image[row, column - 1 : column + 2]), shift(*image[row - 1 : row + 2, column])
    return complex(column + across, row + up)
