"""What an emulated UR controller is like: its address and version, its arm's start, what stands around."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.base.config import Settings

SCRIPT_PORT, DASHBOARD_PORT = 30003, 29999  # fixed: the client library knows no others
FAULT_PORT = 30098

Vector6 = tuple[float, float, float, float, float, float]


class WallConfig(Settings):
    """Something flat and springy that the tool can be pushed into."""

    axis: Literal["x", "y", "z"] = "x"
    """The axis of the base that the plane stands across."""
    at: float = 0.8
    """Where it begins on that axis, m."""
    solid: Literal[-1, 1] = 1
    """The side that is solid: 1 beyond `at`, -1 before it."""
    stiffness: PositiveFloat = 5000.0
    """Force by penetration, N/m."""


class Version(NamedTuple):
    """PolyScope's version, which is also the controller's."""

    major: int
    minor: int
    bugfix: int = 0


class UrEmulatorConfig(Settings):
    """An emulated UR controller with its arm."""

    host: str = "127.0.0.11"
    """Address to listen on; the ports are the real ones, so every emulator needs an address of its own."""
    hz: Literal[125, 500] = 125
    """Control steps and states a second: 125 for a CB3 (a UR-10 of 2016), 500 for an e-Series."""
    polyscope: Annotated[str, Field(pattern=r"^(\d+\.\d+(\.\d+)?)?$")] = ""
    """PolyScope's version; "" means 3.15.8 at 125 Hz and 5.11.0 at 500 Hz."""
    start: Vector6 = (0.6, 0.0, 0.3, 3.141592653589793, 0.0, 0.0)
    """The tool's pose when the arm is switched on: m and rotation vector in the base."""
    remote: bool = True
    """Whether an e-Series says that it is under remote control."""
    walls: tuple[WallConfig, ...] = ()
    """What the tool can hit."""
    protective_force: PositiveFloat = 150.0
    """N at the tool above which the controller makes a protective stop of its own."""
    turn_ratio: PositiveFloat = 4.0
    """How fast a linear move may turn for every m/s it was given, rad/m; likewise accelerations."""
    halt: PositiveFloat = 2.0
    """Deceleration of a program that is stopped, m/s^2."""
    brake: PositiveFloat = 5.0
    """Deceleration of a safety stop, m/s^2."""
    starting: NonNegativeFloat = 0.02
    """s from the end of an uploaded program to its first step."""
    unlock_wait: NonNegativeFloat = 5.0
    """s that a protective stop cannot be unlocked for."""

    @property
    def version(self) -> Version:
        """What the controller says it runs."""
        written = self.polyscope or ("3.15.8" if self.hz == 125 else "5.11.0")
        return Version(*map(int, written.split(".")))
