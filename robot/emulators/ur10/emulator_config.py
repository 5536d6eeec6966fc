"""Settings of an emulated UR controller: address, version, start pose, walls."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat

from robot.drivers.ur10.driver_config import BaseTransformConfig
from robot.emulators.ur10.kinematics import Vector6
from robot.world.contact_force import ContactForceConfig
from tactile.base.settings import Settings

SCRIPT_PORT = 30003  # fixed in the client library
FAULT_PORT = 30098


class WallConfig(Settings):
    """A flat elastic obstacle for the tool."""

    axis: Literal["x", "y", "z"] = "x"
    """Axis of the base normal to the plane."""
    at: float = 0.8
    """Position of the plane on that axis, m."""
    solid: Literal[-1, 1] = 1
    """Solid side: 1 beyond `at`, -1 before it."""
    stiffness: PositiveFloat = 5000.0
    """Force by penetration, N/m."""

    def depth(self, tcp: Vector6) -> float:
        """Depth of the tool in the wall, m; 0 outside."""
        return max(0.0, self.solid * (tcp["xyz".index(self.axis)] - self.at))


class PokedWallsConfig(Settings):
    """Upright walls that the tool meets at working height, as boxes on the floor."""

    boxes: tuple[tuple[float, float, float, float], ...]
    """West, south, east and north of each in the map, m."""
    placing: BaseTransformConfig = BaseTransformConfig()
    """Pose of the map in the base frame."""
    radius: PositiveFloat = 0.005
    """Radius of the tool, m."""
    top: PositiveFloat = 0.03
    """Height of the walls above the tool at working height, m."""
    force: ContactForceConfig = ContactForceConfig()
    """Stiffness of the walls, and errors of the measured force."""
    seed: NonNegativeInt = 0
    """Seed of the noise."""


class UrEmulatorConfig(Settings):
    """An emulated UR controller with its arm."""

    host: str = "127.0.0.11"
    """Address to listen on; the ports are the real ones, so every emulator needs an address of its own."""
    open_to_network: bool = False
    """Whether the address may be one that others reach, who may then command, fault or stop it."""
    hz: Literal[125, 500] = 125
    """Control steps and states per second: 125 for a CB3 (a UR-10 of 2016), 500 for an e-Series."""
    polyscope: Annotated[str, Field(pattern=r"^(\d+\.\d+(\.\d+)?)?$")] = ""
    """PolyScope's version; "" means 3.15.8 at 125 Hz and 5.11.0 at 500 Hz."""
    start: Vector6 = (0.6, 0.0, 0.3, 3.141592653589793, 0.0, 0.0)
    """Initial tool pose: m and rotation vector rad, in the base."""
    remote: bool = True
    """Whether an e-Series reports remote control."""
    walls: tuple[WallConfig, ...] = ()
    """Obstacles."""
    poked: PokedWallsConfig | None = None
    """Walls of a maze, for an arm that pokes."""
    protective_force: PositiveFloat = 150.0
    """Force at the tool above which the controller makes a protective stop, N."""
    turn_ratio: PositiveFloat = 4.0
    """Turning rate of a linear move per linear speed, rad/m; likewise accelerations."""
    halt: PositiveFloat = 2.0
    """Deceleration of a program that is stopped, m/s^2."""
    brake: PositiveFloat = 5.0
    """Deceleration of a safety stop, m/s^2."""
    starting: NonNegativeFloat = 0.02
    """Delay from the end of an uploaded program to its first step, s."""
    unlock_wait: NonNegativeFloat = 5.0
    """Time for which a protective stop cannot be unlocked, s."""

    @property
    def version(self) -> tuple[int, int, int]:
        """Version that the controller reports: major, minor and bugfix."""
        written = self.polyscope or ("3.15.8" if self.hz == 125 else "5.11.0")
        major, minor, bugfix, *_ = *map(int, written.split(".")), 0
        return major, minor, bugfix
