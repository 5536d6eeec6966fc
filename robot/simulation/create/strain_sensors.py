"""Fixed whiskers of the Create and the readings of their strain sensors (Fox et al. 2012, II-A).

Each whisker has two channels: the horizontal strain at its base from bending (below), whose
sign gives the side, and the vertical strain. Whiskers droop a little, so a force along the shaft bends them
down; sensor axes are not exactly level, so part of the horizontal strain appears in the vertical channel.
Sensors add noise, and the body vibrates at the start of a motion and, less, throughout it: the paper
therefore filters at 17 Hz.

Static bending of a fixed, tapered whisker whose straight shaft would enter a wall, in closed form.

A whisker is rotated about its base by the smallest angle that frees it, and stays on that side while in
contact. The contact is its tip on a wall, a wall along its shaft, or the corner of an object. It springs
back as soon as the straight shaft would be free.

Beam theory for a cone, exact for small angles: radius r0 (1 - k x) at x along the shaft. A rotation of the
line from base to contact at a needs the base moment 3 E I (1 / a - k) times the angle, and the shaft there
is tilted by (3 - 2 k a) / (2 (1 - k a)) times the angle. Once the tip lies flat on the wall, the contact
moves towards the base. The shortening of the line by bending is neglected.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, model_validator

from tactile.base.settings import Settings
from tactile.whisker_geometry import Degrees

MAX_JOINED_WALLS = 4
"""Largest number of adjacent walls that can block a whisker."""
JOINED_ANGLE = 1e-9
"""Largest angle between adjacent walls, rad."""
BISECTIONS = 24
"""Bisection steps in the search of the contact position, accurate to 10 nm."""


class Bending(NamedTuple):
    """Bending of whiskers [T, W]; zero where free, with the length as reach.

    Attributes:
        turn: rotation of the line from base to contact, rad, counter-clockwise. reach: its length, m.
        lean: angle of the contact force against the perpendicular of that line, rad: its tangent is the
            ratio of the forces along and across the shaft. side: 1 counter-clockwise, -1 clockwise, 0 free.
    """

    turn: np.ndarray
    reach: np.ndarray
    lean: np.ndarray
    side: np.ndarray


def shaft_tilt(fan: FixedWhiskers, reach: np.ndarray) -> np.ndarray:
    """Ratio of the shaft's tilt at the contact to the rotation of the line from base to contact."""
    narrow = fan.taper * reach
    return (3 - 2 * narrow) / (2 * (1 - narrow))


class _Ends(NamedTuple):
    """One end of the range of angles in which a wall blocks a whisker: the angle, rad; the distance of the
    contact from the base, m; the distances of the nearest reachable point of the wall and of the wall's
    line, m."""

    angle: np.ndarray
    radius: np.ndarray
    near: np.ndarray
    away: np.ndarray


def _blocked_ends(
    fan: FixedWhiskers, base: np.ndarray, direction: np.ndarray, segments: np.ndarray
) -> tuple[_Ends, _Ends]:
    """Lower and upper ends [T, W, S] of the angles, relative to the straight shaft, that walls block. For a
    wall out of reach the lower end is above the upper one."""
    c, s = np.cos(direction)[..., None], np.sin(direction)[..., None]
    x, y = segments[:, 0] - base[..., :1], segments[:, 1] - base[..., 1:]
    u, v = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    x, y, u, v = c * x + s * y, c * y - s * x, c * u + s * v, c * v - s * u
    # The part of each wall within reach of the base.
    square, middle = u * u + v * v, -(x * u + y * v)
    inner = middle**2 - square * (x * x + y * y - fan.length**2)
    half = np.sqrt(np.maximum(inner, 0.0))
    first, last = np.maximum((middle - half) / square, 0.0), np.minimum((middle + half) / square, 1.0)
    there = (inner > 0) & (first < last)
    x1, y1, x2, y2 = x + first * u, y + first * v, x + last * u, y + last * v
    away = np.abs(x * v - y * u) / np.sqrt(square)
    start = np.arctan2(y1, x1)
    # Seen from the base a wall spans less than half a turn.
    span = np.arctan2(x1 * y2 - y1 * x2, x1 * x2 + y1 * y2)
    one, two = np.hypot(x1, y1), np.hypot(x2, y2)
    foot = middle / square
    near = np.where((first < foot) & (foot < last), away, np.minimum(one, two))
    up = span >= 0
    low = np.where(there, start + np.minimum(span, 0.0), np.inf)
    high = np.where(there, start + np.maximum(span, 0.0), -np.inf)
    return _Ends(low, np.where(up, one, two), near, away), _Ends(high, np.where(up, two, one), near, away)


