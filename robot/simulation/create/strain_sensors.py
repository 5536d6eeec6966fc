"""Fixed whiskers of the Create and what their sensors read (Fox et al. 2012, II-A).

Each whisker has two channels: horizontal strain at its base, from bending
(`robot.simulation.create.whisker_bending`), its sign telling
the side; and vertical strain. A wall moved against level whiskers would not bend them up or down, but they
droop a little, so what pushes along the shaft bends them down, and sensor axes are never quite level, so some
of the horizontal strain shows there too. Sensors add noise, and the body shakes: as it starts moving and,
less, for as long as it does. That is why the paper filters at 17 Hz.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, model_validator
from scipy.signal import lfilter

from robot.simulation.create.whisker_bending import Bending, Shaft, base_strain, bend_shafts
from tactile.base.config import Settings
from tactile.whiskers.head_geometry import Degrees

MAX_LEAN = np.radians(75.0)
"""Lean up to which a push along the shaft is passed on; beyond, a whisker buckles instead."""


class MountConfig(Settings):
    """Where a whisker is fixed, in base_link."""

    x: float
    """Of its base, m ahead."""
    y: float
    """m to the left."""
    direction_deg: Degrees
    """In which it points, counter-clockwise from ahead."""


class ShakeConfig(Settings):
    """Vibration of the body on its wheels, the same for all whiskers."""

    frequency: PositiveFloat = 28.0
    """Hz"""
    decay: PositiveFloat = 0.12
    """Time in which it falls to 1/e, s."""
    start: NonNegativeFloat = 4e-5
    """Standard deviation of its amplitude as a motion starts, strain."""
    rumble: NonNegativeFloat = 8e-6
    """Standard deviation of what the wheels keep up, strain."""


class WhiskersConfig(Settings):
    """Four whiskers, tapered linearly. Lengths and diameters are the paper's; what it leaves open are these
    defaults."""

    mounts: Annotated[tuple[MountConfig, ...], Field(min_length=1)] = (
        MountConfig(x=0.10, y=0.08, direction_deg=50.0),
        MountConfig(x=0.13, y=0.03, direction_deg=15.0),
        MountConfig(x=0.13, y=-0.03, direction_deg=-15.0),
        MountConfig(x=0.10, y=-0.08, direction_deg=-50.0),
    )
    """From left to right."""
    length: PositiveFloat = 0.14
    """m"""
    base_diameter: PositiveFloat = 1.45e-3
    """m"""
    tip_diameter: PositiveFloat = 0.3e-3
    """m"""
    droop_deg: Annotated[float, Field(ge=0, lt=45)] = 10.0
    """Of a whisker below the level of its base."""
    friction: NonNegativeFloat = 0.2
    """Of whiskers on walls."""
    crosstalk: float = 0.08
    """Share of the horizontal strain that shows in the vertical channel."""
    noise: NonNegativeFloat = 3e-6
    """Standard deviation of a sample, strain."""
    shake: ShakeConfig = ShakeConfig()
    """Of the body."""
    rate: PositiveFloat = 2000.0
    """Samples per second."""
    dead: tuple[NonNegativeInt, ...] = ()
    """Whiskers that do not report, by number, from 0."""

    @model_validator(mode="after")
    def _sound(self) -> Self:
        if any(whisker >= len(self.mounts) for whisker in self.dead):
            raise ValueError(
                f"dead whiskers {list(self.dead)}: there are whiskers 0 to {len(self.mounts) - 1}"
            )
        if self.tip_diameter > self.base_diameter:
            raise ValueError("tip_diameter larger than base_diameter: a whisker tapers towards its tip")
        return self


class FixedWhiskers(NamedTuple):
    """Whiskers fixed to a body.

    Attributes:
        base: [W, 2] m. direction: [W] rad, both in base_link. shaft: of each. alive: [W] bool.
    """

    base: np.ndarray
    direction: np.ndarray
    shaft: Shaft
    alive: np.ndarray

    @property
    def reach(self) -> float:
        """How far from the middle of the body anything can be touched, m."""
        return float(np.hypot(self.base[:, 0], self.base[:, 1]).max()) + self.shaft.length

    @property
    def tip(self) -> np.ndarray:
        """[W, 2] m in base_link, of straight whiskers."""
        way = np.stack([np.cos(self.direction), np.sin(self.direction)], axis=1)
        return self.base + self.shaft.length * way


def fixed_whiskers(config: WhiskersConfig) -> FixedWhiskers:
    """The whiskers of a configuration."""
    base = np.array([[mount.x, mount.y] for mount in config.mounts])
    direction = np.radians([mount.direction_deg for mount in config.mounts])
    taper = (1 - config.tip_diameter / config.base_diameter) / config.length
    alive = np.ones(len(base), bool)
    alive[list(config.dead)] = False
    return FixedWhiskers(base, direction, Shaft(config.length, config.base_diameter / 2, taper), alive)


def bend_whiskers(fan: FixedWhiskers, pose: np.ndarray, segments: np.ndarray, side: np.ndarray) -> Bending:
    """How whiskers are bent at poses [T, 3], in order of time, among walls [S, 4]; `side` as in `bent`."""
    c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    x, y = fan.base.T
    base = np.stack([pose[:, :1] + c * x - s * y, pose[:, 1:2] + s * x + c * y], axis=-1)
    return bend_shafts(fan.shaft, base, pose[:, 2:] + fan.direction, segments, side)


def base_strains(config: WhiskersConfig, fan: FixedWhiskers, bent: Bending) -> np.ndarray:
    """[T, W, 2] the strain of bent whiskers, horizontal and vertical, without noise."""
    across = base_strain(fan.shaft, bent.turn, bent.reach)
    # Of a push, what goes along the shaft has the droop for its lever, what goes across the shaft itself.
    along = np.tan(np.minimum(bent.lean + np.arctan(config.friction), MAX_LEAN))
    down = np.tan(np.radians(config.droop_deg)) * np.abs(across) * along
    return np.stack([across, config.crosstalk * across - down], axis=-1) * fan.alive[:, None]


def body_vibration(config: ShakeConfig, count: int, rate: float, random: np.random.Generator) -> np.ndarray:
    """[T, 2] strain that the body's vibration adds from the start of a motion on: as it sways and as it
    nods."""
    time = np.arange(count) / rate
    damped = np.exp(-time / config.decay)
    amplitude, phase = config.start * random.standard_normal(2), random.uniform(0, 2 * np.pi, 2)
    ringing = amplitude * damped[:, None] * np.sin(2 * np.pi * config.frequency * time[:, None] + phase)
    pole = np.exp((-1 / config.decay + 2j * np.pi * config.frequency) / rate)
    back = [1.0, -2 * pole.real, abs(pole) ** 2]
    lead = int(5 * config.decay * rate)  # by then it has forgotten how it began
    rumble = lfilter([1.0], back, random.standard_normal((lead + count, 2)), axis=0)[lead:]
    return ringing + config.rumble / _gain(back) * rumble


def _gain(back: list[float]) -> float:
    """Standard deviation of a second-order resonance driven by unit noise."""
    _, a, b = back
    return float(np.sqrt((1 + b) / ((1 - b) * ((1 + b) ** 2 - a**2))))


def sample_strain(
    config: WhiskersConfig, strain: np.ndarray, alive: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """[T, W, 2] what sensors read of strain [T, W, 2], sampled at the sensors' rate from the start of a
    motion on."""
    shake = body_vibration(config.shake, len(strain), config.rate, random)
    read = strain + shake[:, None] + config.noise * random.standard_normal(strain.shape)
    return np.where(alive[:, None], read, 0.0)


def monitor_strain(
    config: WhiskersConfig, strain: np.ndarray, alive: np.ndarray, period: float, random: np.random.Generator
) -> np.ndarray:
    """[T, W, 2] what a monitor knows of strain [T, W, 2]: means over a period (s) before each row. The body's
    vibration is filtered out of it."""
    noise = config.noise / np.sqrt(max(config.rate * period, 1.0))
    return np.where(alive[:, None], strain + noise * random.standard_normal(strain.shape), 0.0)
