"""`python -m robot.emulators.ur10`: runs an emulated controller until the process is ended."""

from __future__ import annotations

import argparse
import sys

from robot.emulators.listening import run_emulator
from robot.emulators.ur10 import UrEmulatorConfig, serve


def main() -> int:
    """Runs the program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m robot.emulators.ur10", description=__doc__)
    parser.add_argument("--config", help="settings as JSON; the other options override them")
    parser.add_argument("--host", help="address to listen on (127.0.0.11)")
    parser.add_argument("--hz", type=int, choices=(125, 500), help="control steps per second (125)")
    parser.add_argument("--polyscope", help="PolyScope version (3.15.8 at 125 Hz, 5.11.0 at 500 Hz)")
    parser.add_argument("--start", type=float, nargs=6, metavar=("x", "y", "z", "rx", "ry", "rz"))
    return run_emulator(parser.parse_args(), UrEmulatorConfig, serve)


if __name__ == "__main__":
    sys.exit(main())
