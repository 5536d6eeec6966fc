"""File `closure_views.npz`: the views of all steps that a loop closure joins, as 8-bit images."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tactile.base.npz import read_npz

NAME = "closure_views.npz"


class ClosureViews(NamedTuple):
    """Views of n steps.

    Attributes:
        step: [n] increasing, counted from the first step of this run.
        view: [n, R, C] uint8, brightness.
    """

    step: np.ndarray
    view: np.ndarray


def eight_bit(view: np.ndarray) -> np.ndarray:
    """A view [R, C, K] in 0..1 as an image [R, C] of its first channel in 0..255; only 0 becomes 0."""
    return np.ceil(255 * np.clip(view[..., 0], 0.0, 1.0)).astype(np.uint8)


def write_closure_views(path: Path, views: ClosureViews) -> None:
    """Writes the file; equal views give equal bytes."""
    with Path(path).open("wb") as file:
        np.savez_compressed(file, step=views.step, view=views.view)


def read_closure_views(directory: Path) -> ClosureViews | None:
    """Reads the views of a run directory; None without the file.

    Raises:
        InputError: the file is malformed.
    """

    def parse(step: np.ndarray, view: np.ndarray) -> ClosureViews:
        if step.ndim != 1 or view.ndim != 3 or len(step) != len(view) or view.dtype != np.uint8:
            raise ValueError("arrays that do not fit each other")
        return ClosureViews(step.astype(int), view)

    file = directory / NAME
    expected = "the views of a run directory: step [n] and view [n, R, C] of 8 bits"
    return read_npz(file, ClosureViews._fields, parse, expected) if file.exists() else None
