"""`python -m robot.emulators.create`: an emulated Create on a pseudo-terminal, until the process is ended.

It prints the port and `ready`, then executes fault requests from standard input
(`robot/emulators/create/README.md`).
"""

from __future__ import annotations

import argparse
import sys

from robot.emulators.create.emulator_config import CreateEmulatorConfig
from robot.emulators.create.server import serve
from robot.emulators.listening import run_emulator


def main(words: list[str] | None = None) -> int:
    """Runs the program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m robot.emulators.create", description=__doc__)
    parser.add_argument("--config", help="CreateEmulatorConfig as JSON; options override it")
    parser.add_argument("--seed", type=int, help="random seed")
    parser.add_argument("--wheel-base", type=float, help="distance between the wheels, m")
    return run_emulator(parser.parse_args(words), CreateEmulatorConfig, serve)


if __name__ == "__main__":
    sys.exit(main())
