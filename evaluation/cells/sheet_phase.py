"""Phase of the sheet against position: does a cell fire where its place on the torus says?

The network is a torus over x and y of side N x cell size. A cell at index (x, y) should fire wherever the
rat's position in the frame of the sheet, folded modulo that side, is at (x, y) times the cell size. Phases
are angles: 2 pi times position over side.
"""

from __future__ import annotations

import numpy as np

from evaluation.cells import rate_map
from evaluation.cells.decoding import truth_in_sheet
from evaluation.cells.recording import CellRecording
from tactile.base.se2 import wrap


def sheet_phases(cell: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """[n, 2] rad, phases over x and y of cells [n] by their place on the torus (K, N, N) over heading, y,
    x."""
    _, row, column = np.unravel_index(cell, shape)
    return 2 * np.pi * np.stack([column / shape[2], row / shape[1]], axis=1)


def folded_maps(recording: CellRecording, bins: int = 21) -> tuple[np.ndarray, np.ndarray]:
    """Rates [C, bins, bins] of the chosen cells over y, x of the torus, NaN where the rat was not, and
    seconds [bins, bins].

    The true path is moved into the frame of the sheet (`decoding.truth_in_sheet`) and folded, so the box may
    have any heading. Bin b is centred on b / bins of the side.

    Raises:
        InputError: lengths differ or no pose is known.
    """
    rate_map.check_lengths(recording.time, recording.activity)
    path = truth_in_sheet(recording)
    known = rate_map.known_poses(path)
    angles = (2 * np.pi * path[known, i] / side for i, side in enumerate(recording.torus_sides[:2]))
    column, row = (rate_map.circle_bin(angle, bins) for angle in angles)
    spent = rate_map.sample_seconds(recording.time)[known]
    seconds, sums = rate_map.sum_into(row * bins + column, spent, recording.activity[known], (bins, bins))
    return sums / np.where(seconds > 0, seconds, np.nan), seconds


def map_phases(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n, 2] rad, circular mean over x and y of folded maps [n, bins, bins], weighted by rate; NaN without
    activity.

    Biased for a cell whose field lies partly where the rat was not: let the path cover the torus.
    """
    filled, _ = rate_map.weigh_bins(rates, seconds)
    bins = rates.shape[-1]
    plane, unit = filled.reshape(rates.shape), np.exp(2j * np.pi * np.arange(bins) / bins)
    vector = np.stack([plane.sum(axis=1) @ unit, plane.sum(axis=2) @ unit], axis=1)
    silent = filled.sum(axis=1) == 0
    return np.where(silent[:, None], np.nan, np.angle(vector) % (2 * np.pi))


def compare_phases(
    sheet: np.ndarray, phase: np.ndarray, sides: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compares phases of the sheet and of maps, [n, 2] rad over x and y; cells with NaN do not count.

    Args:
        sides: of the torus over x and y, m.

    Returns:
        correlation: [2] circular correlation of Fisher & Lee 1983, in [-1, 1]; 1 for equal phases up to a
            constant. offset: [2] circular mean of map minus sheet, m. residual: [2] root mean square of the
            rest, m.
    """
    known = np.isfinite(phase).all(axis=1)
    sheet, phase, metres = sheet[known], phase[known], np.asarray(sides) / (2 * np.pi)
    difference = phase - sheet
    offset = np.angle(np.exp(1j * difference).mean(axis=0))
    residual = np.sqrt((wrap(difference - offset) ** 2).mean(axis=0))
    return circular_correlation(sheet, phase), offset * metres, residual * metres


def circular_correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[...] T-linear circular correlation of angles a and b [n, ...], rad (Fisher & Lee 1983): the sum over
    pairs of sin(ai - aj) sin(bi - bj), normalised. It needs no mean direction, which evenly spread angles
    lack."""
    cross = (np.cos(a) * np.cos(b)).sum(axis=0) * (np.sin(a) * np.sin(b)).sum(axis=0)
    cross = cross - (np.cos(a) * np.sin(b)).sum(axis=0) * (np.sin(a) * np.cos(b)).sum(axis=0)
    spread = [len(a) ** 2 - np.abs(np.exp(2j * each).sum(axis=0)) ** 2 for each in (a, b)]
    power = spread[0] * spread[1]
    return 4 * cross / np.sqrt(np.where(power > 0, power, np.nan))
