"""Fixed whiskers of the Create and the readings of their strain sensors (Fox et al. 2012, II-A).

Each whisker has two channels: the horizontal strain at its base from bending (see `whisker_bending`), whose
sign gives the side, and the vertical strain. Whiskers droop a little, so a force along the shaft bends them
down; sensor axes are not exactly level, so part of the horizontal strain appears in the vertical channel.
Sensors add noise, and the body vibrates at the start of a motion and, less, throughout it: the paper
therefore filters at 17 Hz.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, model_validator

from robot.simulation.create.whisker_bending import Bending, Shaft, base_strain, bend_shafts
from tactile.base.settings import Settings
from tactile.whiskers.head_geometry import Degrees

MAX_LEAN = np.radians(75.0)
"""Largest lean at which a force along the shaft is transmitted; beyond it a whisker buckles."""


class MountConfig(Settings):
    """Mounting of a whisker in base_link."""

    x: float
    """Position of the base ahead, m."""
    y: float
    """Position of the base to the left, m."""
    direction_deg: Degrees
    """Direction, degrees counter-clockwise from ahead."""


class ShakeConfig(Settings):
    """Vibration of the body on its wheels, the same for all whiskers."""

    frequency: PositiveFloat = 28.0
    """Frequency, Hz."""
    decay: PositiveFloat = 0.12
    """Decay time to 1/e, s."""
    start: NonNegativeFloat = 4e-5
    """Standard deviation of its amplitude at the start of a motion, strain."""
    rumble: NonNegativeFloat = 8e-6
    """Standard deviation of the continuous vibration by the wheels, strain."""


class WhiskersConfig(Settings):
    """Four whiskers, tapered linearly. Lengths and diameters are from the paper, other defaults
    are ours."""

    mounts: Annotated[tuple[MountConfig, ...], Field(min_length=1)] = (
        MountConfig(x=0.10, y=0.08, direction_deg=50.0),
        MountConfig(x=0.13, y=0.03, direction_deg=15.0),
        MountConfig(x=0.13, y=-0.03, direction_deg=-15.0),
        MountConfig(x=0.10, y=-0.08, direction_deg=-50.0),
    )
    """From left to right."""
    length: PositiveFloat = 0.14
    """Length of a whisker, m."""
    base_diameter: PositiveFloat = 1.45e-3
    """Diameter at the base, m."""
    tip_diameter: PositiveFloat = 0.3e-3
    """Diameter at the tip, m."""
    droop_deg: Annotated[float, Field(ge=0, lt=45)] = 10.0
    """Angle of a whisker below the level of its base, degrees."""
    friction: NonNegativeFloat = 0.2
    """Friction coefficient of whiskers on walls."""
    crosstalk: float = 0.08
    """Fraction of the horizontal strain in the vertical channel."""
    noise: NonNegativeFloat = 3e-6
    """Standard deviation of the noise of a sample, strain."""
    shake: ShakeConfig = ShakeConfig()
    """Vibration of the body."""
    rate: PositiveFloat = 2000.0
    """Samples per second."""
    dead: tuple[NonNegativeInt, ...] = ()
    """Numbers of dead whiskers, from 0."""

    @model_validator(mode="after")
    def _sound(self) -> Self:
        if any(whisker >= len(self.mounts) for whisker in self.dead):
            last = len(self.mounts) - 1
            raise ValueError(f"dead whiskers {list(self.dead)}: the robot has whiskers 0 to {last}")
        if self.tip_diameter > self.base_diameter:
            raise ValueError("tip_diameter larger than base_diameter: a whisker tapers towards its tip")
        return self


class FixedWhiskers(NamedTuple):
    """Whiskers fixed to the body.

    Attributes:
        base: [W, 2] m and direction: [W] rad in base_link. shaft: of all whiskers. alive: [W] bool.
    """

    base: np.ndarray
    direction: np.ndarray
    shaft: Shaft
    alive: np.ndarray

    @property
    def reach(self) -> float:
        """Largest distance of a contact from the centre of the body, m."""
        return float(np.hypot(self.base[:, 0], self.base[:, 1]).max()) + self.shaft.length

    @property
    def tip(self) -> np.ndarray:
        """Tips [W, 2] of straight whiskers in base_link, m."""
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
    """Bending of whiskers at poses [T, 3] in order of time among walls [S, 4]; `side` as in `bend_shafts`."""
    c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    x, y = fan.base.T
    base = np.stack([pose[:, :1] + c * x - s * y, pose[:, 1:2] + s * x + c * y], axis=-1)
    return bend_shafts(fan.shaft, base, pose[:, 2:] + fan.direction, segments, side)


def base_strains(config: WhiskersConfig, fan: FixedWhiskers, bent: Bending) -> np.ndarray:
    """Horizontal and vertical strain [T, W, 2] of bent whiskers, without noise."""
    across = base_strain(fan.shaft, bent.turn, bent.reach)
    # The force along the shaft bends it by the lever of its droop, the force across it by its length.
    along = np.tan(np.minimum(bent.lean + np.arctan(config.friction), MAX_LEAN))
    down = np.tan(np.radians(config.droop_deg)) * np.abs(across) * along
    return np.stack([across, config.crosstalk * across - down], axis=-1) * fan.alive[:, None]


def body_vibration(config: ShakeConfig, count: int, rate: float, random: np.random.Generator) -> np.ndarray:
    """Horizontal and vertical strain [T, 2] from vibration of the body, from the start of a motion."""
    from scipy.signal import lfilter  # slow to import

    amplitude, phase = _draw_ringing(config, random)
    ringing = _ringing(config, amplitude, phase, np.arange(count) / rate)
    back = _resonance(config, rate)
    lead = int(5 * config.decay * rate)  # until the transient has decayed
    rumble = lfilter([1.0], back, random.standard_normal((lead + count, 2)), axis=0)[lead:]
    return ringing + config.rumble / _gain(back) * rumble


class BodyVibration:
    """`body_vibration` of a robot that starts, rolls and stops, block by block."""

    def __init__(self, config: ShakeConfig, rate: float, random: np.random.Generator) -> None:
        self._config, self._rate, self._random = config, rate, random
        self._back = _resonance(config, rate)
        self._state = np.zeros((2, 2))
        self._since = 0  # samples since the last start
        self._amplitude = self._phase = np.zeros(2)

    def advance(self, count: int, *, rolls: bool, starts: bool) -> np.ndarray:
        """The next [T, 2] strains.

        Args:
            rolls: whether the wheels turn. starts: whether a motion has started.
        """
        from scipy.signal import lfilter  # slow to import

        if starts:
            self._since = 0
            self._amplitude, self._phase = _draw_ringing(self._config, self._random)
        time = (self._since + np.arange(count)) / self._rate
        self._since += count
        drive = self._random.standard_normal((count, 2)) * rolls
        rumble, self._state = lfilter([1.0], self._back, drive, axis=0, zi=self._state)
        ringing = _ringing(self._config, self._amplitude, self._phase, time)
        return ringing + self._config.rumble / _gain(self._back) * rumble


def _draw_ringing(config: ShakeConfig, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude and phase [2] of the vibration at the start of a motion."""
    return config.start * random.standard_normal(2), random.uniform(0, 2 * np.pi, 2)


