"""A whisker head that is not there: a process that moves its whiskers in a maze and answers as USB would."""

from robot.emulators.head.config import HeadEmulatorConfig
from robot.emulators.head.server import serve

__all__ = ["HeadEmulatorConfig", "serve"]
