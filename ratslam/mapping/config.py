"""Settings of the keyframe map. Lengths are in pose cells."""

from __future__ import annotations

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from tactile.base.settings import Settings


class KeyframeNoise(Settings):
    """Noise of the odometry between keyframes."""

    per_cell: PositiveFloat = 0.05
    """Standard deviation of position after one cell, cells; grows with the root of the distance."""
    heading_per_cell: NonNegativeFloat = 0.02
    """Standard deviation of heading after one cell, rad."""
    heading_per_radian: NonNegativeFloat = 0.04
    """Standard deviation of heading after a turn of one radian, rad."""
    least: PositiveFloat = 0.02
    """Least standard deviation of position between two keyframes, cells."""
    least_heading: PositiveFloat = 0.005
    """Least standard deviation of heading between two keyframes, rad."""


class StartCalibration(Settings):
    """Calibration of the odometry that the map starts from: `calibration.yaml` of a finished session."""

    heading_bias: float = 0.0
    """Heading bias, rad/m."""
    heading_bias_sd: PositiveFloat | None = None
    """Standard deviation of the heading bias, rad/m; null: `bias_sd` per cell."""
    turn_error: float = Field(default=0.0, gt=-1.0)
    """Error of turns, rad/rad."""
    turn_error_sd: PositiveFloat | None = None
    """Standard deviation of the error of turns, rad/rad; null: `turn_error_sd` of the map. Turns without a
    systematic error (`turn_error_sd` 0) have none here either."""
    heading_noise: PositiveFloat = 1.0
    """Factor on the variances of heading in `noise`; whiskers learn it."""


class KeyframeMapConfig(Settings):
    """Settings of the keyframe map. Lengths are in pose cells."""

    noise: KeyframeNoise = KeyframeNoise()
    """Noise of the odometry."""
    calibration: StartCalibration = StartCalibration()
    """Calibration of the odometry to start from."""
    bias_from_views: bool = True
    """Whether ordered views give a prior of the heading bias."""
    bias_sd: PositiveFloat = 0.012
    """Standard deviation of the heading bias without views, rad per cell."""
    turn_error_sd: NonNegativeFloat = 0.05
    """Standard deviation of the error of turns, rad/rad; 0: turns have no systematic error."""
    bias_least: PositiveFloat = 0.003
    """Least standard deviation of the views' heading bias, rad per cell."""
    shrink: NonNegativeFloat = 4.0
    """Number of standard errors below which the views' heading bias counts as zero."""
    candidate_posterior: PositiveFloat = 0.5
    """Posterior above which a recalled keyframe is a closure candidate."""
    max_gap: PositiveInt = 3
    """Largest number of keyframes between two candidates of a closure sequence."""
    agreement: PositiveFloat = 2.0
    """Largest difference between the candidates of a sequence and the odometry between them, cells (plus a
    tenth of the distance)."""
    agreement_heading: PositiveFloat = 0.5
    """Largest difference in heading between the candidates of a sequence and the odometry, rad."""
    min_length: PositiveInt = 2
    """Least number of candidates of an accepted sequence."""
    min_score: PositiveFloat = 4.0
    """Whiskers: least evidence of an accepted sequence, after subtraction of half its squared Mahalanobis
    distance from the map."""
    max_distance: PositiveFloat = 12.0
    """Upper limit of that squared Mahalanobis distance."""
    gate_sd: PositiveFloat = 0.7
    """Standard deviation of position added to the map's own in that distance, cells."""
    gate_heading: PositiveFloat = 0.2
    """Standard deviation of heading added to the map's own in that distance, rad."""
    closure_sd: PositiveFloat = 0.8
    """Standard deviation of a closure's position, cells."""
    closure_heading: PositiveFloat = 0.12
    """Standard deviation of a closure's heading, rad."""
    robust_per_score: PositiveFloat = 0.5
    """Robust scale (mean squared deviation) per unit of a sequence's evidence."""
    robust_least: PositiveFloat = 2.0
    """Least robust scale."""
    robust_most: PositiveFloat = 20.0
    """Largest robust scale."""
    may_be_carried: bool = False
    """Whether the robot may be carried during a session: only then the odometry is cut."""
    tie_log_odds: PositiveFloat = 6.5
    """Log-odds at which a piece of the map is tied to another one, beyond the logarithm of the number of
    its places; below half of them the tie is undone."""
    break_length: PositiveInt = 32
    """Least number of candidates of a sequence that cuts the odometry of a robot that may be carried,
    without selection."""
    break_score: PositiveFloat = 100.0
    """Least evidence of such a sequence."""
    sequence_agreement: NonNegativeFloat = 0.0
    """Largest difference between a whole sequence and the odometry, beside `agreement`, as a share of the
    distance; 0: compared only from one candidate to the next."""
    select_every: NonNegativeInt = 0
    """Keyframes after which all sequences, accepted or not, are selected anew against each other (see
    `ratslam.mapping.closure_selection`); 0: never, an accepted sequence stays. The result is taken up 10
    keyframes later, or at the next selection if that is earlier."""
    select_score: PositiveFloat = 12.0
    """Least evidence of the sequences to select from; one of them has at least `min_score`."""
    select_length: PositiveInt = 4
    """Least number of candidates of the sequences to select from."""
    sequence_cost: PositiveFloat = 6.0
    """Evidence that a sequence to select from needs before it may strain the map."""
    closure_cost_limit: PositiveFloat = 6.0
    """Largest chi-square of a single closure in the selection."""
    merge_stood: NonNegativeInt = 4
    """Number of selections in a row that a sequence must stand before the keyframes it confirms are merged
    with older ones at the same pose; without selections, that it must stand accepted, every 50 keyframes.
    0, and with `select_every` of 1 to 10: keyframes are not merged."""
    merge_newest: PositiveInt = 1000
    """Number of newest keyframes that are not merged."""
    solve_every: PositiveInt = 20
    """Most keyframes between two optimisations while a sequence goes on."""
    solve_strayed: PositiveFloat = 0.1
    """Sum of the corrections of the newest keyframe by closures, in their standard deviations, after which
    the map is optimised earlier: a closure that fits changes nothing. With `select_every` never earlier, as
    selections optimise it too."""
    iterations: PositiveInt = 4
    """Solver iterations when a loop closes."""
    settling: PositiveInt = 15
    """Solver iterations for the final map."""
    max_turn: PositiveFloat = 10.0
    """Share of `agreement_heading` by which a robot may be turned and still be in a known experience."""
    place_radius: PositiveFloat = 2.0
    """Radius of an experience, cells."""
    place_heading: PositiveFloat = 0.35
    """Largest difference in heading within an experience, rad."""


class Ablation(Settings):
    """Parts of the keyframe map that a study can turn off, to measure its contribution."""

    verify: bool = True
    """Whether closure sequences are tested against the map's covariance before they count."""
    robust: bool = True
    """Whether sequences that disagree with the map lose weight."""
    heading_bias: bool = True
    """Whether the map solves for the heading bias."""


FULL = Ablation()
"""Nothing turned off."""
