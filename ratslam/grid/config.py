"""Settings of the grid particle filter."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.base.settings import Settings

Share = Annotated[float, Field(gt=0, lt=1)]


class DriftConfig(Settings):
    """The filter's model of odometry errors: a turn or a distance d becomes d (1 + session + move + step),
    and a turn in t seconds heading_rate t more.

    Scale errors persist, and a filter that models them as independent noise of each step cannot track them.
    """

    session: NonNegativeFloat = 0.04
    """Standard deviation of the relative scale error that is constant over the session."""
    move: NonNegativeFloat = 0.03
    """Standard deviation of the relative scale error that is constant over one straight or one turn."""
    step: NonNegativeFloat = 0.02
    """Standard deviation of the relative scale error of one step."""
    heading: NonNegativeFloat = 5e-4
    """Standard deviation of the heading error of one step, rad."""
    heading_rate: NonNegativeFloat = 0.0
    """Standard deviation of a heading drift that is constant over the session, rad/s."""
    slip: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the forward motion that is lost in a step that begins in contact, and the largest lost share
    of its turn. 1 for bumpers: a wall stops the robot but not its wheels; 0 for whiskers, which bend."""


class ResamplingConfig(Settings):
    """When and how particles are resampled."""

    schedule: Literal["needed", "always"] = "needed"
    """`needed`: when the effective number of particles is low; `always`: at every report with evidence (Fox
    et al. 2012, Algorithm 1)."""
    scheme: Literal["systematic", "multinomial"] = "systematic"
    """`systematic`: low variance, the copies of a particle differ by less than one from its share."""
    min_effective_share: Share = 0.5
    """Effective particles, as a share of all, below which `needed` resamples."""
    length: NonNegativeFloat = 1e-3
    """Standard deviation of the displacement of copies, m."""
    heading: NonNegativeFloat = 1e-3
    """Standard deviation of the rotation of copies, rad."""
    scale: NonNegativeFloat = 3e-3
    """Standard deviation of the change of the session's scale error in copies."""
    heading_rate: NonNegativeFloat = 1e-4
    """Standard deviation of the change of the heading drift in copies, rad/s, where there is one."""


class LikelihoodConfig(Settings):
    """The likelihood of a report given a particle's pose and map."""

    model: Literal["evidence", "literal"] = "evidence"
    """`evidence`: unexplored cells are neutral, free whisker shafts weigh little and new contacts much;
    `literal`: Fox et al. 2012, eq. 1 and 2, as printed."""
    unexplored: Share = 0.03
    """Probability of an obstacle in unexplored cells, for `evidence`."""
    free: NonNegativeFloat = 0.05
    """Weight of each free point of a whisker or of the robot's body."""
    contact: NonNegativeFloat = 0.8
    """Weight of a new contact."""
    surprise: Share = 0.1
    """Probability of a contact in a cell without an obstacle."""
    wall: Annotated[float, Field(ge=0, le=1)] = 0.7
    """Weight of a wall's direction, against the directions in the map there and against all directions."""
    wall_direction_prior: bool = True
    """Assume that walls are parallel or perpendicular to each other, in any common orientation."""


class FootprintConfig(Settings):
    """The log-odds that a report adds to the map of each particle."""

    wall: Literal["anisotropic", "edge", "blob"] = "anisotropic"
    """Footprint of a wall of known direction. `anisotropic`: a Gaussian along the wall; `edge`: Fox et al.
    2012, eq. 4; `blob`: eq. 3."""
    edge: NonNegativeFloat = 1.0
    """Log-odds at a contact with a wall of known direction."""
    along: PositiveFloat = 0.18
    """Standard deviation along the wall, m."""
    across: PositiveFloat = 0.05
    """Standard deviation across the wall, m."""
    sector: PositiveFloat = 0.2617993877991494
    """Standard deviation of the direction from the contact, for `edge`, rad: pi / 12."""
    blob: NonNegativeFloat = 4.0
    """Log-odds at a contact."""
    blob_sd: PositiveFloat = 0.05
    """Standard deviation of a contact's footprint, m."""
    free: NonNegativeFloat = 0.5
    """Log-odds subtracted at each point of a free whisker."""
    free_sd: PositiveFloat = 0.02
    """Standard deviation of a free point's footprint, m; wider ones erase walls beside the whisker."""
    body: NonNegativeFloat = 1.0
    """Log-odds subtracted under the robot."""
    max_log_odds: PositiveFloat = 6.0
    """Limit on the log-odds of a cell, positive or negative."""


class DrawingConfig(Settings):
    """The map drawn along the path of the filter (Fox et al. 2012, eq. 3 and 4).

    Edges are shorter and more certain than in the paper, where they extend beyond the ends of walls.
    """

    contact: Share = 0.95
    """Probability of an obstacle at a contact."""
    blob_sd: PositiveFloat = 0.04
    """Standard deviation of a contact without a known wall, m."""
    edge_sd: PositiveFloat = 0.14
    """Standard deviation of a wall along its direction, m; 0.25 in the paper."""
    edge_sector: PositiveFloat = 0.35
    """Standard deviation of the direction from the contact, rad; pi / 12 in the paper."""
    free: Share = 0.4
    """Probability of an obstacle at the middle of a free whisker."""
    free_sd: PositiveFloat = 0.05
    """Standard deviation of a free whisker's footprint, m."""
    body: Share = 0.4
    """Probability of an obstacle under the robot."""
    max_log_odds: PositiveFloat = 3.5
    """Limit on the log-odds of a cell, positive or negative."""


class GridConfig(Settings):
    """The grid particle filter of Fox et al. 2012, with corrections."""

    particles: Annotated[int, Field(ge=2, le=1_000_000)] = 100
    """Number of particles."""
    cell: PositiveFloat = 0.05
    """Cell side length, m."""
    side: PositiveFloat | None = None
    """Side length of the map, centred on the start, m; null: the extent of the recording's odometry plus the
    reach of the whiskers, 2.5 for a live robot."""
    prior: Share = 0.3
    """Prior probability of an obstacle, in the drawn map and in eq. 2."""
    body: NonNegativeFloat = 0.12
    """Radius of the robot, m; 0 for an arm."""
    drift: DriftConfig = DriftConfig()
    resampling: ResamplingConfig = ResamplingConfig()
    likelihood: LikelihoodConfig = LikelihoodConfig()
    footprint: FootprintConfig = FootprintConfig()
    drawing: DrawingConfig = DrawingConfig()
