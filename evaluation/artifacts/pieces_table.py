"""pieces.csv: the piece of the map in which each step is; only of a map of several pieces."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaluation.metrics.text_table import read_text_table
from tactile.base.errors import InputError

COLUMNS = ("t", "piece")
NAME = "pieces.csv"


def write_pieces(path: Path, time: np.ndarray, piece: np.ndarray) -> None:
    """Writes the piece [N] of steps at times [N], s."""
    lines = [f"{t!r},{one}" for t, one in zip(time.tolist(), piece.tolist(), strict=True)]
    Path(path).write_text("\n".join([",".join(COLUMNS), *lines]) + "\n", encoding="utf-8")


def read_pieces(path: Path, steps: int) -> np.ndarray:
    """The piece [steps] of each step, 0 without the file.

    Raises:
        InputError: a line is malformed, or there are fewer than `steps`.
    """
    if not path.exists():
        return np.zeros(steps, int)
    piece = read_text_table(path, dict.fromkeys(COLUMNS, ())).values[:, 1]
    if len(piece) < steps:
        raise InputError(str(path), f"{len(piece)} lines", f"{steps}, one for each step")
    if not ((piece >= 0) & (piece < 2**31) & (piece == np.round(piece))).all():
        raise InputError(str(path), "a piece that is no number of one", "whole numbers from 0")
    return piece[:steps].astype(int)
