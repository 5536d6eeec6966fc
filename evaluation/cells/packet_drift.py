"""Drift of the packet: decoded pose minus true pose over time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evaluation.cells.rate_map import check_lengths, known_poses
from evaluation.cells.recording import CellRecording
from tactile.base.se2 import between, compose


class Drift(NamedTuple):
    """time: [T] s. error: [T, 3] drift along the x and y of the sheet and in heading, m, m, rad; NaN where
    the true pose is unknown."""

    time: np.ndarray
    error: np.ndarray


def packet_drift(recording: CellRecording) -> Drift:
    """Decoded minus true pose, 0 at the first known pose (drift of path integration as in Burak & Fiete
    2009).

    The sheet has its own origin and axes, so the true path is moved such that its first known pose is the
    packet's. The torus tells a pose only up to its sides; the error is unwrapped over time: between
    successive known poses it takes the shortest way. An injection that moves the packet by more than half a
    side is thus counted to the nearest copy of its target.

    Raises:
        InputError: lengths differ or no pose is known.
    """
    moved = truth_in_sheet(recording)
    known = np.flatnonzero(known_poses(moved))
    wrapped = packet_pose(recording) - moved
    error = np.full(wrapped.shape, np.nan)
    error[known] = np.stack(
        [np.unwrap(wrapped[known, i], period=side) for i, side in enumerate(torus_sides(recording))], axis=1
    )
    error[known] -= error[known[0]]
    return Drift(np.asarray(recording.time), error)


def truth_in_sheet(recording: CellRecording) -> np.ndarray:
    """[T, 3] true poses in the frame of the sheet, m, m, rad, not folded; the first known one is the
    packet's.

    Raises:
        InputError: lengths differ or no pose is known.
    """
    check_lengths(recording.time, recording.truth, recording.packet)
    first = np.flatnonzero(known_poses(recording.truth))[0]
    truth = np.asarray(recording.truth, np.float64)
    return compose(packet_pose(recording)[first], between(truth[first], truth))


def packet_pose(recording: CellRecording) -> np.ndarray:
    """[T, 3] decoded poses on the torus, cells to m, m, rad."""
    scale = [recording.cell_size, recording.cell_size, 2 * np.pi / recording.shape[0]]
    return np.asarray(recording.packet, np.float64) * scale


def torus_sides(recording: CellRecording) -> tuple[float, float, float]:
    """Periods of the torus over x, y (m) and heading (rad)."""
    _, height, width = recording.shape
    return width * recording.cell_size, height * recording.cell_size, 2 * np.pi
