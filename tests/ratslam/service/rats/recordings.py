"""Recordings of cells made by hand."""

from __future__ import annotations

import numpy as np

from evaluation.cells.recording import CellRecording

SHAPE = (8, 7, 7)


def recording(time: np.ndarray, cell: list[int], activity: np.ndarray) -> CellRecording:
    """A recording of a network of 8 x 7 x 7 cells of 0.1 m; the robot drives along x, its heading turns."""
    steps = len(time)
    truth = np.stack([0.05 * time, np.zeros(steps), 0.1 * time], axis=1)
    packet = np.stack([np.arange(steps) % 7, np.full(steps, 3.0), np.arange(steps) % 8], axis=1)
    return CellRecording(
        shape=SHAPE, cell_size=0.1, time=time, truth=truth, packet=packet, energy=np.zeros(steps),
        place=np.full(steps, -1, np.int32), cell=np.array(cell, np.int32),
        activity=activity.astype(np.float32), sums=None,
    )  # fmt: skip


def drawn_recording(seed: int, cell: list[int], steps: int = 400) -> CellRecording:
    """Unevenly spaced steps, and an activity of each cell of its own with silent stretches."""
    time = 3.0 + np.cumsum(np.random.default_rng(seed).uniform(0.0, 0.1, steps))
    activity = [
        np.maximum(np.random.default_rng([seed, index]).normal(0.01, 0.02, steps), 0) for index in cell
    ]
    return recording(time, cell, np.stack(activity, axis=1))
