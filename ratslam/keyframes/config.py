"""The settings of the frame map: what is believed, and how much. Lengths are in pose cells."""

from __future__ import annotations

from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from tactile.base.config import Settings


class KeyframeNoise(Settings):
    """How much the odometry between frames is believed; cells are pose cells."""

    per_cell: PositiveFloat = 0.05
    """Standard deviation of position after one cell, cells; grows with the root of the way."""
    heading_per_cell: NonNegativeFloat = 0.02
    """Standard deviation of heading after one cell, rad."""
    heading_per_radian: NonNegativeFloat = 0.04
    """Standard deviation of heading after a turn of one radian, rad."""
    least: PositiveFloat = 0.02
    """Standard deviation between any two frames, cells."""
    least_heading: PositiveFloat = 0.005
    """The same of heading, rad."""


class KeyframeMapConfig(Settings):
    """The map of frames: what is believed, and how much. Lengths are in pose cells."""

    noise: KeyframeNoise = KeyframeNoise()
    """Trust in odometry."""
    bias_from_views: bool = True
    """Whether ordered views tell it beforehand."""
    bias_sd: PositiveFloat = 0.012
    """Standard deviation of the bias where views tell nothing, rad per cell."""
    bias_least: PositiveFloat = 0.003
    """The views are never believed better than this, rad per cell."""
    shrink: NonNegativeFloat = 3.0
    """Standard errors under which the views' bias is taken for none."""
    candidate_posterior: PositiveFloat = 0.5
    """Posterior from which a recollection is a candidate."""
    max_gap: PositiveInt = 3
    """Frames from one candidate of a run to the next, at most."""
    agreement: PositiveFloat = 2.0
    """How far candidates of a run may differ from the odometry between them, cells (and a tenth of it)."""
    agreement_heading: PositiveFloat = 0.5
    """The same of heading, rad."""
    min_length: PositiveInt = 2
    """Candidates that an accepted run has at least."""
    min_score: PositiveFloat = 4.0
    """Evidence it has at least, after half its squared Mahalanobis distance from the map is taken off and
    the log of how many times more frames the map allows than stand around one place."""
    max_distance: PositiveFloat = 12.0
    """That squared distance is smaller than this."""
    gate_sd: PositiveFloat = 0.7
    """Standard deviation added to the map's own in that distance, cells."""
    gate_heading: PositiveFloat = 0.2
    """The same of heading, rad."""
    closure_sd: PositiveFloat = 0.8
    """Standard deviation of a closure, cells."""
    closure_heading: PositiveFloat = 0.12
    """The same of heading, rad."""
    robust_per_score: PositiveFloat = 0.5
    """Robust scale (mean squared deviation) for each unit of a run's evidence."""
    robust_least: PositiveFloat = 2.0
    """The least such scale."""
    robust_most: PositiveFloat = 20.0
    """The largest."""
    breaks: bool = True
    """Whether long runs that contradict the map cut the odometry."""
    break_length: PositiveInt = 32
    """Candidates in such a run."""
    break_score: PositiveFloat = 100.0
    """Evidence in it."""
    sequence_agreement: NonNegativeFloat = 0.0
    """How far the whole of a run may differ from the odometry, beside `agreement`, as a share of the way; 0:
    only from one candidate to the next."""
    select_every: NonNegativeInt = 0
    """Frames after which all runs are weighed against each other anew, believed or not (see
    `ratslam.keyframes.closure_selection`); 0: never, a run once accepted stays."""
    select_score: PositiveFloat = 12.0
    """Evidence of the runs that are weighed."""
    select_length: PositiveInt = 4
    """Candidates that they have at least."""
    sequence_cost: PositiveFloat = 6.0
    """Evidence that a weighed run must bring before it may strain the map at all."""
    closure_cost_limit: PositiveFloat = 6.0
    """Chi-square that a single closure of a weighed run can cost at most."""
    solve_every: PositiveInt = 1
    """Frames between two solutions while a run goes on."""
    iterations: PositiveInt = 4
    """Solver steps when a loop closes."""
    settling: PositiveInt = 15
    """Solver steps for the final map."""
    max_turn: PositiveFloat = 10.0
    """Share of `agreement_heading` by which a robot may be turned and still be in a known experience."""
    place_radius: PositiveFloat = 2.0
    """Reach of an experience, cells."""
    place_heading: PositiveFloat = 0.35
    """The same of heading, rad."""
