"""The whisker images of a session, as the pictures need them, in one small file."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tactile.base.errors import InputError

_WHITE = 255


class WhiskerViews(NamedTuple):
    """What the whiskers told; N steps, a head of R rings of C whiskers.

    Attributes:
        view: [N, R, C] brightness in 0..1, 0 where nothing was touched.
        alive: [N, R, C] bool, the whisker reported at all.
        azimuth: [C] rad, where the whiskers of each column point, counter-clockwise from ahead.
        length: [R] m, of the whiskers of each ring.
        tallest: height of an obstacle that is white, m.
    """

    view: np.ndarray
    alive: np.ndarray
    azimuth: np.ndarray
    length: np.ndarray
    tallest: float


def write_whisker_views(path: str | Path, images: WhiskerViews) -> None:
    """Writes them to an .npz, brightness in 255 steps; the same images give the same bytes."""
    arrays = {name: np.asarray(array) for name, array in images._asdict().items()}
    # Rounded up: what was touched is never as dark as what was not.
    arrays["view"] = np.ceil(_WHITE * images.view).astype(np.uint8)
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_whisker_views(path: str | Path) -> WhiskerViews:
    """The inverse of `write_whisker_views`, but for the rounding.

    Raises:
        InputError: it is no such file.
    """
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in WhiskerViews._fields}
        view = arrays["view"] / _WHITE
        images = WhiskerViews(**arrays | {"view": view, "tallest": float(arrays["tallest"])})
    except FileNotFoundError:
        raise InputError(str(path), "no such file", "the views.npz of a run directory") from None
    except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            str(path), f"not whisker images ({error})", "the views.npz of a run directory"
        ) from None
    shapes = images.view.shape[1:2], images.view.shape[2:], images.view.shape
    if images.view.ndim != 3 or (images.length.shape, images.azimuth.shape, images.alive.shape) != shapes:
        raise InputError(str(path), "arrays that do not fit each other", "the views.npz of a run directory")
    return images
