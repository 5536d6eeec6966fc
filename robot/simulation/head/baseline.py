"""Coloured noise, baseline drift, creep and the Earth's field in deflections: what magnetic whiskers show
beyond white noise.

Each goes on from whisk to whisk, through the free record and the session after it, and draws from a random
stream of its own; how the samples are cut into blocks makes no difference. The drives' feedback reads the
coloured noise but neither drift nor creep, as if it took its zero at the start of each whisk, when whiskers
are at rest: within a whisk both stay small against its threshold of 20 standard deviations.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.base.random_streams import stream
from tactile.base.settings import Settings


class BaselineConfig(Settings):
    """Departures of the deflections from white noise about zero; 0 is none. `HALL_BASELINE` has values fitted
    to real whiskers."""

    colour: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share of the variance of the sensor noise that is first-order autoregressive; the rest is white, the
    standard deviation stays `mechanics.noise`."""
    colour_time: PositiveFloat = 0.005
    """Time in which its correlation falls to 1/e, s."""
    drift: NonNegativeFloat = 0.0
    """Random walk of each deflection: its standard deviation after 1 s, in multiples of `mechanics.noise`; it
    grows with the square root of time and has no bound but the sensors' full scale."""
    creep: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of a lasting deflection by which a whisker stays bent after it."""
    creep_time: PositiveFloat = 0.6
    """Time in which it bends and relaxes to 1/e, s."""

    field: NonNegativeFloat = 0.0
    """Amplitude of the Earth's field in each deflection, in multiples of `mechanics.noise`: a cos + b sin of
    the heading, in a phase of its own. Its horizontal part is 15 to 35 uT, and a Hall sensor's noise about 1
    to 5 uT, so a sensor without a shield shows 3 to 35."""

    @property
    def is_on(self) -> bool:
        """Whether there is colour, drift, creep or a field."""
        return bool(self.colour or self.drift or self.creep or self.field)


HALL_BASELINE = BaselineConfig(colour=1.0, colour_time=0.005, drift=1.5, creep=0.03, creep_time=0.6)
"""Fitted to magnetic (Hall) whiskers that an arm pushes through clutter (arXiv 2406.06038): colour and drift
to the free whiskers left 4 and 5, creep to left 0, 1 and 3. Others agree: left 6 and 7 (5 ms, drift 1.7),
right 0, 1 and 2 (creep 0.02). A whisker read by a camera shows neither colour nor drift (0.2). See
`evaluation/papers/whiskers/drift.py`."""


class Baseline:
    """Coloured noise, drift and creep of W whiskers, from one sample to the next.

    Arrays have two leading axes, successive parts N of T samples.

    Args:
        noise: standard deviation of the sensor noise, rad. rate: samples per second. seed: of the session.
    """

    def __init__(self, config: BaselineConfig, noise: float, rate: float, whiskers: int, seed: int) -> None:
        from scipy.signal import lfilter  # slow: not in the first block of an emulator

        self._filter = lfilter
        self._colours, self._steps = stream(seed, "colour"), stream(seed, "drift")
        self._white, self._coloured = np.sqrt(1 - config.colour), noise * np.sqrt(config.colour)
        self._step = noise * config.drift / np.sqrt(rate)
        self._keep = float(np.exp(-1 / (rate * config.colour_time)))
        self._relax = float(np.exp(-1 / (rate * config.creep_time)))
        self._gain = config.creep * (1 - self._relax)
        self._colour = self._keep * self._colours.standard_normal((1, whiskers, 2))
        self._drift, self._creep = np.zeros((1, whiskers, 2)), np.zeros((1, whiskers, 2))
        self._field = noise * config.field
        self._phase = 2 * np.pi * stream(seed, "field").random((whiskers, 2))

    def colour(self, white: np.ndarray) -> np.ndarray:
        """The noise of the next samples [N, T, W, 2], rad, of which white noise, rad, is a part."""
        kicks = np.sqrt(1 - self._keep**2) * self._colours.standard_normal(white.shape)
        colour, self._colour = self._recur(self._keep, kicks, self._colour)
        return self._white * white + self._coloured * colour

    def wander(self, deflection: np.ndarray, heading: np.ndarray | None = None) -> np.ndarray:
        """Drift, creep and field of the next samples [N, T, W, 2], rad, for the deflections without them
        and the headings [N, T] of the head (None: it does not turn), rad.

        The creep is that of a standard linear solid: it tends to its share of the deflection.
        """
        steps = self._step * self._steps.standard_normal(deflection.shape)
        drift, self._drift = self._recur(1.0, steps, self._drift)
        creep, self._creep = self._recur(self._relax, self._gain * deflection, self._creep)
        if heading is None or not self._field:
            return drift + creep
        return drift + creep + self._field * np.cos(heading[..., None, None] + self._phase)

    def _recur(self, keep: float, value: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The recursion y = value + keep * last y over the samples of [N, T, W, 2].

        Args:
            before: [1, W, 2] keep * y of the sample before.

        Returns:
            y, and `before` of the next samples.
        """
        flat = value.reshape(-1, *value.shape[2:])
        found, after = self._filter([1.0], [1.0, -keep], flat, axis=0, zi=before)
        return found.reshape(value.shape), after


def make_baseline(
    config: BaselineConfig, noise: float, rate: float, whiskers: int, seed: int
) -> Baseline | None:
    """The baseline of a head at the start of its record; None if it is off."""
    return Baseline(config, noise, rate, whiskers, seed) if config.is_on else None
