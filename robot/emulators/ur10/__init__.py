"""An emulated UR controller: RTDE, script and dashboard, for the real client libraries."""

from robot.emulators.ur10.emulator_config import UrEmulatorConfig, WallConfig
from robot.emulators.ur10.server import serve

__all__ = ["UrEmulatorConfig", "WallConfig", "serve"]
