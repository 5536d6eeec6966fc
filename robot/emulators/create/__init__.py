"""An emulated iRobot Create on a pseudo-terminal, with whiskers in an arena if it is given one."""

from robot.emulators.create.emulator_config import CreateEmulatorConfig
from robot.emulators.create.robot import EmulatedCreate
from robot.emulators.create.server import serve

__all__ = ["CreateEmulatorConfig", "EmulatedCreate", "serve"]
