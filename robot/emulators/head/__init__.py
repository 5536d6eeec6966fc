"""An emulated whisker head: moves whiskers in a maze and answers as over USB."""

from robot.emulators.head.config import HeadEmulatorConfig
from robot.emulators.head.server import serve

__all__ = ["HeadEmulatorConfig", "serve"]
