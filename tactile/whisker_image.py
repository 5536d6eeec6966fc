"""The whisker image: one pixel per whisker, whose value is the height of the touched obstacle (Salman &
Pearson 2016, III-D).

The height follows from the whisker's angle: `contact_angle` uses the angle at first contact, `max_angle` the
angle at the end of the protraction if the whisker is still in contact there. A whisker without contact is 0.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import PositiveFloat

from tactile.base.settings import Settings
from tactile.base.types import Observation, Whisk, observation
from tactile.whisker_geometry import Head, shaft_points, tip_height

MIN_BRIGHTNESS = 0.02
"""Least pixel value of a whisker in contact, so that it differs from one without."""


class ImageConfig(Settings):
    """Settings of the whisker image."""

    transform: Literal["max_angle", "contact_angle"] = "contact_angle"
    """The angle from which the height is computed."""
    tallest: PositiveFloat = 0.05
    """Height of pixel value 1, m; default the wall of a micromouse maze."""
    radial: bool = False
    """Whether a second channel holds the radial distance of each contact."""


def view_shape(config: ImageConfig, head: Head) -> tuple[int, int, int]:
    """(rows, columns, channels) of the image."""
    return (*head.shape, 2 if config.radial else 1)


def whisker_image(config: ImageConfig, head: Head, whisk: Whisk) -> np.ndarray:
    """The image of one whisk cycle: [R, C, K], values in 0..1."""
    if config.transform == "contact_angle":
        seen, angle = whisk.contact, whisk.touched
    else:
        seen, angle = whisk.held, whisk.highest
    bright = np.clip(tip_height(head, angle) / config.tallest, MIN_BRIGHTNESS, 1.0)
    channels = [bright, np.clip(whisk.reach, MIN_BRIGHTNESS, 1.0)][: 2 if config.radial else 1]
    pixels = np.stack(channels, axis=-1) * (seen & whisk.alive)[:, None]
    return pixels.reshape(view_shape(config, head))


def whisk_observation(config: ImageConfig, head: Head, whisk: Whisk) -> Observation:
    """The observation of one whisk cycle: view, contacts and contact points.

    Without a live whisker the observation has no view.
    """
    plain = observation(whisk.odometry, whisker_image(config, head, whisk), whiskers=len(head.length))
    seen = whisk.contact & whisk.alive
    along = np.where(whisk.reach > 0, whisk.reach, 1.0) * head.length
    point = shaft_points(head, np.where(seen, whisk.touched, 0.0), along)[:, :2] * seen[:, None]
    return plain._replace(view_seen=np.bool_(whisk.alive.any()), contact=seen, alive=whisk.alive, point=point)
