"""An emulated whisker head: moves whiskers in a maze and answers USB requests over TCP."""

from robot.emulators.head.emulator_config import HeadEmulatorConfig
from robot.emulators.head.server import serve

__all__ = ["HeadEmulatorConfig", "serve"]
