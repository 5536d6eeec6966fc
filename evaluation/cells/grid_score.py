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
from scipy import fft
from scipy.ndimage import maximum_filter

from evaluation.cells.rate_map import known_bins
from tactile.base.compiled import compiled
from tactile.base.errors import InputError

_OVERLAP = 0.8
"""Kept lags reach this share of the side of the map, as in opexebo."""
_MAPS_AT_ONCE = 64
"""Maps of one batch: its arrays fit the cache."""
_FLAT = 1e-12
"""A variance below this share of the mean square is rounding: the bins are flat."""


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
    down, right = ((int(np.round(side + side * _OVERLAP)) - 1) // 2 for side in rates.shape[1:])
    maps = np.empty((len(rates), 2 * down + 1, 2 * right + 1))
    height, width = rates.shape[1:]
    size = fft.next_fast_len(height + down), fft.next_fast_len(width + right, real=True)
    for start in range(0, len(rates), _MAPS_AT_ONCE):
        batch = slice(start, start + _MAPS_AT_ONCE)
        visited = known_bins(rates[batch])
        # Maps of mean 0 and mean square 1, 0 without visits.
        count = np.maximum(visited.sum(axis=(1, 2)), 1)[:, None, None]
        filled = np.where(visited, rates[batch], 0.0)
        values = np.where(visited, filled - filled.sum(axis=(1, 2), keepdims=True) / count, 0.0)
        scale = np.sqrt((values**2).sum(axis=(1, 2), keepdims=True) / count)
        flat = scale <= _FLAT * np.abs(filled).max(axis=(1, 2), keepdims=True)
        values /= np.where(flat, 1.0, scale)
        of_mask, of_values, of_squares = (
            fft.rfft2(part, size) for part in (visited * 1.0, values, values**2)
        )
        pairs = (of_mask, of_mask), (of_mask, of_values), (of_mask, of_squares), (of_values, of_values)
        common, total, square, product = (fft.irfft2(np.conj(left) * right, size) for left, right in pairs)
        maps[batch] = _at_lags(np.round(common), total, square, product, rates.shape[1:], (down, right))
        maps[batch][flat[:, 0, 0]] = np.nan
    return maps


@compiled
def _at_lags(
    common: np.ndarray, totals: np.ndarray, squares: np.ndarray, products: np.ndarray,
    shape: tuple[int, int], reach: tuple[int, int],
) -> np.ndarray:  # fmt: skip
    """Correlations [n, h, w] from the sums [n, ...] over the common bins, at negative lags from their ends;
    of these bins the count [n or 1, ...]."""
    (height, width), (down, right) = shape, reach
    maps = np.full((len(totals), 2 * down + 1, 2 * right + 1), np.nan)
    for k in range(len(totals)):
        for y in range(down + 1):
            for x in range(-right, right + 1):
                count, one, other = common[k % len(common), y, x], totals[k, y, x], totals[k, -y, -x]
                if count < (height - down) * (width - right):
                    continue
                first, second = count * squares[k, y, x] - one**2, count * squares[k, -y, -x] - other**2
                correlation = (count * products[k, y, x] - one * other) / np.sqrt(first * second)
                if min(first, second) <= _FLAT * count * height * width:
                    correlation = 0.0
                maps[k, down + y, right + x] = maps[k, down - y, right - x] = correlation
    return maps


_SMALLEST = 5
"""Bins of the smallest field."""


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
        autocorrelograms: [n, h, w] finite, odd sides.
    """
    framed = np.pad(autocorrelograms, ((0, 0), (1, 1), (1, 1)), constant_values=np.inf)
    sizes = np.array([_central_bins(each, *_schedules()) for each in framed])
    return np.where(sizes >= _SMALLEST, np.floor(np.sqrt(sizes / np.pi)), 0.0).astype(int)


@lru_cache(maxsize=1)
def _schedules() -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """All thresholds in use, rising, as shares of the peak, and the schedules in the order in which they are
    tried, as indices of thresholds: two of whose areas the ratio is the ordinary growth, and the falling
    ones."""
    growths = [(0.95, 0.95 - 0.02)] + [(high, high - 0.01) for high in np.linspace(0.96, 1.0, 4)]
    schedules: list[np.ndarray] = []
    for high, low in growths:
        first = high if high == 0.95 else low
        steps = np.round(np.linspace(first, 0.2, int((first - 0.2) / 0.02) + 1), 2)
        schedules.append(np.r_[high, low, steps])
    thresholds = np.unique(np.concatenate(schedules))
    return thresholds, tuple(np.searchsorted(thresholds, each) for each in schedules)


@compiled
def _central_bins(image: np.ndarray, thresholds: np.ndarray, schedules: tuple[np.ndarray, ...]) -> float:
    """Bins of the central field of a map [h, w] that a frame of infinite values is part of; 0 without one."""
    height, width = image.shape
    opened, levels, regions, walls = np.zeros((4, height, width))
    # Without peaks narrower than a cross of 5 bins: opening by reconstruction.
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            across = min(image[y, x - 1], image[y, x], image[y, x + 1])
            opened[y, x] = min(across, image[y - 1, x], image[y + 1, x])
    _flood(opened, image, True)
    peak = opened[height // 2, width // 2]
    if peak <= 0:
        return 0.0
    # How many thresholds each bin reaches, and the highest level at which sides connect it to the centre.
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            while levels[y, x] < len(thresholds) and thresholds[int(levels[y, x])] <= opened[y, x] / peak:
                levels[y, x] += 1
    regions[height // 2, width // 2] = levels[height // 2, width // 2]
    _flood(regions, levels, False)
    # Minus the lowest wall on the way by sides to the border; it is above the bin in holes.
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            levels[y, x], walls[y, x] = -regions[y, x], -len(thresholds)
    _flood(walls, levels, False)
    # Bins of the region at each threshold, and of its holes.
    areas, holes = np.zeros((2, len(thresholds) + 1))
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            areas[int(regions[y, x])] += 1
            holes[int(regions[y, x])] += 1
            holes[int(-walls[y, x])] -= 1
    for level in range(1, len(areas)):
        holes[level] += holes[level - 1]
        areas[-level - 1] += areas[-level]
    areas = areas[1:]
    for steps in schedules:
        high, low = areas[steps[0]], areas[steps[1]]
        if high > 0 and low > 0 and holes[steps[0]] == 0 and holes[steps[1]] == 0:
            return _grow(areas, holes, steps)
    return 0.0


@compiled
def _grow(areas: np.ndarray, holes: np.ndarray, steps: np.ndarray) -> float:
    """Bins of the field that grows along the steps of a schedule; 0 where the first of them fails."""
    usual, area = areas[steps[1]] / areas[steps[0]], areas[steps[1]]
    field, shrunk, same = 0.0, 0, 0
    for step in steps[2:]:
        change = areas[step] / area
        shrunk = shrunk + 1 if change < 1 else 0
        same = same + 1 if change == 1 else 0
        if holes[step] > 0 or np.floor(change / usual) > 2 or shrunk == 3 or same == 10:
            break
        area = field = areas[step]
    return field


@compiled
def _flood(levels: np.ndarray, ceiling: np.ndarray, diagonal: bool) -> None:
    """Raises levels [h, w] within their frame to those of neighbours by sides, or `diagonal` ones as well, at
    most to the ceiling, until nothing changes."""
    raised = True
    while raised:
        raised = _sweep(levels, ceiling, diagonal)
        raised |= _sweep(levels[::-1, ::-1], ceiling[::-1, ::-1], diagonal)


@compiled
def _sweep(levels: np.ndarray, ceiling: np.ndarray, diagonal: bool) -> bool:
    """Raises each bin to those before it; whether any was raised."""
    raised = False
    for y in range(1, levels.shape[0] - 1):
        for x in range(1, levels.shape[1] - 1):
            level = max(levels[y - 1, x], levels[y, x - 1])
            if diagonal:
                level = max(level, levels[y - 1, x - 1], levels[y - 1, x + 1])
            level = min(level, ceiling[y, x])
            if level > levels[y, x]:
                levels[y, x] = level
                raised = True
    return raised


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
        half: [P] flat indices. corners: [P, A] those of the first of the four bins round each of them after a
            rotation by each angle. weights: [P, A, 4] of the four. below, within: [R + 1] how many of the P
            have a radius < r, <= r, for r = 0 .. R bins.
    """

    half: np.ndarray
    corners: np.ndarray
    weights: np.ndarray
    below: np.ndarray
    within: np.ndarray


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
    height, width = maps.shape[1:]
    (valid,) = np.nonzero(maps[:, height // 2, width // 2] > 0)
    maps = maps[valid]
    maps[np.isnan(maps)] = 0.0
    inner = centre_radii(maps)
    found = (inner > 0) & (inner < min(height, width) // 2)
    scores = np.full((len(lattices), len(autocorrelograms)), np.nan)
    for k, lattice in enumerate(lattices):
        annuli, onto = _annuli(lattice, height, width), len(lattice.onto)
        scores[k, valid[found]] = _score_annuli(maps[found], inner[found], annuli, onto)
    return scores


@compiled
def _score_annuli(maps: np.ndarray, inner: np.ndarray, annuli: _Annuli, onto: int) -> np.ndarray:
    """Scores [n] of maps [n, h, w]: the best mean over three successive outer radii of annuli from `inner`
    [n]; so many of the angles map the lattice onto itself.

    As in opexebo: the last window of three is left out, flat annuli are left out of a window, and the
    mean over all radii is taken where they are four or fewer.
    """
    scores, outer = np.full(len(maps), np.nan), len(annuli.below) - 1
    for k in range(len(maps)):
        curve = _curve(maps[k], inner[k], annuli, onto)
        first = max(3, inner[k] + 1)
        count = outer - inner[k]
        curve = np.array([curve[int(radius)] for radius in np.linspace(first, outer, count)])
        if count <= 4:
            scores[k] = curve.mean()
            continue
        windows = [np.nanmean(curve[start : start + 3]) for start in range(count - 3)]
        scores[k] = np.array(windows).max()
    return scores


@compiled
def _curve(image: np.ndarray, inner: int, annuli: _Annuli, onto: int) -> np.ndarray:
    """Scores [R + 1] of the annuli of a map [h, w] from `inner` to each outer radius 0 .. R, bins; NaN where
    they are flat."""
    curve, width, image = np.full(len(annuli.below), np.nan), image.shape[1], image.ravel()
    first = last = annuli.within[inner]
    total, square, turned = 0.0, 0.0, np.zeros((annuli.corners.shape[1], 3))
    for radius in range(inner + 1, len(curve)):
        for p in range(last, annuli.below[radius]):
            value = image[annuli.half[p]]
            total += value
            square += value * value
            for angle in range(len(turned)):
                at, (a, b, c, d) = annuli.corners[p, angle], annuli.weights[p, angle]
                other = a * image[at] + b * image[at + 1] + c * image[at + width] + d * image[at + width + 1]
                turned[angle, 0] += other
                turned[angle, 1] += other * other
                turned[angle, 2] += other * value
        last = annuli.below[radius]
        bins = max(last - first, 1)
        variance = square / bins - (total / bins) ** 2
        lowest, highest = np.inf, -np.inf
        flat = variance * bins <= _FLAT * square
        for angle in range(len(turned)):
            mean, power, product = turned[angle] / bins
            flat |= power - mean**2 <= _FLAT * power
            correlation = (product - mean * total / bins) / np.sqrt(variance * (power - mean**2))
            correlation = min(max(correlation, -1.0), 1.0)
            if angle < onto:
                lowest = min(lowest, correlation)
            else:
                highest = max(highest, correlation)
        if not flat:
            curve[radius] = lowest - highest
    return curve


@lru_cache(maxsize=16)
def _annuli(lattice: Lattice, height: int, width: int) -> _Annuli:
    """The annuli and bilinear rotations of autocorrelograms of odd height and width.

    The sense of rotation is that of `skimage.transform.rotate`.
    """
    outer = min(height, width) // 2
    y, x = np.mgrid[:height, :width]
    y, x = (y - height // 2).ravel(), (x - width // 2).ravel()
    radius = np.hypot(y, x)
    (half,) = np.nonzero(((y > 0) | ((y == 0) & (x > 0))) & (radius < outer))
    half = half[np.argsort(radius[half], kind="stable")]
    whole = np.arange(outer + 1)
    below = np.searchsorted(radius[half], whole, side="left")
    within = np.searchsorted(radius[half], whole, side="right")
    angles = np.deg2rad(lattice.onto + lattice.between)
    y, x = y[half, None], x[half, None]
    column = np.cos(angles) * x - np.sin(angles) * y + width // 2
    row = np.sin(angles) * x + np.cos(angles) * y + height // 2
    low_row = np.clip(np.floor(row).astype(int), 0, height - 2)
    low_column = np.clip(np.floor(column).astype(int), 0, width - 2)
    up, right = row - low_row, column - low_column
    weights = (1 - up) * (1 - right), (1 - up) * right, up * (1 - right), up * right
    return _Annuli(half, low_row * width + low_column, np.stack(weights, axis=2), below, within)


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
    inner = centre_radii(maps)
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
