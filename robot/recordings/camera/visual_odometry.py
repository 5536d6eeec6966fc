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
from tactile.base.settings import Settings


class VisualOdometryConfig(Settings):
    """Visual odometry, for recordings with images and without odometry. Its distances are in VO metres, of
    unknown length unless `scaling` was calibrated."""

    fov_deg: float = Field(gt=0, le=360)
    """Horizontal field of view of the whole image, degrees, taken as equal angles for all columns; 360: a
    panorama, whose columns form a ring."""
    rotation: Crop = Crop()
    """The part of the image from which turns are found. Best are far things straight ahead: what passes at
    the sides moves against the turn or with it."""
    translation: Crop = Crop()
    """The part of the image from which distances are found: near things, at the sides and on the ground."""
    scaling: PositiveFloat = 1.0
    """Distance for a mean profile difference of 1, VO metres."""
    max_speed: PositiveFloat = 5.0
    """Largest speed, VO metres/s."""
    max_turn_rate_deg: PositiveFloat = 120.0
    """Largest turn rate, degrees/s: shifts between frames are searched up to this rate."""


class Profile(NamedTuple):
    """Intensities [w] with mean 1 of the columns of a crop, and whether the columns form a ring."""

    values: np.ndarray
    ring: bool


class Profiles(NamedTuple):
    """The two profiles of a frame, and the angle of one column, rad."""

    rotation: Profile
    translation: Profile
    pixel_angle: float


def profiles(config: VisualOdometryConfig, grey: np.ndarray, where: str = "image") -> Profiles:
    """The profiles of an image [H, W] uint8.

    Raises:
        InputError: a crop is not a part of the image.
    """
    rotation = _profile(config, "rotation", grey, where)
    translation = _profile(config, "translation", grey, where)
    return Profiles(rotation, translation, float(np.deg2rad(config.fov_deg)) / grey.shape[1])


def motion_between(
    config: VisualOdometryConfig, before: Profiles, after: Profiles, dt: float
) -> tuple[float, float]:
    """Distance (VO metres) and turn (rad, counter-clockwise) between two frames that lie `dt` s apart."""
    dt = max(dt, 0.0)  # of stamps that go back, which the reader reports
    reach = int(np.ceil(np.deg2rad(config.max_turn_rate_deg) * dt / after.pixel_angle))
    shift, _ = _best_shift(before.rotation, after.rotation, reach)
    _, change = _best_shift(before.translation, after.translation, reach)
    return min(config.scaling * change, config.max_speed * dt), shift * after.pixel_angle


def _profile(config: VisualOdometryConfig, name: str, grey: np.ndarray, where: str) -> Profile:
    part = cropped(getattr(config, name), grey, where, f"visual_odometry.{name}")
    sums = part.sum(axis=0, dtype=np.int64)
    total = int(sums.sum())
    values = sums * (len(sums) / total) if total else np.ones(len(sums))
    return Profile(values, config.fov_deg == 360 and len(sums) == grey.shape[1])


def _best_shift(before: Profile, after: Profile, reach: int) -> tuple[float, float]:
    """The shift of the least mean absolute difference, in columns to the right, and that difference.

    Things move to the right in the image where the camera turns counter-clockwise.
    """
    width = len(after.values)
    reach = min(reach, width // 2)
    shifts = np.arange(-reach, reach + 1)
    columns = np.arange(width)[None, :] - shifts[:, None]  # where each column was before
    inside = (columns >= 0) & (columns < width) | after.ring
    difference = np.abs(after.values - before.values[columns % width])
    errors = np.sum(difference, axis=1, where=inside) / inside.sum(axis=1)
    best = int(np.lexsort((np.abs(shifts), errors))[0])  # of equal errors the smallest shift
    return float(shifts[best]) + _vertex(errors, best), float(errors[best])


def _vertex(errors: np.ndarray, best: int) -> float:
    """Position of the minimum between columns, -0.5 to 0.5 from `best`.

    An absolute difference rises on both sides of its minimum with equal slope: the vertex of that V,
    through the least error and its neighbours.
    """
    if not 0 < best < len(errors) - 1:
        return 0.0
    left, least, right = errors[best - 1 : best + 2].tolist()
    rise = max(left, right) - least
    return (left - right) / (2 * rise) if rise > 0 else 0.0
