"""`python -m robot.emulators.head --host 127.0.0.11 --config FILE.json`: runs an emulated head until killed.

Prints `ready` when it listens.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pydantic import ValidationError

from robot.emulators.head.config import HeadEmulatorConfig
from robot.emulators.head.server import serve
from tactile.base.errors import InputError


def main(words: list[str] | None = None) -> int:
    """Runs the program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m robot.emulators.head", description=__doc__)
    parser.add_argument("--host", help="address to listen on; overrides the configuration")
    parser.add_argument("--config", type=Path, help="HeadEmulatorConfig as JSON (default values if omitted)")
    arguments = parser.parse_args(words)
    try:
        config = _read(arguments.config)
        if arguments.host is not None:
            config = config.model_copy(update={"host": arguments.host})
        serve(config)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def _read(file: Path | None) -> HeadEmulatorConfig:
    if file is None:
        return HeadEmulatorConfig()
    try:
        return HeadEmulatorConfig.model_validate_json(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(str(file), str(error.strerror), "a readable file") from None
    except ValidationError as error:
        raise InputError(str(file), str(error), "a HeadEmulatorConfig") from None


if __name__ == "__main__":
    sys.exit(main())
