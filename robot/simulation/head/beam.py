"""Whiskers as tapered beams, and settings of the raw fidelities beyond `MechanicsConfig`."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.base.settings import Settings
from tactile.contact_threshold import ShaftConfig

SHAFT_SHARES = np.linspace(0.0, 1.0, 401)
"""Positions along a whisker for integration, as fractions of its length."""
LOAD_SHARES = (1.0, 0.65)
"""Load positions of the two shapes: the tip, and the most frequent contact position. In between, stiffness
errs by at most 6 % and the base moment by 10 %."""


class BeamConfig(Settings):
    """A whisker as a tapered beam: a printed (ABS) whisker of the same lab; the paper gives no values."""

    shaft: ShaftConfig = ShaftConfig()
    """Taper, and the load position at which the sensor reads the true angle."""
    radius: PositiveFloat = 0.75e-3
    """Radius at the base, m."""
    modulus: PositiveFloat = 2.3e9
    """Young's modulus, Pa."""
    density: PositiveFloat = 1040.0
    """Density, kg/m^3."""
    damping: NonNegativeFloat = 0.1
    """Damping ratio of the first bending mode; that of the second is proportional to its frequency."""
    friction: NonNegativeFloat = 0.3
    """Coulomb friction coefficient of a whisker on a wall."""


class ServoConfig(Settings):
    """A drive as a spring and damper on a rotor; its stiffness is `MechanicsConfig.servo`."""

    frequency: PositiveFloat = 15.0
    """Natural frequency of the drive without a whisker, Hz."""
    damping: PositiveFloat = 1.0
    """Damping ratio, whisker included."""


class StreamConfig(Settings):
    """Raw samples of a simulated head."""

    rate: PositiveFloat = 2000.0
    """Samples per second (Salman & Pearson 2016, III-C)."""
    full_scale: PositiveFloat = 1.5
    """Deflection at which the sensors saturate, rad."""
    poses: Annotated[int, Field(ge=1, le=1024)] = 16
    """Number of head poses per cycle at which contacts with walls are computed."""
    batch: Annotated[int, Field(ge=1, le=1024)] = 16
    """Number of cycles simulated in parallel; affects only speed."""
    beam: BeamConfig = BeamConfig()
    servo: ServoConfig = ServoConfig()


class Beam(NamedTuple):
    """A whisker of unit length, unit flexural rigidity and unit mass per length at its base, reduced to the
    two shapes into which two loads bend it. Statics are exact for these loads; the shapes span the two
    slowest modes.

    Attributes:
        shapes: [2, S] deflection at `SHAFT_SHARES` per unit load. stiffness, mass: [2, 2] of the loads.
        coupled: [2] inertia coupled with rotation. inertia: of the straight whisker about its base.
        moment: [2] base moment per unit load. unit: rotational stiffness for a push at the reference.
    """

    shapes: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray
    coupled: np.ndarray
    inertia: float
    moment: np.ndarray
    unit: float

    def at(self, reach: np.ndarray) -> np.ndarray:
        """The two shapes [2, ...] at fractions of the length."""
        return np.stack([np.interp(reach, SHAFT_SHARES, shape) for shape in self.shapes])

    @property
    def modes(self) -> np.ndarray:
        """Angular frequencies [2] of the bending modes with a clamped base."""
        from scipy.linalg import eigh  # slow to import

        return np.sqrt(eigh(self.stiffness, self.mass, eigvals_only=True))


def make_beam(config: ShaftConfig) -> Beam:
    """The two-shape model of a tapered whisker."""
    loads = np.array(LOAD_SHARES)
    thick = 1 - (1 - config.taper) * SHAFT_SHARES
    bent = np.maximum(loads[:, None] - SHAFT_SHARES, 0.0) / thick**4
    shapes = _integrate(_integrate(bent))
    line = thick**2
    return Beam(
        shapes=shapes,
        stiffness=_integrate((bent * thick**4)[:, None] * bent)[..., -1],
        mass=_integrate((line * shapes)[:, None] * shapes)[..., -1],
        coupled=_integrate(line * SHAFT_SHARES * shapes)[:, -1],
        inertia=float(_integrate(line * SHAFT_SHARES**2)[-1]),
        moment=loads,
        unit=3 * (1 / config.reference - (1 - config.taper)),
    )


def _integrate(value: np.ndarray) -> np.ndarray:
    """Cumulative integral along the whisker (trapezoidal rule)."""
    steps = (value[..., 1:] + value[..., :-1]) / 2 * np.diff(SHAFT_SHARES)
    return np.concatenate([np.zeros((*value.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)
