"""The whisker image: one pixel a whisker, as bright as what it met is high (Salman & Pearson 2016, III-D).

`max_angle` takes the whisker's angle at the end of the protraction, if it was still held there;
`contact_angle` the angle at which it first touched. A whisker that touched nothing is 0: black, not low.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import PositiveFloat

from tactile.base.config import Settings
from tactile.base.types import Observation, Whisk, observation
from tactile.whiskers.head_geometry import Head, shaft_points, tip_height

MIN_BRIGHTNESS = 0.02
"""The least brightness of a whisker that touched: never as dark as one that did not."""


class ImageConfig(Settings):
    """How touch becomes an image."""

    transform: Literal["max_angle", "contact_angle"] = "contact_angle"
    """Which angle tells the height."""
    tallest: PositiveFloat = 0.05
    """Height that is white, m: a micromouse wall."""
    radial: bool = False
    """Whether a second channel tells how far along its shaft each whisker was touched."""


def view_shape(config: ImageConfig, head: Head) -> tuple[int, int, int]:
    """(rows, columns, channels) of the image."""
    return (*head.shape, 2 if config.radial else 1)


def whisker_image(config: ImageConfig, head: Head, whisk: Whisk) -> np.ndarray:
    """[R, C, K] the image of one cycle, values in 0..1."""
    if config.transform == "contact_angle":
        seen, angle = whisk.contact, whisk.touched
    else:
        seen, angle = whisk.held, whisk.highest
    bright = np.clip(tip_height(head, angle) / config.tallest, MIN_BRIGHTNESS, 1.0)
    channels = [bright, np.clip(whisk.reach, MIN_BRIGHTNESS, 1.0)][: 2 if config.radial else 1]
    pixels = np.stack(channels, axis=-1) * (seen & whisk.alive)[:, None]
    return pixels.reshape(view_shape(config, head))


def whisk_observation(config: ImageConfig, head: Head, whisk: Whisk) -> Observation:
    """What an engine is given of one cycle; points of contact where the whiskers were touched.

    There is no view where no whisker reports.
    """
    plain = observation(whisk.odometry, whisker_image(config, head, whisk), whiskers=len(head.length))
    seen = whisk.contact & whisk.alive
    along = np.where(whisk.reach > 0, whisk.reach, 1.0) * head.length
    point = shaft_points(head, np.where(seen, whisk.touched, 0.0), along)[:, :2] * seen[:, None]
    return plain._replace(view_seen=np.bool_(whisk.alive.any()), contact=seen, alive=whisk.alive, point=point)
