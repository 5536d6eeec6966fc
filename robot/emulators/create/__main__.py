"""`python -m robot.emulators.create`: an emulated Create on a pseudo-terminal, until the process is ended.

It prints the port and `ready`, then executes fault requests from standard input
(`robot/emulators/create/README.md`).
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from typing import Any

from pydantic import ValidationError

from robot.emulators.create.emulator_config import CreateEmulatorConfig
from robot.emulators.create.server import serve
from tactile.base.errors import InputError


def main(words: list[str] | None = None) -> int:
    """Runs the program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m robot.emulators.create", description=__doc__)
    parser.add_argument("--config", default="{}", help="CreateEmulatorConfig as JSON; options override it")
    parser.add_argument("--seed", type=int, help="random seed")
    parser.add_argument("--wheel-base", type=float, help="distance between the wheels, m")
    given: dict[str, Any] = {
        key: value for key, value in vars(parser.parse_args(words)).items() if value is not None
    }
    try:
        written = CreateEmulatorConfig.model_validate_json(given.pop("config"))
        with contextlib.suppress(KeyboardInterrupt):
            serve(CreateEmulatorConfig.model_validate(written.model_dump() | given))
    except (InputError, ValidationError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
