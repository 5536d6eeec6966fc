"""The program: `python -m ratslam COMMAND`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

# Only what parsing arguments needs is imported here: `--help` answers before jax would have loaded.
from ratslam.cli import ablation, create, live, pareto, reproduce, run, studies, watch
from ratslam.cli.common import INTERRUPTED, MENDABLE
from tactile.base.errors import InputError


def main(argv: list[str] | None = None) -> int:
    """Parses the arguments and runs one command; the exit code."""
    arguments = _parser().parse_args(argv)
    try:
        return arguments.command(arguments)
    except InputError as error:
        print("\n".join(f"ratslam: error: {line}" for line in str(error).splitlines()), file=sys.stderr)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(
            f"ratslam: error: {where}{error.strerror or error}; what was written so far is complete; "
            "make room or choose another folder with -o",
            file=sys.stderr,
        )
    except KeyboardInterrupt:
        print("ratslam: interrupted", file=sys.stderr)
        return INTERRUPTED
    return MENDABLE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="ratslam",
        description="Maps and localises by view or whisker: pose cells, recall, experience map.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, does: Callable[[argparse.Namespace], int], help: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=help, description=help)
        added.set_defaults(command=does)
        return added

    for group in (run, live, ablation, studies, pareto, reproduce, create, watch):
        group.add(command)
    return parser
