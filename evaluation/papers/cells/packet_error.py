"""The error of the packet on the torus: decoded minus true pose, the shortest way round."""

from __future__ import annotations

import numpy as np

from evaluation.cells.packet_drift import packet_pose, torus_sides, truth_in_sheet
from evaluation.cells.recording import CellRecording


def torus_error(recording: CellRecording) -> np.ndarray:
    """[T, 3] decoded minus true pose along the x and y of the sheet and in heading (m, m, rad), 0 at the
    first known pose; each at most half a side of the torus."""
    return shortest(recording, packet_pose(recording) - truth_in_sheet(recording))


def shortest(recording: CellRecording, difference: np.ndarray) -> np.ndarray:
    """Differences [..., 3] of poses (m, m, rad), the shortest way round the torus."""
    sides = np.array(torus_sides(recording))
    return difference - sides * np.round(difference / sides)


def error_size(error: np.ndarray) -> np.ndarray:
    """[..., 2] distance (m) and angle (rad, not negative) of errors [..., 3]."""
    return np.stack([np.hypot(error[..., 0], error[..., 1]), np.abs(error[..., 2])], axis=-1)