def _ringing(config: ShakeConfig, amplitude: np.ndarray, phase: np.ndarray, time: np.ndarray) -> np.ndarray:
    damped = np.exp(-time / config.decay)
    return amplitude * damped[:, None] * np.sin(2 * np.pi * config.frequency * time[:, None] + phase)


def _resonance(config: ShakeConfig, rate: float) -> list[float]:
    """Recursive coefficients of the resonance at a sample rate, Hz."""
    pole = np.exp((-1 / config.decay + 2j * np.pi * config.frequency) / rate)
    return [1.0, -2 * pole.real, abs(pole) ** 2]


def _gain(back: list[float]) -> float:
    """Standard deviation of a second-order resonance driven by unit noise."""
    _, a, b = back
    return float(np.sqrt((1 + b) / ((1 - b) * ((1 + b) ** 2 - a**2))))


def sample_strain(
    config: WhiskersConfig, strain: np.ndarray, alive: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Sensor readings [T, W, 2] of strain [T, W, 2] at the sensor rate, from the start of a motion."""
    shake = body_vibration(config.shake, len(strain), config.rate, random)
    read = strain + shake[:, None] + config.noise * random.standard_normal(strain.shape)
    return np.where(alive[:, None], read, 0.0)


def monitor_strain(
    config: WhiskersConfig, strain: np.ndarray, alive: np.ndarray, period: float, random: np.random.Generator
) -> np.ndarray:
    """Monitored strain [T, W, 2]: means over a period (s) before each row, without vibration of the body."""
    noise = config.noise / np.sqrt(max(config.rate * period, 1.0))
    return np.where(alive[:, None], strain + noise * random.standard_normal(strain.shape), 0.0)
