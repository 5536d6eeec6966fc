"""The dashboard port: answers each line of text with one line.

Source: Universal Robots, "Dashboard Server", CB3 and e-Series.
"""

from __future__ import annotations

from collections.abc import Callable

from robot.emulators.ur10.controller import EmulatedController
from robot.emulators.ur10.safety import RobotMode, Runtime

WELCOME = b"Connected: Universal Robots Dashboard Server\n"
SINCE_5_6 = ("is in remote control", "get serial number")


class DashboardSession:
    """A client connection."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._rest = b""

    def receive(self, data: bytes, host: float) -> bytes:
        """Executes complete lines; returns one line of answer for each."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return b"".join(
            f"{answer_command(self._controller, line.decode().strip())}\n".encode() for line in lines
        )

    def close(self) -> None:
        """Has no effect."""


def answer_command(controller: EmulatedController, command: str) -> str:
    """Executes a command; returns the answer."""
    do = _COMMANDS.get(command.lower())
    if do is None or (command.lower() in SINCE_5_6 and controller.config.version < (5, 6)):
        return f"could not understand: '{command}'"
    return do(controller)


def _stop(controller: EmulatedController) -> str:
    controller.stop_program()
    return "Stopped"


def _unlock(controller: EmulatedController) -> str:
    if controller.unlock():
        return "Protective stop releasing"
    return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"


def _power(mode: RobotMode, answer: str) -> Callable[[EmulatedController], str]:
    def do(controller: EmulatedController) -> str:
        controller.power(mode)
        return answer

    return do


_COMMANDS: dict[str, Callable[[EmulatedController], str]] = {
    "stop": _stop,
    "unlock protective stop": _unlock,
    "power on": _power(RobotMode.IDLE, "Powering on"),
    "brake release": _power(RobotMode.RUNNING, "Brake releasing"),
    "power off": _power(RobotMode.POWER_OFF, "Powering off"),
    "robotmode": lambda c: f"Robotmode: {c.robot_mode.name}",
    "is in remote control": lambda c: str(c.remote).lower(),
    "get serial number": lambda c: "20163000000",
    "safetymode": lambda c: f"Safetymode: {c.safety.name}",
    "running": lambda c: f"Program running: {str(c.runtime is Runtime.PLAYING).lower()}",
    "polyscopeversion": lambda c: "URSoftware {}.{}.{}.0 (emulated)".format(*c.config.version),
}
