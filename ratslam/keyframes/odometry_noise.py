"""The heading noise of the odometry, learned from the loop closures of the map.

The noise is a factor on the variance of every turn. Its evidence is the probability of odometry and closures
with the poses integrated out, to second order around the map (Laplace; MacKay 1992). A factor too small
makes the closures costly, one too large wastes the odometry. The factor has a log-normal prior, and moves by
at most `LARGEST_STEP` at a time, because the map changes with it. It does not fall below `LEAST_FACTOR`:
closures are accepted for agreeing with odometry, so odometry that is believed too much refuses true ones and
looks good."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.keyframes.optimizer import MapFit, MapProblem, System

SPREAD = 1.0
"""Standard deviation of the log of the factor before any closure."""
LARGEST_STEP = float(np.log(2.0))
"""Largest change of the log of the factor; also the distance between the factors compared."""
LEAST_FACTOR = 0.5
"""Least factor, of the noise that the map starts from."""
STEPS = 2
"""Solver iterations at each factor compared."""


class HeadingNoise(NamedTuple):
    """Log of the factor on the variance of the odometry's turns, and its standard deviation."""

    log_factor: float = 0.0
    sd: float = SPREAD

    @property
    def factor(self) -> float:
        """On the variance."""
        return float(np.exp(self.log_factor))

    @property
    def further_factor(self) -> float:
        """On the variance of a further session or piece, beside `factor`. A map learns the noise of its own
        session, and little of it from few loop closures: that of others is not taken to be less than the
        settings say."""
        return 1 / min(self.factor, 1.0)


def learn_heading_noise(
    noise: HeadingNoise, start: HeadingNoise, fit: MapFit, problem: MapProblem
) -> HeadingNoise:
    """The noise after one more map.

    Args:
        noise: with which `problem` was made. start: that of the first map. fit: that solves the problem.
    """
    least = start.log_factor + float(np.log(LEAST_FACTOR))
    steps = np.array([-LARGEST_STEP, 0.0, LARGEST_STEP])
    off = noise.log_factor - start.log_factor
    system = System(problem)
    changed = [system.with_problem(problem.with_heading_noise(float(np.exp(step)))) for step in steps]
    logs = np.array(
        [log_posterior(off + step, at.solve(fit, STEPS), at) for step, at in zip(steps, changed, strict=True)]
    )
    if not np.isfinite(logs).all():
        return noise
    slope = (logs[2] - logs[0]) / (2 * LARGEST_STEP)
    bend = (logs[0] - 2 * logs[1] + logs[2]) / LARGEST_STEP**2
    curved = bend < 0  # else there is no maximum near by
    step = -slope / bend if curved else np.sign(slope) * LARGEST_STEP
    moved = noise.log_factor + float(np.clip(step, -LARGEST_STEP, LARGEST_STEP))
    return HeadingNoise(max(moved, least), float(1 / np.sqrt(-bend)) if curved else SPREAD)


def log_posterior(off: float, fit: MapFit, system: System) -> float:
    """Log probability of the noise of `system`, and of odometry and closures with it, up to a constant.

    Args:
        off: log of the noise less that of the first map. fit: that solves the system.
    """
    return -0.5 * (off / SPREAD) ** 2 + system.log_evidence(fit)
