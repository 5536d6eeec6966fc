"""Views as files of a run directory.

`closure_views.npz`: the views of all steps that a loop closure joins, as 8-bit images.
`views.npz`: the whisker images of a session, for plots.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from tactile.base.bounded import read_npz

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


_WHITE = 255


class WhiskerViews(NamedTuple):
    """Whisker images of N steps and a head with R rings of C whiskers.

    Attributes:
        view: [N, R, C] pixel values in 0..1, 0 without contact.
        alive: [N, R, C] bool, the whisker has a signal.
        azimuth: [C] direction of the whiskers of each column, rad counter-clockwise from ahead.
        length: [R] length of the whiskers of each ring, m. tallest: obstacle height of pixel value 1, m.
    """

    view: np.ndarray
    alive: np.ndarray
    azimuth: np.ndarray
    length: np.ndarray
    tallest: float


def write_whisker_views(path: str | Path, images: WhiskerViews) -> None:
    """Writes an .npz file with pixel values in 255 steps; equal images give equal bytes."""
    arrays = {name: np.asarray(array) for name, array in images._asdict().items()}
    # Rounded up, so that a whisker in contact is never 0.
    arrays["view"] = np.ceil(_WHITE * images.view).astype(np.uint8)
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_whisker_views(path: str | Path) -> WhiskerViews:
    """The inverse of `write_whisker_views`, except for rounding.

    Raises:
        InputError: the file is missing or malformed.
    """

    def parse(view: np.ndarray, *arrays: np.ndarray) -> WhiskerViews:
        alive, azimuth, length, tallest = arrays
        rings, columns = view.shape[1:]
        if (length.shape, azimuth.shape, alive.shape) != ((rings,), (columns,), view.shape):
            raise ValueError("arrays that do not fit each other")
        return WhiskerViews(view / _WHITE, alive, azimuth, length, float(tallest))

    return read_npz(path, WhiskerViews._fields, parse, "the views.npz of a run directory")