def _free_ends(low: _Ends, high: _Ends) -> _Ends:
    """The end [K] at which blocked whiskers become free counter-clockwise, from ends [K, S]."""
    angle = np.zeros(len(low.angle))
    for _ in range(MAX_JOINED_WALLS):
        joined = low.angle <= angle[:, None] + JOINED_ANGLE
        angle = np.maximum(angle, np.where(joined, high.angle, 0.0).max(axis=1))
    # Of walls with the same end (a corner) the nearest one is the contact.
    last = np.abs(high.angle - angle[:, None]) <= JOINED_ANGLE
    which = np.argmin(np.where(last, high.radius, np.inf), axis=1)[:, None]
    radius, near, away = (np.take_along_axis(column, which, axis=1)[:, 0] for column in high[1:])
    return _Ends(angle, radius, near, away)


def _solve_contacts(fan: FixedWhiskers, end: _Ends) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation, reach and lean [K] of whiskers in contact at that end."""
    turn, reach = end.angle.copy(), end.radius.copy()
    tip = end.radius >= fan.length * (1 - 1e-9)
    away = np.minimum(end.away, reach * (1 - 1e-12))
    slant = np.arcsin(away / reach)  # angle between the line to the contact and the wall
    lean = np.where(tip, slant, (shaft_tilt(fan, reach) - 1) * turn)
    flat = np.flatnonzero(tip & ((shaft_tilt(fan, reach) - 1) * turn > slant))
    if len(flat):
        wall = turn[flat] + slant[flat]  # angle between the straight shaft and the wall
        near, far = end.near[flat], np.full(len(flat), fan.length)
        for _ in range(BISECTIONS):
            middle = (near + far) / 2
            slope = np.arcsin(np.minimum(away[flat] / middle, 1.0))
            beyond = (shaft_tilt(fan, middle) - 1) * (wall - slope) > slope
            near, far = np.where(beyond, near, middle), np.where(beyond, middle, far)
        reach[flat] = far
        turn[flat] = wall - np.arcsin(np.minimum(away[flat] / far, 1.0))
        lean[flat] = (shaft_tilt(fan, far) - 1) * turn[flat]
    return turn, reach, lean


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
    """Four whiskers, tapered linearly; the paper gives their lengths and diameters only."""

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
        base: [W, 2] m and direction: [W] rad in base_link. length: m, radius: at the base, m, and taper: k,
            1/m, of all whiskers. alive: [W] bool.
    """

    base: np.ndarray
    direction: np.ndarray
    length: float
    radius: float
    taper: float
    alive: np.ndarray

    @property
    def reach(self) -> float:
        """Largest distance of a contact from the centre of the body, m."""
        return float(np.hypot(self.base[:, 0], self.base[:, 1]).max()) + self.length

    @property
    def tip(self) -> np.ndarray:
        """Tips [W, 2] of straight whiskers in base_link, m."""
        way = np.stack([np.cos(self.direction), np.sin(self.direction)], axis=1)
        return self.base + self.length * way


def fixed_whiskers(config: WhiskersConfig) -> FixedWhiskers:
    """The whiskers of a configuration."""
    base = np.array([[mount.x, mount.y] for mount in config.mounts])
    direction = np.radians([mount.direction_deg for mount in config.mounts])
    taper = (1 - config.tip_diameter / config.base_diameter) / config.length
    alive = np.ones(len(base), bool)
    alive[list(config.dead)] = False
    return FixedWhiskers(base, direction, config.length, config.base_diameter / 2, taper, alive)


def bend_whiskers(fan: FixedWhiskers, pose: np.ndarray, segments: np.ndarray, side: np.ndarray) -> Bending:
    """Bending of whiskers among walls.

    Args:
        pose: [T, 3] of the body in order of time, m, m, rad. segments: [S, 4] m. side: [W] as in `Bending`,
            before the first row.
    """
    c, s = np.cos(pose[:, 2:]), np.sin(pose[:, 2:])
    x, y = fan.base.T
    base = np.stack([pose[:, :1] + c * x - s * y, pose[:, 1:2] + s * x + c * y], axis=-1)
    direction = pose[:, 2:] + fan.direction
    free, no_side = np.zeros(direction.shape), np.zeros(direction.shape, int)
    nothing = Bending(free, free + fan.length, free, no_side)
    if not len(segments):
        return nothing
    low, high = _blocked_ends(fan, base, direction, segments)
    blocked = np.any((low.angle < 0) & (high.angle > 0), axis=-1)
    if not blocked.any():
        return nothing
    row, whisker = np.nonzero(blocked)
    low, high = (_Ends(*(column[row, whisker] for column in ends)) for ends in (low, high))
    left = _free_ends(low, high)
    right = _free_ends(high._replace(angle=-high.angle), low._replace(angle=-low.angle))
    easier = no_side.copy()
    easier[row, whisker] = np.where(left.angle <= right.angle, 1, -1)
    # A whisker bends to the easier side at first contact, and to the same side as long as it is blocked.
    was = np.vstack([side != 0, blocked[:-1]])
    rows = np.arange(len(blocked))[:, None]
    onset = np.maximum.accumulate(np.where(blocked & ~was, rows, -1), axis=0)
    since = np.where(onset >= 0, np.take_along_axis(easier, np.maximum(onset, 0), axis=0), side)
    sides = np.where(blocked, since, 0)
    way = sides[row, whisker]
    chosen = _Ends(*(np.where(way > 0, a, b) for a, b in zip(left, right, strict=True)))
    turn, reach, lean = (free.copy() for _ in range(3))
    reach += fan.length
    angle, reach[row, whisker], lean[row, whisker] = _solve_contacts(fan, chosen)
    turn[row, whisker] = way * angle
    return Bending(turn, reach, lean, sides)


