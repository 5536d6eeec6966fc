"""A box with cues, and what a rat sees in it: a panoramic view of its walls and of the room beyond."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from tactile.base.se2 import wrap
from tactile.base.settings import Settings

Brightness = Annotated[float, Field(ge=0, le=1)]
RAYS = 5
"""Directions a column, so that the edge of a card moves through a column in steps."""
ROWS = 1000
"""Views computed at once."""


class CueConfig(Settings):
    """A card on a wall, or an object far outside the box."""

    at_deg: float
    """Direction of its middle from the middle of the box, degrees counter-clockwise from x."""
    extent_deg: Annotated[float, Field(gt=0, le=360)]
    """Its width as seen from the middle of the box, degrees."""
    brightness: Brightness
    """Its brightness, 0..1."""


class BoxConfig(Settings):
    """A rectangular box with a corner at the origin."""

    width: PositiveFloat = 1.0
    """Size along x, m."""
    height: PositiveFloat = 1.0
    """Size along y, m."""
    wall: PositiveFloat = 0.5
    """Height of the walls above the eyes, m."""
    wall_brightness: Brightness = 0.4
    """Brightness of the walls beside cards."""
    room_brightness: Brightness = 0.15
    """Brightness of the room above the walls beside distal cues."""
    cards: tuple[CueConfig, ...] = (
        CueConfig(at_deg=0.0, extent_deg=50.0, brightness=1.0),
        CueConfig(at_deg=110.0, extent_deg=40.0, brightness=0.0),
        CueConfig(at_deg=205.0, extent_deg=25.0, brightness=0.8),
    )
    """Cards, as high as the wall: local cues. A later one covers an earlier one."""
    distal: tuple[CueConfig, ...] = (
        CueConfig(at_deg=60.0, extent_deg=40.0, brightness=0.9),
        CueConfig(at_deg=250.0, extent_deg=30.0, brightness=0.6),
    )
    """Cues so far away that their direction is the same everywhere, seen above the walls."""


class ViewConfig(Settings):
    """Panoramic views."""

    columns: Annotated[int, Field(ge=4, le=360)] = 36
    """Columns of a view: directions around the rat, counter-clockwise from ahead."""
    every: PositiveInt = 5
    """Steps between views."""
    elevation_deg: Annotated[float, Field(gt=0, le=90)] = 70.0
    """Highest elevation of the view, degrees. A column is the mean brightness from the horizon up to it."""
    noise: NonNegativeFloat = 0.01
    """Standard deviation of independent noise in each column."""


def panoramic_views(
    box: BoxConfig, views: ViewConfig, pose: np.ndarray, card_turn: np.ndarray, distal_turn: np.ndarray,
    stretch: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """[N, 1, C, 1] views in 0..1 from poses [N, 3] (m, m, rad), without noise.

    Column c looks along the heading plus 2 pi c / C. A wall at distance d fills the elevations up to
    atan(wall / d), so that a near wall hides the room: views differ by position.

    Args:
        card_turn, distal_turn: [N] turn of the cards and of the distal cues around the middle, rad.
        stretch: [N, 2] factors of width and height; cards stretch with their wall.
    """
    rays = 2 * np.pi * np.arange(views.columns * RAYS) / (views.columns * RAYS)
    rays = rays - 2 * np.pi * (RAYS // 2) / (views.columns * RAYS)
    brightness = np.empty((len(pose), views.columns))
    for first in range(0, len(pose), ROWS):
        rows = slice(first, first + ROWS)
        bearing = pose[rows, 2:] + rays
        wall, share = _wall_brightness(box, views, pose[rows], bearing, card_turn[rows], stretch[rows])
        room = _paint(box.room_brightness, box.distal, bearing - distal_turn[rows, None])
        seen = share * wall + (1 - share) * room
        brightness[rows] = seen.reshape(len(seen), views.columns, RAYS).mean(axis=2)
    return brightness[:, None, :, None]


def torus_ratio(extent: tuple[float, float, float, float], side: float) -> tuple[float, float]:
    """Width and height of a box (x0, y0, x1, y1), m, over the side of a torus, m: the number of cells along a
    side times their size. Above 1 a cell has several places in the box, periodically."""
    x0, y0, x1, y1 = extent
    return (x1 - x0) / side, (y1 - y0) / side


def _wall_brightness(
    box: BoxConfig, views: ViewConfig, pose: np.ndarray, bearing: np.ndarray, turn: np.ndarray,
    stretch: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """[N, M] brightness of the wall along bearings [N, M], rad, and the share of the elevations it fills."""
    direction = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    side = (stretch * [box.width, box.height])[:, None]
    start = pose[:, None, :2]
    ahead = np.where(direction > 0, side - start, start)  # along x and along y, to the wall ahead
    distance = np.min(ahead / np.maximum(np.abs(direction), 1e-12), axis=-1)
    hit = (start + distance[..., None] * direction - side / 2) / stretch[:, None]
    painted = _paint(box.wall_brightness, box.cards, np.arctan2(hit[..., 1], hit[..., 0]) - turn[:, None])
    share = np.arctan2(box.wall, np.maximum(distance, 1e-9)) / np.radians(views.elevation_deg)
    return painted, np.minimum(share, 1.0)


def _paint(ground: float, cues: tuple[CueConfig, ...], bearing: np.ndarray) -> np.ndarray:
    """Brightness along bearings, rad: that of the last cue there, or of the ground."""
    brightness = np.full(bearing.shape, ground)
    for cue in cues:
        beside = np.abs(wrap(bearing - np.radians(cue.at_deg)))
        brightness[beside <= np.radians(cue.extent_deg) / 2] = cue.brightness
    return brightness
