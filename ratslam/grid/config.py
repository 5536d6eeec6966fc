"""The configuration of the grid particle filter."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.base.config import Settings

Share = Annotated[float, Field(gt=0, lt=1)]


class DriftConfig(Settings):
    """What particles believe of the odometry's errors: of a turn or a distance d, d (1 + run + move + step).

    Errors of scale last; a filter that takes them for noise of each step cannot follow them.
    """

    run: NonNegativeFloat = 0.04
    """Standard deviation of the scale error that lasts the whole run, as a share."""
    move: NonNegativeFloat = 0.03
    """Of the one that lasts one straight or one turn."""
    step: NonNegativeFloat = 0.02
    """Of the one of each step."""
    heading: NonNegativeFloat = 5e-4
    """Of the heading at each step, rad."""


class ResamplingConfig(Settings):
    """When and how particles are drawn anew."""

    when: Literal["needed", "always"] = "needed"
    """`needed`: when the effective number falls; `always`: at every report with evidence (Algorithm 1)."""
    how: Literal["systematic", "multinomial"] = "systematic"
    """`systematic`: each particle within one of its share, survivors stay where they are."""
    effective: Share = 0.5
    """Share of effective particles under which they are drawn anew."""
    length: NonNegativeFloat = 1e-3
    """Standard deviation by which copies are moved, m."""
    heading: NonNegativeFloat = 1e-3
    """By which they are turned, rad."""
    scale: NonNegativeFloat = 3e-3
    """By which their belief of the odometry's scale is changed, as a share."""


class LikelihoodConfig(Settings):
    """How particles are weighed."""

    model: Literal["evidence", "distinct", "exclusive", "literal"] = "evidence"
    """`evidence`: unexplored space says nothing, empty shafts little, new contacts much; the others: Fox et
    al. 2012, eq. 2, on distinct cells without that of the contact; without it; as printed."""
    unexplored: Share = 0.03
    """Chance of an obstacle where nothing was felt, for `evidence`."""
    free: NonNegativeFloat = 0.05
    """Weight of each point of a shaft, or of the body, that meets nothing."""
    contact: NonNegativeFloat = 0.8
    """Weight of a new contact."""
    surprise: Share = 0.1
    """Chance of a contact where the map has nothing."""
    wall: Annotated[float, Field(ge=0, le=1)] = 0.7
    """Weight of a wall's direction against the field of directions there, and of all walls to each other."""
    compass: bool = True
    """Whether walls are expected to be parallel or at right angles to each other, whatever the axes are."""


class StampConfig(Settings):
    """What a report adds to the map of each particle, in log-odds."""

    wall: Literal["anisotropic", "edge", "blob"] = "anisotropic"
    """`anisotropic`: a Gaussian along the wall; `edge`: Fox et al. 2012, eq. 4; `blob`: eq. 3."""
    edge: NonNegativeFloat = 1.0
    """At a contact with a wall of known direction."""
    along: PositiveFloat = 0.18
    """Standard deviation along the wall, m."""
    across: PositiveFloat = 0.05
    """Across it, m."""
    fan: PositiveFloat = 0.2617993877991494
    """Of the direction seen from the contact, for `edge`, rad: pi / 12."""
    blob: NonNegativeFloat = 4.0
    """At a contact."""
    blob_sd: PositiveFloat = 0.05
    """m"""
    free: NonNegativeFloat = 0.5
    """Taken off at each point of a shaft that meets nothing."""
    free_sd: PositiveFloat = 0.02
    """Standard deviation there, m: wider ones reach beyond the shaft and wipe out walls felt before."""
    body: NonNegativeFloat = 1.0
    """Taken off where the robot stands."""
    most: PositiveFloat = 6.0
    """Largest evidence of a cell, for or against."""


class DrawingConfig(Settings):
    """How the map is drawn (Fox et al. 2012, eq. 3 and 4), along the path that the filter has found. Edges
    are shorter and surer than the paper's, which run on beyond the ends of walls."""

    contact: Share = 0.95
    """Chance of an obstacle where one was felt."""
    blob_sd: PositiveFloat = 0.04
    """Standard deviation of a contact without a known wall, m."""
    edge_sd: PositiveFloat = 0.14
    """Of one with a wall, along it, m; 0.25 in the paper."""
    edge_fan: PositiveFloat = 0.35
    """Of the direction in which it is seen from the contact, rad; pi / 12 in the paper."""
    free: Share = 0.4
    """Chance of an obstacle at the middle of a whisker that meets nothing."""
    free_sd: PositiveFloat = 0.05
    """m"""
    body: Share = 0.4
    """Where the robot stands."""
    most: PositiveFloat = 3.5
    """Largest evidence of a cell, for or against, log-odds."""
    fusion: Literal["log_odds", "literal", "max", "average"] = "log_odds"
    """How a mark is fused with what is there, the others for study: `log_odds`: their evidence is added;
    `literal`: eq. 3 and 4 as printed, likelihoods that fall to 0 far from where they were made, multiplied
    into the whole map: one contact erases it; `max`: the stronger of the two evidences, so that nothing
    counts twice; `average`: the mean of the map's chance and of what the mark alone would draw, so that old
    marks fade."""


class GridConfig(Settings):
    """The grid particle filter (Fox et al. 2012, made to work)."""

    particles: Annotated[int, Field(ge=2, le=1_000_000)] = 100
    """How many."""
    cell: PositiveFloat = 0.05
    """Side of a cell, m."""
    side: PositiveFloat | None = None
    """Of the map, whose middle is where the robot starts, m; null: what the recording's odometry covers and
    whiskers reach, 2.5 for a live robot."""
    prior: Share = 0.3
    """Chance of an obstacle where nothing was felt, as the map is drawn (and in eq. 2)."""
    body: NonNegativeFloat = 0.12
    """Radius of the robot, m; 0 for an arm that stands nowhere."""
    drift: DriftConfig = DriftConfig()
    resampling: ResamplingConfig = ResamplingConfig()
    likelihood: LikelihoodConfig = LikelihoodConfig()
    stamps: StampConfig = StampConfig()
    drawing: DrawingConfig = DrawingConfig()
