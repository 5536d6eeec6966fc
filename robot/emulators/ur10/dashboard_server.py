"""The dashboard port: a line of text in, a line out.

Source: Universal Robots, "Dashboard Server", CB3 and e-Series.
"""

from __future__ import annotations

from collections.abc import Callable

from robot.emulators.ur10.controller import EmulatedController
from robot.emulators.ur10.safety import RobotMode, Runtime, SafetyMode

WELCOME = b"Connected: Universal Robots Dashboard Server\n"
SERIAL = "20163000000"


class DashboardSession:
    """A client connection."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._rest = b""

    def received(self, data: bytes, host: float) -> bytes:
        """The answers, a line each."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return b"".join(
            f"{answer_command(self._controller, line.decode().strip())}\n".encode() for line in lines
        )

    def closed(self) -> None:
        """Has no effect."""


def answer_command(controller: EmulatedController, command: str) -> str:
    """Executes a command; returns the answer."""
    version = controller.config.version
    known = dict(_COMMANDS)
    if version >= (5, 6):
        known |= _E_SERIES
    do = known.get(command.lower())
    if do is not None:
        return do(controller)
    for word, echo in (
        ("popup", "showing popup"),
        ("addtolog", "Added log message"),
        ("load", "Loading program: "),
    ):
        if command.lower().startswith(word + " "):
            return echo + (command.split(" ", 1)[1] if word == "load" else "")
    return f"could not understand: '{command}'"


def _stop(controller: EmulatedController) -> str:
    controller.stop_program()
    return "Stopped"


def _play(controller: EmulatedController) -> str:
    if controller.program is None or controller.safety is not SafetyMode.NORMAL:
        return "Failed to execute: play"
    controller.runtime = Runtime.PLAYING
    return "Starting program"


def _pause(controller: EmulatedController) -> str:
    if controller.runtime is not Runtime.PLAYING:
        return "Failed to execute: pause"
    controller.runtime = Runtime.PAUSED
    controller.arm.halt(controller.config.halt)
    return "Pausing program"


def _unlock(controller: EmulatedController) -> str:
    if controller.unlock():
        return "Protective stop releasing"
    return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"


def _power(mode: RobotMode, said: str) -> Callable[[EmulatedController], str]:
    def do(controller: EmulatedController) -> str:
        controller.power(mode)
        return said

    return do


def _program_state(controller: EmulatedController) -> str:
    return f"{controller.runtime.name} rtde_control" if controller.program else "STOPPED <unnamed>"


_COMMANDS: dict[str, Callable[[EmulatedController], str]] = {
    "stop": _stop,
    "play": _play,
    "pause": _pause,
    "unlock protective stop": _unlock,
    "power on": _power(RobotMode.IDLE, "Powering on"),
    "brake release": _power(RobotMode.RUNNING, "Brake releasing"),
    "power off": _power(RobotMode.POWER_OFF, "Powering off"),
    "robotmode": lambda c: f"Robotmode: {c.robot_mode.name}",
    "safetymode": lambda c: f"Safetymode: {c.safety.name}",
    "safetystatus": lambda c: f"Safetystatus: {c.safety.name}",
    "programstate": _program_state,
    "running": lambda c: f"Program running: {str(c.runtime is Runtime.PLAYING).lower()}",
    "polyscopeversion": lambda c: "URSoftware {}.{}.{}.0 (emulated)".format(*c.config.version),
    "get loaded program": lambda c: "No program loaded",
    "isprogramsaved": lambda c: "True <unnamed>",
    "close popup": lambda c: "closing popup",
    "close safety popup": lambda c: "closing safety popup",
    "restart safety": lambda c: "Restarting safety",
    "quit": lambda c: "Disconnected",
    "shutdown": lambda c: "Shutting down",
}
_E_SERIES: dict[str, Callable[[EmulatedController], str]] = {
    "is in remote control": lambda c: str(c.remote).lower(),
    "get serial number": lambda c: SERIAL,
    "get robot model": lambda c: "UR10",
}
