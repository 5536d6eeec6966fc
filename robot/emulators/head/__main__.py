"""`python -m robot.emulators.head --host 127.0.0.11 --config FILE.json`: runs an emulated head until killed.

Prints `ready` when it listens.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from robot.emulators.head.emulator_config import HeadEmulatorConfig
from robot.emulators.head.server import serve
from tactile.base.bounded import read_json
from tactile.base.errors import InputError


def main(words: list[str] | None = None) -> int:
    """Runs the program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m robot.emulators.head", description=__doc__)
    parser.add_argument("--host", help="address to listen on; overrides the configuration")
    parser.add_argument("--config", type=Path, help="HeadEmulatorConfig as JSON (default values if omitted)")
    arguments = parser.parse_args(words)
    try:
        config = HeadEmulatorConfig()
        if arguments.config is not None:
            config = read_json(arguments.config, "a HeadEmulatorConfig", HeadEmulatorConfig.model_validate)
        if arguments.host is not None:
            config = config.model_copy(update={"host": arguments.host})
        serve(config)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