def base_strains(config: WhiskersConfig, fan: FixedWhiskers, bent: Bending) -> np.ndarray:
    """Horizontal and vertical strain [T, W, 2] of bent whiskers, without noise."""
    # The surface strain at the base, M r0 / (E I), with the sign of the rotation.
    across = 3 * fan.radius * (1 / bent.reach - fan.taper) * bent.turn
    # The force along the shaft bends it by the lever of its droop, the force across it by its length.
    along = np.tan(np.minimum(bent.lean + np.arctan(config.friction), MAX_LEAN))
    down = np.tan(np.radians(config.droop_deg)) * np.abs(across) * along
    return np.stack([across, config.crosstalk * across - down], axis=-1) * fan.alive[:, None]


class BodyVibration:
    """Strain from vibration of the body, block by block: it rings from the start of a motion on, and its
    wheels rumble while they roll."""

    def __init__(self, config: ShakeConfig, rate: float, random: np.random.Generator) -> None:
        from scipy.signal import lfilter  # slow: not in the first block of an emulator

        self._filter = lfilter
        self._config, self._rate, self._random = config, rate, random
        pole = np.exp((-1 / config.decay + 2j * np.pi * config.frequency) / rate)
        a, b = -2 * pole.real, abs(pole) ** 2
        self._back = [1.0, a, b]  # recursive coefficients of the resonance
        # Standard deviation of the resonance driven by unit noise.
        self._gain = float(np.sqrt((1 + b) / ((1 - b) * ((1 + b) ** 2 - a**2))))
        self._state = np.zeros((2, 2))
        self._since = 0  # samples since the last start
        self._amplitude = self._phase = np.zeros(2)

    def start(self) -> None:
        """Starts a motion."""
        self._since = 0
        self._amplitude = self._config.start * self._random.standard_normal(2)
        self._phase = self._random.uniform(0, 2 * np.pi, 2)

    def ring(self, count: int) -> np.ndarray:
        """The next [T, 2] horizontal and vertical strains of ringing."""
        time = (self._since + np.arange(count)) / self._rate
        self._since += count
        damped, turned = np.exp(-time / self._config.decay), 2 * np.pi * self._config.frequency * time
        return self._amplitude * damped[:, None] * np.sin(turned[:, None] + self._phase)

    def rumble(self, count: int, rolls: bool = True) -> np.ndarray:
        """The next [T, 2] strains of rumble, which goes on when the wheels no longer roll."""
        drive = self._random.standard_normal((count, 2)) * rolls
        rumble, self._state = self._filter([1.0], self._back, drive, axis=0, zi=self._state)
        return self._config.rumble / self._gain * rumble


def sample_strain(
    config: WhiskersConfig, strain: np.ndarray, alive: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Sensor readings [T, W, 2] of strain [T, W, 2] at the sensor rate, from the start of a motion."""
    shaking = BodyVibration(config.shake, config.rate, random)
    shaking.start()
    shaking.rumble(int(5 * config.shake.decay * config.rate))  # until the transient has decayed
    shake = shaking.ring(len(strain)) + shaking.rumble(len(strain))
    read = strain + shake[:, None] + config.noise * random.standard_normal(strain.shape)
    return np.where(alive[:, None], read, 0.0)


def monitor_strain(
    config: WhiskersConfig, strain: np.ndarray, alive: np.ndarray, period: float, random: np.random.Generator
) -> np.ndarray:
    """Monitored strain [T, W, 2]: means over a period (s) before each row, without vibration of the body."""
    noise = config.noise / np.sqrt(max(config.rate * period, 1.0))
    return np.where(alive[:, None], strain + noise * random.standard_normal(strain.shape), 0.0)
