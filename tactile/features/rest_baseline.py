"""The baseline of whisking whiskers, followed from cycle to cycle.

At the beginning of a cycle a whisker is at rest, before its protraction touches anything. These samples show
how far the baseline has drifted since the calibration.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from tactile.base.settings import Settings
from tactile.base.types import Cycle
from tactile.features.calibration import Calibration


class RestBaselineConfig(Settings):
    """Tracking of the baseline between whisk cycles."""

    rest_time: PositiveFloat = 0.02
    """Time from the beginning of a cycle in which a whisker is at rest, s."""
    gain: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Share of the way to its level at rest that the baseline goes in a cycle. Below 1 the noise of the rest
    is averaged over cycles, but the baseline lags behind a drift."""
    free_sds: PositiveFloat = 6.0
    """A whisker further than this from its baseline at rest touches something, or is bent, and its baseline
    stands still; in standard deviations of the free deflection. The distance grows with the root of the
    cycles since the whisker was last free, as a random walk does."""
    bent_cycles: PositiveInt = 40
    """A whisker that is away from its baseline at rest for this many cycles on end counts as bent: it has no
    signal until it returns, and the distance grows no more."""


class RestBaseline(NamedTuple):
    """Baselines of W whiskers.

    Attributes:
        offset: [W, 2] drift since the calibration, rad. away: [W] cycles on end away from the baseline.
    """

    offset: np.ndarray
    away: np.ndarray


def start_baseline(whiskers: int) -> RestBaseline:
    """Baselines as calibrated."""
    return RestBaseline(np.zeros((whiskers, 2)), np.zeros(whiskers, int))


def follow_baseline(
    config: RestBaselineConfig, calibration: Calibration, baseline: RestBaseline, cycle: Cycle
) -> RestBaseline:
    """The baselines after the rest at the beginning of a cycle; whiskers with NaN samples keep theirs.

    A cycle without samples changes nothing.
    """
    count = round(config.rest_time * calibration.rate)
    if not len(cycle.time) or not count:
        return baseline
    rest = cycle.deflection[:count].mean(axis=0) - calibration.mean - baseline.offset
    known = calibration.alive & np.isfinite(rest).all(axis=-1)
    wandering = np.sqrt(1.0 + np.minimum(baseline.away, config.bent_cycles))
    free = known & (np.abs(rest) <= config.free_sds * wandering[:, None] * calibration.sd).all(axis=-1)
    return RestBaseline(
        offset=baseline.offset + np.where(free[:, None], config.gain * rest, 0.0),
        away=np.where(known, np.where(free, 0, baseline.away + 1), baseline.away),
    )


def bent_whiskers(config: RestBaselineConfig, baseline: RestBaseline) -> np.ndarray:
    """[W] bool, whiskers that stayed away from their baselines."""
    return baseline.away >= config.bent_cycles
