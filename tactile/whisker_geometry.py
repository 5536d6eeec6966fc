"""Geometry of whisker arrays: mounts, rest directions, swing planes and forward kinematics.

A whisker turns in a plane: at angle 0 it points along `rest`; a protraction turns it towards `swing`.
Coordinates are those of base_link, with z = 0 on the floor. Grid maps use whiskers as straight lines in the
plane of the floor (`PlanarWhiskers`).
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, model_validator

from tactile.base.settings import Settings
from tactile.base.types import Array

Degrees = Annotated[float, Field(ge=-360, le=360)]
Opening = Annotated[float, Field(gt=0, le=90)]


class RingConfig(Settings):
    """Whiskers of one length, evenly spread around the head's axis."""

    length: PositiveFloat
    """Whisker length, m."""
    radius: PositiveFloat
    """Distance of the bases from the head's axis, m."""
    height: PositiveFloat
    """Height of the bases above the floor, m."""


class HeadConfig(Settings):
    """The UR-10 head of Salman & Pearson 2016, III-A: rings of whiskers around a vertical axis that point
    outwards and down and protract towards the axis. Lengths are from the paper; other defaults are ours."""

    rings: Annotated[tuple[RingConfig, ...], Field(min_length=1)] = (
        RingConfig(length=0.05, radius=0.045, height=0.082),
        RingConfig(length=0.11, radius=0.065, height=0.12),
        RingConfig(length=0.16, radius=0.08, height=0.165),
    )
    """Rings from the inside out: the rows of the whisker image."""
    whiskers: Annotated[int, Field(ge=1, le=256)] = 6
    """Whiskers per ring: the columns of the image."""
    first_deg: Degrees = 0.0
    """Direction of the first column, counter-clockwise from ahead."""
    rest_deg: Opening = 75.0
    """Angle between a whisker at rest and the downward axis."""
    limit_deg: Annotated[float, Field(gt=0, lt=180)] = 70.0
    """Largest protraction of the drives."""
    dead: tuple[NonNegativeInt, ...] = ()
    """Indices of whiskers without signal, row by row."""

    @model_validator(mode="after")
    def _known(self) -> HeadConfig:
        count = len(self.rings) * self.whiskers
        if any(whisker >= count for whisker in self.dead):
            raise ValueError(f"dead whiskers {list(self.dead)}: the head has whiskers 0 to {count - 1}")
        return self


class Head(NamedTuple):
    """A whisker array.

    Attributes:
        base: [W, 3] positions of the bases, m. rest, swing: [W, 3] orthogonal unit vectors.
        length: [W] m. limit: largest protraction, rad. shape: rows and columns of the whisker image.
        alive: [W] bool.
    """

    base: np.ndarray
    rest: np.ndarray
    swing: np.ndarray
    length: np.ndarray
    limit: float
    shape: tuple[int, int]
    alive: np.ndarray


def ur10_head(config: HeadConfig) -> Head:
    """The head with this geometry."""
    rows, columns = len(config.rings), config.whiskers
    azimuth = np.radians(config.first_deg) + np.arange(columns) * (2 * np.pi / columns)
    outwards = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(columns)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    opening = np.radians(config.rest_deg)
    rest = np.sin(opening) * outwards - np.cos(opening) * up
    swing = -np.cos(opening) * outwards - np.sin(opening) * up
    alive = np.ones(rows * columns, bool)
    alive[list(config.dead)] = False
    return Head(
        base=np.concatenate([ring.radius * outwards + ring.height * up for ring in config.rings]),
        rest=np.tile(rest, (rows, 1)),
        swing=np.tile(swing, (rows, 1)),
        length=np.repeat([ring.length for ring in config.rings], columns),
        limit=float(np.radians(config.limit_deg)),
        shape=(rows, columns),
        alive=alive,
    )


def shaft_points(head: Head, angle: Array, along: Array) -> np.ndarray:
    """Points [..., W, 3] at distances `along` [..., W] from the bases, m, at protractions [..., W], rad."""
    angle, along = np.asarray(angle, float)[..., None], np.asarray(along, float)[..., None]
    return head.base + along * (np.cos(angle) * head.rest + np.sin(angle) * head.swing)


def tip_height(head: Head, angle: Array) -> np.ndarray:
    """Heights [..., W] of the tips above the floor, m: about the height of an obstacle touched there (Salman
    & Pearson 2016, III-D)."""
    return shaft_points(head, angle, head.length)[..., 2]


class PlanarWhiskers(NamedTuple):
    """W whiskers in base_link.

    Attributes:
        base: [W, 2] m. direction: [W, 2] unit vectors. length: [W] m.
    """

    base: np.ndarray
    direction: np.ndarray
    length: np.ndarray

    def points(self, share: np.ndarray) -> np.ndarray:
        """Points [W, K, 2] at shares [K] of the lengths, m."""
        along = self.length[:, None] * np.asarray(share, float)
        return self.base[:, None] + along[..., None] * self.direction[:, None]


def project_to_plane(head: Head, height: float) -> PlanarWhiskers:
    """The whiskers of a head projected to the plane, for obstacles of a height (m).

    Each reaches from its base to where its tip descends to that height.
    """
    outwards = head.rest[:, :2] / np.linalg.norm(head.rest[:, :2], axis=1, keepdims=True)
    drop = np.clip((head.base[:, 2] - height) / head.length, 0.0, 1.0)
    return PlanarWhiskers(head.base[:, :2], outwards, head.length * np.sqrt(1 - drop**2))


def image_points(head: Head, image: np.ndarray, tallest: float) -> tuple[np.ndarray, np.ndarray]:
    """Where whiskers touched walls of a known height.

    A pixel is the height of the tip at first contact as a share of `tallest`, hence the whisker's angle. The
    contact is where the shaft crosses the height of the walls, or the tip if it is above.

    Args:
        image: [..., W] pixels in 0..1, 0 without contact. tallest: height of pixel value 1 and of walls, m.

    Returns:
        [..., W, 2] points in base_link, m, and [..., W] bool, there is one.
    """
    touched = image > 0
    tip = image * tallest
    cos = np.clip((head.base[:, 2] - tip) / head.length, 0.0, 1.0)
    radius = np.hypot(head.base[:, 0], head.base[:, 1])
    tangent = np.sqrt(1 - cos**2) / np.maximum(cos, 1e-6)
    reach = radius + (head.base[:, 2] - np.maximum(tip, tallest)) * tangent
    outwards = head.rest[:, :2] / np.linalg.norm(head.rest[:, :2], axis=1, keepdims=True)
    return reach[..., None] * outwards, touched
