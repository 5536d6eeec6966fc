"""Views from images: a crop of the grey image, reduced by block means to a few values in 0..1.

The first step of a view template (Ball et al. 2013, section 3). The second, normalisation of the values, is
done by `templates` of a run for every kind of view.
"""

from __future__ import annotations

import numpy as np
from pydantic import NonNegativeInt, PositiveInt

from tactile.base.errors import InputError
from tactile.base.settings import Settings, Side


class Crop(Settings):
    """A part of an image, in pixels from the upper left corner."""

    x_min: NonNegativeInt = 0
    """First column."""
    x_max: PositiveInt | None = None
    """Column after the last one; null: the width."""
    y_min: NonNegativeInt = 0
    """First row."""
    y_max: PositiveInt | None = None
    """Row after the last one; null: the height."""


class ImageViewConfig(Settings):
    """How an image becomes a view; its exposure is normalised by `templates`, as that of every view."""

    crop: Crop = Crop()
    """The part of the image that is seen; leave out the robot itself and featureless floor and sky."""
    rows: Side = 12
    """R, rows of a view."""
    columns: Side = 60
    """C, columns of a view."""


def cropped(crop: Crop, grey: np.ndarray, where: str, key: str) -> np.ndarray:
    """The part of an image [H, W] as a view [h, w] of the same memory.

    Args:
        where: the image, for errors. key: configuration key of the crop, for errors.

    Raises:
        InputError: the crop is empty, or reaches beyond the image.
    """
    height, width = grey.shape
    x_max, y_max = crop.x_max or width, crop.y_max or height
    if not (crop.x_min < x_max <= width and crop.y_min < y_max <= height):
        found = f"{key} is x {crop.x_min} to {x_max}, y {crop.y_min} to {y_max}"
        raise InputError(where, found, f"a part of the image of {width} x {height} pixels")
    return grey[crop.y_min : y_max, crop.x_min : x_max]


def image_view(config: ImageViewConfig, grey: np.ndarray, where: str = "image") -> np.ndarray:
    """The view [R, C, 1] of an image [H, W] uint8: block means of the crop, 0 black to 1 white.

    Where rows or columns do not divide the crop, blocks differ by one pixel; every pixel counts once. Sums
    are of integers, hence exact.

    Raises:
        InputError: the crop is not a part of the image, or has fewer pixels than the view along one axis.
    """
    part = cropped(config.crop, grey, where, "image.crop")
    height, width = part.shape
    if height < config.rows or width < config.columns:
        found = f"the crop has {width} x {height} pixels"
        expected = f"at least image.columns {config.columns} x image.rows {config.rows}"
        raise InputError(where, found, expected)
    tops, lefts = _block_edges(height, config.rows), _block_edges(width, config.columns)
    sums = np.add.reduceat(part, tops[:-1], axis=0, dtype=np.int64)
    sums = np.add.reduceat(sums, lefts[:-1], axis=1)
    return (sums / (np.outer(np.diff(tops), np.diff(lefts)) * 255.0))[..., None]


def _block_edges(size: int, blocks: int) -> np.ndarray:
    """[blocks + 1] edges of nearly equal blocks of `size` pixels."""
    return np.arange(blocks + 1) * size // blocks
