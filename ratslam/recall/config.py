"""Settings of recall."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from tactile.base.settings import Settings

Share = Annotated[float, Field(ge=0, le=1)]


class RecallConfig(Settings):
    """Settings of recall. Lengths are in pose cells, so that one setting serves every robot.

    A *scale* is the error below which views of different places seldom come (`MapFeedback.scale`).
    """

    sector_fov: Literal["auto", "none", "whiskers"] | float = "auto"
    """Field of view, rad (counter-clockwise positive), of views that are ordered sectors, so that a turned
    robot sees them shifted; `none`: not ordered; `whiskers`: rows of whiskers around the robot; `auto` (also
    0): estimated from the session."""
    images: Literal["heights", "signed"] = "heights"
    """Whiskers: `heights`: a pixel is silent or has a height in 0..1, compared by its level; `signed`: pixels
    are signed departures from rest in any unit, compared by their covariances. Sources of signed views set
    it."""
    shifts: Annotated[int, Field(ge=0, le=4096)] = 3
    """Largest sector shift in either direction. With whiskers, any value but 0 compares views turned by half
    a turn too, where each whisker is compared with the opposite one; signed images are not."""
    frame_distance: PositiveFloat = 0.3
    """Distance after which a view becomes a keyframe, cells. A robot at rest stores nothing."""
    frame_turn: PositiveFloat = 0.15
    """Turn after which a view becomes a keyframe, rad."""
    guard: PositiveInt = 20
    """Number of newest keyframes that are not recalled, because the robot is still near them."""
    sharpness: PositiveFloat = 0.2
    """Error that divides the likelihood by e, in scales."""
    floor: PositiveFloat = 1.27
    """Error that stands for a view never seen before, in scales."""
    common: NonNegativeFloat = 1.0
    """Weight of the mean likelihood over all keyframes in the likelihood of novelty; with 1, a view that all
    places share carries no evidence."""
    fresh: NonNegativeFloat = 0.3
    """Weight of a view at `floor` in the likelihood of novelty."""
    excite: PositiveFloat = 0.5
    """Standard deviation of local excitation in the network, cells: of a keyframe's position relative to
    odometry since the view before."""
    excite_heading: PositiveFloat = 0.21
    """The same of its heading, rad."""
    miss: PositiveFloat = 0.002
    """Weight of the case that no keyframe lies where odometry leads, relative to a keyframe exactly there."""
    leak: Share = 0.003
    """Share of the belief that is lost at every keyframe and becomes novelty."""
    enter: Share = 0.05
    """Share of novelty that enters the belief anew at every keyframe."""
    local: Share = 0.3
    """Share of `enter` placed around the map's pose; the rest is spread over all keyframes."""
    local_sd: PositiveFloat = 1.0
    """Standard deviation of the map's position after a closure, cells."""
    local_rate: NonNegativeFloat = 0.05
    """Growth of the position's standard deviation per metre travelled since, m."""
    local_heading: PositiveFloat = 0.3
    """Standard deviation of the map's heading after a closure, rad."""
    local_heading_rate: NonNegativeFloat = 0.006
    """Growth of the heading's standard deviation per cell travelled since, rad."""
    temper: PositiveFloat = 0.25
    """Whiskers: factor on the log-odds of an image, because pixels are not independent."""
    familiar: Share = 0.8
    """Whiskers: weight, in the likelihood of novelty, of the successors of keyframes similar to the
    previous image, relative to `floor`."""


def sector_shifts(config: RecallConfig) -> np.ndarray:
    """[S] sector shifts at which views are compared; whiskers: half turns."""
    if config.sector_fov == "whiskers":
        return np.arange(2 if config.shifts and config.images == "heights" else 1, dtype=np.int32)
    reach = 0 if config.sector_fov == "none" else config.shifts
    return np.arange(-reach, reach + 1, dtype=np.int32)
