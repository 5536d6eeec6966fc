"""Settings of the arm (address, workspace, speeds, time limits), and its tool poses for poses in the map.

A tool pose is an array [..., 6] in UR controllers' notation: x, y, z of the tool centre point in the base
frame, m, and a rotation vector, rad. The tool points down: its rotation is Rz(heading) Rx(pi), half a turn
about the level axis (cos h/2, sin h/2, 0).
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from tactile.base.se2 import between, compose
from tactile.base.settings import Settings


class BaseTransformConfig(Settings):
    """Pose of the map in the arm's base frame.

    The default sets a maze of 7 x 5 micromouse cells before the base, within a UR-10's reach.
    """

    x: float = -0.63
    """x of the map's origin, m."""
    y: float = 0.22
    """y of the map's origin, m."""
    z: float = 0.1
    """Height of the tool centre point at working height, m."""
    yaw_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Angle from the base's x axis to the map's, degrees."""

    @property
    def _origin(self) -> np.ndarray:
        """[3] pose of the map in the base frame, seen from above, m, m, rad."""
        return np.array([self.x, self.y, np.radians(self.yaw_deg)])

    def tcp_from_pose(self, pose: np.ndarray, lift: float | np.ndarray = 0.0) -> np.ndarray:
        """Tool poses [..., 6] for poses of the head in the map.

        Args:
            pose: [..., 3] x, y (m) and heading (rad) in the map. lift: [...] m above working height.
        """
        x, y, heading = np.moveaxis(compose(self._origin, np.asarray(pose, np.float64)), -1, 0)
        z = np.broadcast_to(self.z + np.asarray(lift, np.float64), x.shape)
        axis = np.pi * np.cos(heading / 2), np.pi * np.sin(heading / 2)
        return np.stack([x, y, z, *axis, np.zeros_like(x)], axis=-1)

    def pose_from_tcp(self, tcp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the head in the map [..., 3], heading wrapped, and lift above working height [...] m."""
        tcp = np.asarray(tcp, np.float64)
        pose = np.stack([tcp[..., 0], tcp[..., 1], tcp_heading(tcp)], axis=-1)
        return between(self._origin, pose), tcp[..., 2] - self.z


def tcp_heading(tcp: np.ndarray) -> np.ndarray:
    """Heading of the tool's x axis in the base frame, seen from above, [...] rad."""
    axis, turn = _axis_angle(tcp)
    x, y, z = np.moveaxis(axis, -1, 0)
    cos, sin = np.cos(turn), np.sin(turn)
    return np.arctan2(z * sin + x * y * (1 - cos), cos + x * x * (1 - cos))


def tcp_tilt(tcp: np.ndarray) -> np.ndarray:
    """Angle between the tool's z axis and straight down, [...] rad."""
    axis, turn = _axis_angle(tcp)
    up = np.cos(turn) + axis[..., 2] ** 2 * (1 - np.cos(turn))
    return np.arccos(np.clip(-up, -1.0, 1.0))


