"""A UR controller that is not there: RTDE, script and dashboard, for the real client libraries."""

from robot.emulators.ur10.server import serve
from robot.emulators.ur10.settings import UrEmulatorConfig, WallConfig

__all__ = ["UrEmulatorConfig", "WallConfig", "serve"]
