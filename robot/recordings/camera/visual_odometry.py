"""Odometry from a camera alone, by the change of two intensity profiles.

A profile is the mean of each column of a crop, divided by the profile's mean, so that exposure cancels out.
The shift between consecutive profiles is the turn; what differs after the best shift is the distance
(Milford & Wyeth 2008). Nothing fixes the scale of distances: they are in VO metres, `scaling` of them for a
difference of 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat

from robot.recordings.camera.image_view import Crop, cropped
from tactile.base.config import Settings


class VisualOdometryConfig(Settings):
    """Visual odometry, for recordings with images and without odometry. Its distances are in VO metres, of
    unknown length unless `scaling` was calibrated."""

    fov_deg: float = Field(gt=0, le=360)
    """Horizontal field of view of the whole image, degrees; 360: a panorama, whose columns form a ring."""
    rotation: Crop = Crop()
    """The part of the image from which turns are found: far things, such as the horizon."""
    translation: Crop = Crop()
    """The part of the image from which distances are found: near things, such as the ground."""
    scaling: PositiveFloat = 1.0
    """Distance for a mean profile difference of 1, VO metres."""
    max_speed: PositiveFloat = 5.0
    """Largest speed, VO metres/s."""
    max_turn_rate_deg: PositiveFloat = 120.0
    """Largest turn rate, degrees/s: shifts between frames are searched up to this rate."""


class Profiles(NamedTuple):
    """The intensity profiles of a frame.

    Attributes:
        rotation: [w] profile of the rotation crop. translation: [v] of the translation crop.
        pixel_angle: rad by one column. ring: the columns form a ring.
    """

    rotation: np.ndarray
    translation: np.ndarray
    pixel_angle: float
    ring: bool


def profiles(config: VisualOdometryConfig, grey: np.ndarray, where: str = "image") -> Profiles:
    """The profiles of an image [H, W] uint8.

    Raises:
        InputError: a crop is not a part of the image.
    """
    width = grey.shape[1]
    rotation = cropped(config.rotation, grey, where, "visual_odometry.rotation")
    translation = cropped(config.translation, grey, where, "visual_odometry.translation")
    ring = config.fov_deg == 360 and rotation.shape[1] == translation.shape[1] == width
    return Profiles(_profile(rotation), _profile(translation), np.deg2rad(config.fov_deg) / width, ring)


def motion_between(
    config: VisualOdometryConfig, before: Profiles, after: Profiles, dt: float
) -> tuple[float, float]:
    """Distance (VO metres) and turn (rad, counter-clockwise) between two frames that lie `dt` s apart."""
    reach = int(np.ceil(np.deg2rad(config.max_turn_rate_deg) * max(dt, 0.0) / after.pixel_angle))
    shift, _ = _best_shift(before.rotation, after.rotation, reach, after.ring)
    _, change = _best_shift(before.translation, after.translation, reach, after.ring)
    distance = min(config.scaling * change, config.max_speed * max(dt, 0.0))
    return distance, shift * after.pixel_angle


def _profile(part: np.ndarray) -> np.ndarray:
    """[w] column sums of a crop [h, w], divided by their mean; ones if it is black."""
    sums = part.sum(axis=0, dtype=np.int64)
    total = int(sums.sum())
    return sums * (len(sums) / total) if total else np.ones(len(sums))


def _best_shift(before: np.ndarray, after: np.ndarray, reach: int, ring: bool) -> tuple[float, float]:
    """The shift (columns to the right) of the least mean absolute difference, and that difference.

    Things move to the right in the image where the camera turns counter-clockwise.
    """
    width = len(after)
    reach = min(reach, width // 2)
    shifts = np.arange(-reach, reach + 1)
    columns = np.arange(width)[None, :] - shifts[:, None]  # where each column was before
    inside = (columns >= 0) & (columns < width) | ring
    difference = np.abs(after - before[columns % width])
    errors = np.sum(difference, axis=1, where=inside) / inside.sum(axis=1)
    order = np.lexsort((np.abs(shifts), errors))  # of equal errors the smallest shift
    best = int(order[0])
    return float(shifts[best]), float(errors[best])
