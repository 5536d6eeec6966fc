"""What the raw tiers know of drives, whiskers and sensors beyond `MechanicsConfig`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from scipy.linalg import eigh

from tactile.base.config import Settings
from tactile.features.contact import ShaftConfig

SHAFT_SHARES = np.linspace(0.0, 1.0, 401)
"""Shares of a whisker's length at which it is integrated."""
LOAD_SHARES = (1.0, 0.65)
"""Shares at which the two shapes are loaded: the tip, and where walls push most. Between them stiffness is
off by 6 % at most and the moment at the base by 10 %."""


class BeamConfig(Settings):
    """A whisker as a tapered beam. None of it is in the paper: a printed (ABS) whisker of the same lab."""

    shaft: ShaftConfig = ShaftConfig()
    """Its taper, and where along it the sensor's angle is true."""
    radius: PositiveFloat = 0.75e-3
    """At the base, m."""
    modulus: PositiveFloat = 2.3e9
    """Of elasticity, Pa."""
    density: PositiveFloat = 1040.0
    """kg/m^3"""
    damping: NonNegativeFloat = 0.1
    """Of the first bending mode, as a share of critical; that of the second grows with its frequency."""
    friction: NonNegativeFloat = 0.3
    """Of a whisker on a wall (Coulomb): the lateral force it can take before it slides."""


class ServoConfig(Settings):
    """A drive as a spring and damper on a rotor; its stiffness is `MechanicsConfig.servo`."""

    frequency: PositiveFloat = 15.0
    """Of the drive without a whisker, Hz."""
    damping: PositiveFloat = 1.0
    """As a share of critical, whisker included."""


class StreamConfig(Settings):
    """The raw stream of a simulated head."""

    rate: PositiveFloat = 2000.0
    """Samples per second (Salman & Pearson 2016, III-C)."""
    full_scale: PositiveFloat = 1.5
    """Deflection at which the sensors saturate, rad."""
    poses: PositiveInt = 16
    """Of the head along a cycle, at which walls are looked for."""
    batch: PositiveInt = 16
    """Cycles simulated side by side; only speed depends on it."""
    beam: BeamConfig = BeamConfig()
    servo: ServoConfig = ServoConfig()


class Beam(NamedTuple):
    """A whisker of unit length, flexural rigidity and mass per length at its base, as two shapes: how two
    loads bend it. Statics are exact under these loads, and the shapes hold the two slowest bending modes.

    Attributes:
        shapes: [2, S] deflection at `SHAFT_SHARES` per unit load. stiffness, mass: [2, 2] of the loads.
        coupled: [2] inertia shared with turning. inertia: of the straight whisker about its base.
        moment: [2] at the base per unit load. unit: stiffness of turning against a push at the reference.
    """

    shapes: np.ndarray
    stiffness: np.ndarray
    mass: np.ndarray
    coupled: np.ndarray
    inertia: float
    moment: np.ndarray
    unit: float

    def at(self, reach: np.ndarray) -> np.ndarray:
        """[2, ...] the two shapes at shares of the length."""
        return np.stack([np.interp(reach, SHAFT_SHARES, shape) for shape in self.shapes])

    @property
    def modes(self) -> np.ndarray:
        """[2] angular frequencies of bending with the base held."""
        return np.sqrt(eigh(self.stiffness, self.mass, eigvals_only=True))


def make_beam(config: ShaftConfig) -> Beam:
    """The two-shape model of a tapered whisker."""
    loads = np.array(LOAD_SHARES)
    thick = 1 - (1 - config.taper) * SHAFT_SHARES
    bent = np.maximum(loads[:, None] - SHAFT_SHARES, 0.0) / thick**4
    shapes = _summed(_summed(bent))
    line = thick**2
    return Beam(
        shapes=shapes,
        stiffness=_inner(bent * thick**4, bent),
        mass=_inner(line * shapes, shapes),
        coupled=_summed(line * SHAFT_SHARES * shapes)[:, -1],
        inertia=float(_summed(line * SHAFT_SHARES**2)[-1]),
        moment=loads,
        unit=3 * (1 / config.reference - (1 - config.taper)),
    )


def beam_time_unit(config: BeamConfig, length: float) -> float:
    """The unit of time of a unit beam, s."""
    return float(length**2 * 2 / config.radius * np.sqrt(config.density / config.modulus))


def _summed(value: np.ndarray) -> np.ndarray:
    """Running integral along the whisker (trapezoids)."""
    steps = (value[..., 1:] + value[..., :-1]) / 2 * np.diff(SHAFT_SHARES)
    return np.concatenate([np.zeros((*value.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)


def _inner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return _summed(a[:, None] * b[None])[..., -1]
