"""Whisker arrays as data: where each whisker is mounted, how it swings, and what its angle says.

A whisker turns in a plane: at angle 0, its rest, it points along `rest`; a protraction by an angle turns it
towards `swing`. Coordinates are those of base_link with z counted from the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from tactile.base.config import Settings
from tactile.base.types import Array

Degrees = Annotated[float, Field(ge=-360, le=360)]
Opening = Annotated[float, Field(gt=0, le=90)]


class RingConfig(Settings):
    """Whiskers of one length, evenly spread around the head's axis."""

    length: PositiveFloat
    """Of a whisker, m."""
    radius: PositiveFloat
    """Of its base from the head's axis, m."""
    height: PositiveFloat
    """Of its base above the floor, m."""


class HeadConfig(Settings):
    """The UR-10 head of Salman & Pearson 2016, III-A: rings around a vertical axis, whiskers hanging out and
    down, protracting towards the axis. Lengths are the paper's; what it leaves open are these defaults."""

    rings: Annotated[tuple[RingConfig, ...], Field(min_length=1)] = (
        RingConfig(length=0.05, radius=0.045, height=0.082),
        RingConfig(length=0.11, radius=0.065, height=0.12),
        RingConfig(length=0.16, radius=0.08, height=0.165),
    )
    """From the inner to the outer one: the rows of the whisker image."""
    whiskers: PositiveInt = 6
    """In each ring: the columns of the image."""
    first_deg: Degrees = 0.0
    """Direction of the first column, counter-clockwise from ahead."""
    rest_deg: Opening = 75.0
    """Of a whisker at rest from the axis that points down."""
    limit_deg: Annotated[float, Field(gt=0, lt=180)] = 70.0
    """Largest protraction that the drives allow."""
    dead: tuple[NonNegativeInt, ...] = ()
    """Whiskers that do not report, by number (row by row)."""

    @model_validator(mode="after")
    def _known(self) -> HeadConfig:
        count = len(self.rings) * self.whiskers
        if any(whisker >= count for whisker in self.dead):
            raise ValueError(f"dead whiskers {list(self.dead)}: the head has whiskers 0 to {count - 1}")
        return self


class Head(NamedTuple):
    """A whisker array.

    Attributes:
        base: [W, 3] m, where each whisker is mounted. rest, swing: [W, 3] unit vectors at right angles.
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
    """The head of that geometry."""
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


def create_head(
    *,
    length: float = 0.14,
    limit_deg: float = 70.0,
    height: float = 0.05,
    mounts: Sequence[tuple[float, float, float]] = (
        (0.14, 0.09, 100.0),
        (0.15, 0.03, 80.0),
        (0.15, -0.03, -80.0),
        (0.14, -0.09, -100.0),
    ),
) -> Head:
    """The four-whisker head of Fox et al. 2012 on a Create: whiskers swing forward in a plane over the floor.

    Args:
        length: m. height: of that plane, m. mounts: of each whisker: x (m), y (m) of its base in base_link,
            and its direction at rest, degrees counter-clockwise from ahead; it protracts towards ahead.
            The paper does not give the mounts; these are ours.
    """
    x, y, direction = np.array(mounts, float).T
    angle, side = np.radians(direction), np.sign(direction)
    zero = np.zeros(len(x))
    return Head(
        base=np.stack([x, y, zero + height], axis=1),
        rest=np.stack([np.cos(angle), np.sin(angle), zero], axis=1),
        swing=np.stack([side * np.sin(angle), -side * np.cos(angle), zero], axis=1),
        length=zero + length,
        limit=float(np.radians(limit_deg)),
        shape=(1, len(x)),
        alive=np.ones(len(x), bool),
    )


def shaft_points(head: Head, angle: Array, along: Array) -> np.ndarray:
    """[..., W, 3] m, the points that lie `along` [..., W] m from the bases at protractions [..., W] rad."""
    angle, along = np.asarray(angle, float)[..., None], np.asarray(along, float)[..., None]
    return head.base + along * (np.cos(angle) * head.rest + np.sin(angle) * head.swing)


def tip_points(head: Head, angle: Array) -> np.ndarray:
    """[..., W, 3] m, where the tips are at protractions [..., W] rad."""
    return shaft_points(head, angle, head.length)


def tip_height(head: Head, angle: Array) -> np.ndarray:
    """[..., W] m above the floor, of the tips: about as high as an obstacle met there (Salman & Pearson
    2016, III-D)."""
    return tip_points(head, angle)[..., 2]
