"""Pokes: an arm without a whisker head feels walls with its tool.

The tool moves out from a pose in each of some directions until the force at it says contact, and back. A ring
of pokes is one image: a pixel per direction, whose value is the depth bin of the contact; 0 without contact.

The force of an arm drifts with its pose and has an offset, so its value says little. A contact is a rise: the
mean of the newest states less that of the states shortly before (`force_rise`). How large it is without
contact, and so the threshold, is learned from pokes in free air, as contact detection learns whiskers.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, PositiveFloat

from tactile.base.errors import InputError
from tactile.base.settings import Settings
from tactile.base.types import Observation, Odometry, observation


class PokeConfig(Settings):
    """Pokes of an arm with its tool."""

    directions: Annotated[int, Field(ge=2, le=16, multiple_of=2)] = 6
    """Number of pokes in a ring, evenly spread, the first one ahead; opposite ones belong together."""
    reach: PositiveFloat = 0.27
    """Depth of a poke without contact, m: one and a half cells of a maze."""
    bins: Annotated[int, Field(ge=2, le=30)] = 18
    """Depth bins of the image."""
    radius: PositiveFloat = 0.005
    """Radius of the tool, m."""
    every: PositiveFloat = 0.06
    """Distance between rings along a route, m; a turn of 1 rad counts as 0.1 m."""
    speed: Annotated[float, Field(gt=0, le=0.05)] = 0.02
    """Speed of a poke, m/s. The tool runs on for about 0.04 s after a contact, which presses it into a stiff
    wall."""
    retract: Annotated[float, Field(gt=0, le=0.25)] = 0.05
    """Speed of the way back, m/s."""
    recent: PositiveFloat = 0.04
    """Time over which the newest force is averaged, s."""
    before: tuple[PositiveFloat, PositiveFloat] = (0.25, 1.25)
    """Times before the newest state between which the force is averaged that a rise is measured from, s."""
    sds: PositiveFloat = 8.0
    """Threshold of the rise: its mean in free air and so many of its standard deviations there."""


DEFAULT_POKES = PokeConfig()
TURN_LENGTH = 0.1
"""Way that a turn of 1 rad counts as, m."""
FLOOR = 1 / 30
"""Least threshold as a share of the arm's force limit, for a force without noise."""
HIGHEST = 1 / 3
"""Largest threshold as a share of the arm's force limit: a poke stops there at the latest."""


def ring_time(config: PokeConfig) -> float:
    """Duration of a ring without contacts, s."""
    return config.directions * config.reach * (1 / config.speed + 1 / config.retract)


def poke_angles(config: PokeConfig) -> np.ndarray:
    """Directions [D] of the pokes in base_link, rad, counter-clockwise from ahead."""
    return 2 * np.pi * np.arange(config.directions) / config.directions


def force_rise(config: PokeConfig, push: np.ndarray, hz: float) -> np.ndarray:
    """Rise of a force [..., T], N, at each state: the mean over `recent` less the mean over `before`.

    It is 0 while `before` holds less than four times as many states as `recent`.

    Args:
        push: force against the tool along its way, N. hz: states per second.
    """
    push = np.asarray(push, np.float64)
    total = np.concatenate([np.zeros((*push.shape[:-1], 1)), np.cumsum(push, axis=-1)], axis=-1)
    end, width = np.arange(1, push.shape[-1] + 1), max(round(config.recent * hz), 1)
    since, until = (np.maximum(end - round(ago * hz), 0) for ago in config.before[::-1])
    base = (total[..., until] - total[..., since]) / np.maximum(until - since, 1)
    newest = (total[..., end] - total[..., np.maximum(end - width, 0)]) / np.minimum(end, width)
    return np.where(until - since >= 4 * width, newest - base, 0.0)


def is_loaded(push: np.ndarray, limit: float) -> np.ndarray:
    """Whether two states in a row [..., T] exceed the first few by a third of the arm's force limit (N)."""
    above = push - push[..., :5].mean(axis=-1, keepdims=True) > HIGHEST * limit
    above[..., 1:] &= above[..., :-1].copy()
    above[..., 0] = False
    return above


def learn_threshold(config: PokeConfig, free: list[np.ndarray], hz: float, limit: float) -> float:
    """The rise of the force that counts as a contact, N, from pokes in free air.

    Args:
        free: force [T] against the tool along each of them, N. limit: the arm's force limit, N.

    Raises:
        InputError: the force is too uneven for a threshold of at most a third of the limit.
    """
    rise = np.concatenate([force_rise(config, push, hz) for push in free])
    threshold = max(float(np.abs(rise.mean()) + config.sds * rise.std()), FLOOR * limit)
    if not threshold <= HIGHEST * limit:
        found = f"the force in free air asks for a threshold of {threshold:.1f} N"
        expected = f"at most {HIGHEST * limit:g}, a third of live.arm.force_limit"
        raise InputError("live.arm", found, expected, "check the payload and the tool on the pendant")
    return threshold


def poke_observation(
    config: PokeConfig, depth: np.ndarray, contact: np.ndarray, odometry: Odometry
) -> Observation:
    """The observation of a ring: image [1, D, 1], contacts and contact points.

    Args:
        depth: [D] way of the tool up to the contact, m; `reach` without one. contact: [D] bool.
    """
    level = np.clip(np.floor(depth / config.reach * config.bins), 0, config.bins - 1)
    image = np.where(contact, (level + 0.5) / config.bins, 0.0)
    plain = observation(odometry, image[None, :, None], whiskers=config.directions)
    return plain._replace(contact=contact.copy(), point=poke_points(config, depth) * contact[:, None])


def poke_points(config: PokeConfig, depth: np.ndarray) -> np.ndarray:
    """Points [..., D, 2] in base_link that a tool at these depths [..., D] touches, m."""
    angle, far = poke_angles(config), np.asarray(depth)[..., None] + config.radius
    return far * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def image_depths(config: PokeConfig, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depths [..., D] of images [..., D], m, and whether they are contacts [..., D]."""
    return np.asarray(image) * config.reach, np.asarray(image) > 0