def _axis_angle(tcp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation axis [..., 3] of unit length (any for no rotation) and angle [...] rad."""
    vector = np.asarray(tcp, np.float64)[..., 3:]
    turn = np.linalg.norm(vector, axis=-1)
    return vector / np.where(turn > 0, turn, 1.0)[..., None], turn


SPEED_CAP = 0.25  # m/s; reduced speed of ISO 10218-1, the upper limit of every speed setting
TURN_CAP = 1.0  # rad/s
ROUNDING = 1e-6  # m; tolerance of the box for rounding

Corner = tuple[float, float, float]


class BoxConfig(Settings):
    """Workspace of the tool centre point in the base frame."""

    low: Corner = (-0.75, 0.15, 0.05)
    """Corner of smallest x, y, z, m."""
    high: Corner = (0.75, 1.25, 0.45)
    """Corner of largest x, y, z, m."""

    @model_validator(mode="after")
    def _ordered(self) -> BoxConfig:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low {self.low} must be smaller than high {self.high} in every coordinate")
        return self

    def contains(self, tcp: np.ndarray) -> bool:
        """Whether the tool centre point of a tool pose is in the box."""
        place = np.asarray(tcp, np.float64)[:3]
        low, high = np.array(self.low), np.array(self.high)
        return bool(((place >= low - ROUNDING) & (place <= high + ROUNDING)).all())


class ArmConfig(Settings):
    """Address and limits of a UR-10 (CB3 or e-Series), in addition to the robot's own safety
    configuration.
    """

    host: str = "127.0.0.11"
    """Address of the controller; its ports are fixed. The default is the emulator's."""
    hz: Literal[125, 500] = 125
    """Rate of the state stream, Hz: 125 of a CB3, 500 of an e-Series (which supports 125 too)."""
    touch: Literal["head", "force"] = "head"
    """What the arm feels with: a whisker head, or, without one, its tool by pokes (`touch.pokes`)."""
    placing: BaseTransformConfig = BaseTransformConfig()
    """Pose of the map in the base frame."""
    box: BoxConfig = BoxConfig()
    """Workspace; every target and every state is checked against it."""
    speed: Annotated[float, Field(gt=0, le=SPEED_CAP)] = 0.05
    """Speed limit of the tool centre point, m/s; a move may be slower."""
    turn_rate: Annotated[float, Field(gt=0, le=TURN_CAP)] = 0.4
    """Turning rate of the tool on the spot, rad/s."""
    turn_ratio: Annotated[float, Field(ge=4, le=100)] = 4.0
    """Largest turning rate of the tool per linear speed in a linear move, rad/m. Assumed, not confirmed on a
    controller; a controller that turns more slowly takes longer, which the time limits allow."""
    acceleration: Annotated[float, Field(gt=0, le=1.2)] = 0.3
    """Acceleration of the tool, m/s^2."""
    deceleration: Annotated[float, Field(gt=0, le=10.0)] = 2.0
    """Deceleration in a controlled stop, m/s^2."""
    tilt_deg: Annotated[float, Field(ge=0, le=90)] = 5.0
    """Largest tilt of the tool from straight down in a target, degrees."""
    tool: tuple[float, float, float, float, float, float] | None = None
    """Tool centre point in the flange (m, rotation vector rad); None: as in the installation."""
    force_limit: PositiveFloat = 30.0
    """Change of the force at the tool that counts as a contact in two consecutive states, N."""
    backoff: Annotated[float, Field(ge=0, le=0.05)] = 0.01
    """Distance that the tool backs off after a contact, m."""
    stale: PositiveFloat = 0.1
    """Largest age of the newest state before the arm counts as lost, s; at most 1, except for an emulator."""
    heartbeat: PositiveFloat = 0.15
    """Largest age of the session's heartbeat before the RTDE process stops the arm and ends, s; at most 1,
    except for an emulator."""
    watchdog_hz: Annotated[float, Field(gt=0, le=100)] = 10.0
    """Rate of the watchdog reset below which the controller stops the arm, Hz; at least 2, except for an
    emulator."""
    arrive: PositiveFloat = 0.001
    """Position tolerance of an arrival, m."""
    arrive_turn_deg: PositiveFloat = 0.5
    """Rotation tolerance of an arrival, degrees."""
    patience: PositiveFloat = 3.0
    """Time beyond the expected duration of a move before it counts as not arrived, s."""
    connect: PositiveFloat = 10.0
    """Time-out of the connection, of the start of the control script and of the full state rate, s."""

    @property
    def emulated(self) -> bool:
        """Whether the address is one of this machine, where only an emulator can be."""
        return self.host.startswith("127.")

    @model_validator(mode="after")
    def _stops_in_time(self) -> ArmConfig:
        slow = self.stale > 1 or self.heartbeat > 1 or self.watchdog_hz < 2
        if slow and not self.emulated:
            limits = "`stale` and `heartbeat` are at most 1 s, and `watchdog_hz` is at least 2 Hz"
            raise ValueError(f"{limits}, except for an emulator at a loopback address")
        return self
